# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Arrays that are no real numbers, or partly masked, are refused; scans may come from a generator."""

from __future__ import annotations

import numpy as np
import pytest
import radarsdf
import trimesh
from radarsdf import FitConfig, marching_cubes, simulate
from radarsdf.checks import real_array
from radarsdf.cli import main
from radarsdf.evaluation import gamma_from_moments, holdout, intensity_metrics
from radarsdf.io.npz import write_scans
from radarsdf.io.scans import Scans
from radarsdf.map.colors import intensity_colors
from radarsdf.render.picture import render

WRONG = {
    "complex": np.array([1 + 2j, 2, 3]),
    "text": np.array(["1", "2", "3"]),
    "dates": np.array(["2026-01-01"] * 3, "datetime64[D]"),
}
MASKED = np.ma.array([1.0, 2.0, 3.0], mask=[False, True, False])
TAKERS = {
    "gamma_from_moments": gamma_from_moments,
    "intensity_colors": lambda values: intensity_colors(values, 0.0, 1.0),
    "intensity_metrics": lambda values: intensity_metrics(values, [1.0, 2.0, 3.0]),
    "real_array": lambda values: real_array(values, "values"),
}


@pytest.mark.parametrize("take", TAKERS.values(), ids=TAKERS)
@pytest.mark.parametrize("kind", WRONG)
def test_other_types_are_no_numbers(take, kind):
    with pytest.raises(TypeError, match="must be real numbers"):
        take(WRONG[kind])


@pytest.mark.parametrize("take", TAKERS.values(), ids=TAKERS)
def test_what_is_masked_is_no_value(take):
    with pytest.raises(ValueError, match="has masked values"):
        take(MASKED)
    with pytest.raises(ValueError, match="has masked values"):
        real_array([MASKED, MASKED], "values")
    take(np.ma.array([1.0, 2.0, 3.0], mask=False))


def test_masked_integers_and_masks():
    with pytest.raises(ValueError, match="has masked values"):
        holdout(np.ma.array([1, 2, 3], mask=[0, 1, 0]))
    volume = np.zeros((2, 2, 2))
    with pytest.raises(ValueError, match="has masked values"):
        marching_cubes(np.ma.array(volume, mask=volume == 0))
    with pytest.raises(ValueError, match="has masked values"):
        marching_cubes(volume, mask=np.ma.array(volume == 0, mask=volume == 0))


def test_masked_returns(scene):
    scan = np.ma.array(scene.points[0], mask=scene.points[0] > 5)
    with pytest.raises(ValueError, match="scan 0 has masked values"):
        radarsdf.fit([scan], scene.poses[:1])


@pytest.mark.parametrize("kind", WRONG)
def test_eval_refuses_a_file_of_other_types(kind, tmp_path, capsys):
    trimesh.creation.box().export(tmp_path / "mesh.ply")
    np.save(tmp_path / "truth.npy", np.tile(WRONG[kind], (3, 1)))
    assert main(["eval", str(tmp_path / "mesh.ply"), str(tmp_path / "truth.npy")]) == 1
    assert "not one row of numbers a point" in capsys.readouterr().err


def test_a_picture_takes_real_viewpoints():
    with pytest.raises(TypeError, match="viewpoint must be real numbers"):
        render(trimesh.creation.box(), viewpoint=WRONG["text"])


def test_generators_of_scans_are_counted(scene):
    radar_map = radarsdf.fit(
        (scan for scan in scene.points),
        scene.poses,
        (values for values in scene.intensities),
        config=FitConfig.quick(training={"intensity_iterations": 1}),
        progress=False,
    )
    assert radar_map.report["returns"] == sum(map(len, scene.points))


@pytest.mark.parametrize(
    "scene_of", simulate.SCENES.values() if hasattr(simulate, "SCENES") else [simulate.wall]
)
def test_no_frames_are_not_the_default_number(scene_of):
    with pytest.raises(ValueError, match="frames must be positive"):
        scene_of(frames=0)


@pytest.mark.parametrize("command", ["fit", "eval"])
def test_a_holdout_of_none_is_not_no_holdout(command, tmp_path, scene, capsys):
    write_scans(tmp_path / "scans.npz", Scans(scene.points, scene.poses, scene.intensities, None))
    radarsdf.fit(scene.points, scene.poses, config=FitConfig.quick(), progress=False).save(
        tmp_path / "map.safetensors"
    )
    words = {
        "fit": ["fit", str(tmp_path / "scans.npz"), "-o", str(tmp_path / "out.safetensors")],
        "eval": ["eval", str(tmp_path / "map.safetensors"), str(tmp_path / "scans.npz")],
    }
    assert main([*words[command], "--holdout", "0"]) == 1
    assert "cannot hold out every 0th" in capsys.readouterr().err
