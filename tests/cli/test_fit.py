# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""`radarsdf fit`. Ctrl-C is tested with the other ends of a fit, `--dry-run` with the estimate."""

from __future__ import annotations

import numpy as np
import pytest
import radarsdf
from radarsdf.io import Scans, write_scans

from .calls import FAST, call, files, refusal


def test_the_map_is_of_these_scans_and_settings(map_file):
    radar_map = radarsdf.load(map_file)
    assert radar_map.has_intensity
    assert radar_map.report["returns"] == 4 * 1500  # scans 0 and 3 of six are held out
    assert (radar_map.config.training.sdf_iterations, radar_map.config.training.batch_size) == (40, 1024)


def test_geometry_only_with_a_preset(scans_file, tmp_path, capsys):
    path = tmp_path / "map.safetensors"
    assert call("fit", scans_file, "-o", path, "--quick", "--geometry-only") == 0
    printed = capsys.readouterr().out
    used, fitted, noise, written, following = printed.splitlines()
    assert used.startswith("9000 of 9000 returns in 6 scans make the surface")
    assert fitted.startswith("fit ")
    assert written == f"written to {path}"
    assert following == f"next: radarsdf mesh {path} -o {path.with_suffix('.ply')} --voxel 0.2"
    sigma = radarsdf.load(path).report["noise"]
    assert noise == (
        f"noise {sigma['range_m']:.3f} m, azimuth {sigma['azimuth_rad']:.4f} rad, "
        f"elevation {sigma['elevation_rad']:.4f} rad"
    )
    radar_map = radarsdf.load(path)
    assert not radar_map.has_intensity
    assert radar_map.config == radarsdf.FitConfig.quick()
    assert radar_map.report["returns"] == 6 * 1500


def test_wild_intensities_are_counted(scene, tmp_path, capsys):
    intensities = [np.where(np.arange(len(scan)) % 100, scan, -9999) for scan in scene.intensities]
    write_scans(tmp_path / "scans.npz", Scans(scene.points, scene.poses, intensities))
    assert call("fit", tmp_path / "scans.npz", "-o", tmp_path / "map.safetensors", "--quick") == 0
    assert "90 intensities cannot belong to the others, and are left out" in capsys.readouterr().out
    assert radarsdf.load(tmp_path / "map.safetensors").report["wild_intensities"] == 90


def test_what_was_held_out_is_to_be_evaluated(scans_file, tmp_path, capsys):
    path = tmp_path / "map.safetensors"
    assert call("fit", scans_file, "-o", path, "--quick", "--holdout", 3) == 0
    assert capsys.readouterr().out.splitlines()[-1] == f"and: radarsdf eval {path} {scans_file} --holdout 3"


def test_the_checkpoint_is_used_and_removed(scans_file, tmp_path, capsys):
    state, out = tmp_path / "state", tmp_path / "map.safetensors"
    state.write_bytes(b"no state of a fit")
    words = ["fit", scans_file, "-o", out, "--checkpoint", state, *FAST]
    assert str(state) in refusal(capsys, tmp_path, *words)
    state.unlink()
    assert call(*words) == 0
    assert files(tmp_path) == ["map.safetensors"]


def test_a_fit_that_diverges(scans_file, tmp_path, capsys):
    words = [
        "fit",
        scans_file,
        "-o",
        tmp_path / "map.safetensors",
        *FAST,
        "--set",
        "training.learning_rate=1e30",
    ]
    assert "learning rate" in refusal(capsys, tmp_path, *words)


def test_scans_that_do_not_exist(tmp_path, capsys):
    absent = tmp_path / "absent.npz"
    assert str(absent) in refusal(capsys, tmp_path, "fit", absent, "-o", tmp_path / "map.safetensors")


@pytest.mark.parametrize("suffix", [".npz", ".ply"])
def test_files_that_are_no_scans(garbage, tmp_path, capsys, suffix):
    path = garbage(suffix)
    assert str(path) in refusal(capsys, tmp_path, "fit", path, "-o", tmp_path / "map.safetensors")


def test_a_folder_that_does_not_exist(scans_file, tmp_path, capsys):
    out = tmp_path / "absent" / "map.safetensors"
    assert "absent" in refusal(capsys, tmp_path, "fit", scans_file, "-o", out, *FAST)


def test_a_map_is_known_by_its_ending(scans_file, tmp_path, capsys):
    for name in ("map", "map.npz"):
        said = refusal(capsys, tmp_path, "fit", scans_file, "-o", tmp_path / name, *FAST)
        assert "a map is written as .safetensors" in said


def test_choices_without_an_effect_are_refused(scans_file, tmp_path, capsys):
    out = tmp_path / "map.safetensors"
    for words, said in (
        (["--topic", "/radar"], "is no bag: topic is of bags alone"),
        (["--field", "intensity=Power"], "fields and columns are not used for .npz files"),
    ):
        assert said in refusal(capsys, tmp_path, "fit", scans_file, "-o", out, *words)
