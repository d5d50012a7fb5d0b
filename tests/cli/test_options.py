# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Options that several commands share."""

import numpy as np
import pytest
from radarsdf import FitConfig
from radarsdf.cli.inputs import read_scans
from radarsdf.cli.options import OPTIONS, Parser
from radarsdf.cli.settings import load_config

from .calls import call, refusal


def given(command, *words):
    """What the words after a command mean."""
    return Parser(command).parse_args([str(word) for word in words])


def config(*words):
    return load_config(given("config", *words))


def test_a_preset_then_a_file_then_single_settings(tmp_path):
    path = tmp_path / "settings.toml"
    path.write_text("seed = 3\n[training]\nsdf_iterations = 7\nbatch_size = 64\n")
    changes = [
        "training.batch_size=32",
        "encoding.kind=octree",
        "returns.max_range_m=None",
        "networks.normals=true",
    ]
    assert config() == FitConfig()
    assert config("--paper") == FitConfig.paper()
    words = [word for change in changes for word in ("--set", change)]
    assert config("--quick", "--config", path, *words) == FitConfig.quick(
        seed=3,
        training={"sdf_iterations": 7, "batch_size": 32},
        encoding={"kind": "octree"},
        returns={"max_range_m": None},
        networks={"normals": True},
    )


@pytest.mark.parametrize("preset", [[], ["--quick"], ["--paper"]])
def test_what_config_prints_is_the_same_configuration(capsys, tmp_path, preset):
    path = tmp_path / "settings.toml"
    words = [*preset, "--set", "networks.intensity_hidden=(8, 4)"]
    assert call("config", *words) == 0
    path.write_text(capsys.readouterr().out)
    assert call("config", "--config", path) == 0
    assert capsys.readouterr().out == path.read_text()


@pytest.mark.parametrize(
    ("setting", "named"),
    [
        ("colour=1", "colour"),
        ("training.colour=1", "training.colour"),
        ("seed.a=1", "seed"),
        ("training=1", "training"),
        ("training.sigma_cells=-1", "training.sigma_cells must be greater than 0, not -1"),
        ("training.sigma_cells=1e999", "training.sigma_cells"),
        ("encoding.kind=tree", "'octree'"),
        ("networks.intensity_hidden=wide", "networks.intensity_hidden"),
    ],
)
def test_settings_that_make_no_sense(capsys, tmp_path, setting, named):
    assert named in refusal(capsys, tmp_path, "config", "--set", setting)


@pytest.mark.parametrize(("text", "named"), [("seed =", "TOML"), ("[training]\nbar = 1", "training.bar")])
def test_a_file_that_makes_no_sense(capsys, tmp_path, text, named):
    path = tmp_path / "settings.toml"
    path.write_text(text)
    assert named in refusal(capsys, tmp_path, "config", "--config", path)


def test_options_are_the_parameters_of_read(tmp_path):
    (tmp_path / "scans").mkdir()
    for i in range(4):
        row = np.array([[9, 5 + i, 1, 2], [9, 6 + i, 2, 3]], "<f4")
        row.tofile(tmp_path / "scans" / f"{100 + 2 * i}.0.bin")
    poses = tmp_path / "poses.tum"
    poses.write_text("".join(f"{100 + 4 * i} {i} 0 0 0 0 0 1\n" for i in range(3)))
    words = [tmp_path / "scans", poses, "--columns", "power,x,y,z"]
    for gap, count in (([], 2), (["--max-gap", 5.0], 4)):
        scans = read_scans(given("check", *words, *gap))
        assert len(scans) == count
        np.testing.assert_array_equal(scans.points[0], [[5, 1, 2], [6, 2, 3]])
    with pytest.raises(ValueError, match="world_frame"):
        read_scans(given("check", *words, "--world-frame", "map"))
    with pytest.raises(ValueError, match=r"poses\.tum"):
        read_scans(given("check", *words, "--extrinsic", poses))


def test_negative_numbers_are_no_options():
    words = ("map.safetensors", "-o", "mesh.ply", "--box", "-1e-05", "-.5", "-2", "-1e+00", "5", "6")
    assert given("mesh", *words).box == [[-1e-05, -0.5, -2.0], [-1.0, 5.0, 6.0]]


def test_the_help_states_the_defaults_that_hold():
    stated = {}
    for name, (kind, words) in OPTIONS.items():
        default = kind.get("default")
        if isinstance(default, (float, int, tuple)):
            shown = " ".join(f"{value:.10g}" for value in np.atleast_1d(default))
            stated[name] = shown if f"default: {shown}" in words else default
    assert {name: default for name, default in stated.items() if not isinstance(default, str)} == {
        "--rate": 1.0, "--seed": 0, "--align": True
    }  # fmt: skip
    assert {"--max-gap", "--voxel", "grid --voxel", "--samples", "--min-area", "--heights"} <= set(stated)
