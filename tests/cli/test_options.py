# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Options that several commands share."""

from __future__ import annotations

import argparse

import pytest
from radarsdf import FitConfig
from radarsdf.cli.options import add_box, add_fit_options, box_of, config_of, progress_of

from .calls import call, refusal


def parsed(*words):
    parser = argparse.ArgumentParser()
    add_fit_options(parser)
    add_box(parser)
    return parser.parse_args(words)


def config(*words):
    return config_of(parsed(*words))


def test_presets():
    assert config() == FitConfig()
    assert config("--paper") == FitConfig.paper()
    assert config("--quick", "--set", "seed=3") == FitConfig.quick(seed=3)


def test_settings_of_every_type():
    settings = [
        "encoding.kind=octree",
        "networks.intensity_hidden=(8, 8)",
        "training.sigma_cells=0.5",
        "networks.normals=True",
        "returns.max_range_m=None",
        "seed=4",
        "seed=5",  # the last one counts
    ]
    words = [word for setting in settings for word in ("--set", setting)]
    assert config("--paper", *words) == FitConfig.paper(
        encoding={"kind": "octree"},
        networks={"intensity_hidden": (8, 8), "normals": True},
        training={"sigma_cells": 0.5},
        returns={"max_range_m": None},
        seed=5,
    )


def test_settings_from_a_file(tmp_path):
    path = tmp_path / "settings.toml"
    path.write_text("seed = 3\n[training]\nsdf_iterations = 7\nbatch_size = 64\n")
    expected = FitConfig.quick(seed=3, training={"sdf_iterations": 7, "batch_size": 32})
    assert config("--quick", "--config", str(path), "--set", "training.batch_size=32") == expected


@pytest.mark.parametrize("preset", [[], ["--quick"], ["--paper"]])
def test_what_config_prints_is_the_same_configuration(capsys, tmp_path, preset):
    path = tmp_path / "settings.toml"
    assert call("config", *preset, "--set", "networks.intensity_hidden=(8, 4)") == 0
    path.write_text(capsys.readouterr().out)
    assert config("--config", str(path)) == config(*preset, "--set", "networks.intensity_hidden=(8, 4)")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("seed =", "is not a TOML file"),
        ("seed = " + "[" * 5000, "is not a TOML file"),
        ("colour = 1", "unknown setting colour"),
        ("[training]\nbar = 1", "unknown setting training.bar"),
    ],
)
def test_a_file_that_makes_no_sense(tmp_path, text, said):
    path = tmp_path / "settings.toml"
    path.write_text(text)
    with pytest.raises(ValueError, match=said):
        config("--config", str(path))


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("seed", "--set takes NAME=VALUE, not 'seed'"),
        ("colour=1", "unknown setting colour"),
        ("self=1", "unknown setting self"),
        ("x" * 99, f"--set takes NAME=VALUE, not '{'x' * 49}"),
        ("training={1: 2}", "training must have names as keys, not 1"),
        ("leaf_size_m=1e300", "leaf_size_m must be less than or equal to 1000000, not 1e+300"),
        ("training.colour=1", "unknown setting training.colour"),
        ("colour.seed=1", "unknown setting colour"),
        ("seed.a=1", "seed must be a valid integer, not {'a': 1}"),
        ("training=1", "training must be an instance of TrainingConfig, not 1"),
        ("training.sigma_cells=-1", "training.sigma_cells must be greater than 0, not -1"),
        ("training.sigma_cells=1e999", "training.sigma_cells must be a finite number, not inf"),
        ("training.sigma_cells=wide", "training.sigma_cells must be a valid number, not 'wide'"),
        ("training.sigma_cells=None", "training.sigma_cells must be a valid number, not None"),
        ("encoding.kind=tree", "encoding.kind must be 'tri-quadtree' or 'octree', not 'tree'"),
        ("encoding.kind=3", "encoding.kind must be 'tri-quadtree' or 'octree', not 3"),
        ("training.sdf_iterations=1.5", "training.sdf_iterations must be a valid integer, not 1.5"),
        ("training.sdf_iterations=many", "training.sdf_iterations must be a valid integer, not 'many'"),
        ("training.batch_size=[1]", "training.batch_size must be a valid integer, not [1]"),
        ("networks.intensity_hidden=3", "networks.intensity_hidden must be a valid tuple, not 3"),
        ("networks.intensity_hidden=(8, 0.5)", "networks.intensity_hidden must be a valid integer, not 0.5"),
        ("networks.intensity_hidden=wide", "networks.intensity_hidden must be a valid tuple, not 'wide'"),
        ("networks.normals=perhaps", "networks.normals must be a valid boolean, not 'perhaps'"),
        ("encoding.num_levels=2.5", "encoding.num_levels must be a valid integer, not 2.5"),
        ("seed=-1.5", "seed must be a valid integer, not -1.5"),
    ],
)
def test_settings_that_make_no_sense(capsys, tmp_path, setting, said):
    # The scans do not exist: settings are checked before they are read.
    words = ["fit", tmp_path / "absent.npz", "-o", tmp_path / "map.safetensors", "--set", setting]
    assert refusal(capsys, tmp_path, *words) == f"radarsdf fit: {said}\n"


@pytest.mark.parametrize(
    "value",
    [
        "",
        "=1",
        "1 +",
        "1+[]",
        "f(1)",
        "{[]:1}",
        "{[]}",
        "9" * 5000,
        "\0",
        "\udcff",
        "(" * 100,
        "(" * 100_000,
        "-" * 100_000 + "1",  # too deep for the parser
        "1" + "+1" * 100_000,  # too deep for the recursion limit
    ],
    ids=lambda value: repr(value[:8]),
)
def test_a_value_that_is_no_literal_is_a_string(value):
    with pytest.raises(ValueError, match="seed must be a valid integer, not '"):
        config("--set", f"seed={value}")


def test_quiet():
    assert progress_of(parsed()) is None
    assert progress_of(parsed("--quiet")) is False


def test_box():
    assert box_of(parsed()) is None
    assert box_of(parsed(*["--box", "1", "2", "3", "-4", "5", "6e2"])) == [[1, 2, 3], [-4, 5, 600]]
