# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What is no argument at all is refused in one sentence of the package that names the argument."""

from __future__ import annotations

import traceback
from pathlib import Path

import numpy as np
import pytest
import radarsdf
from radarsdf import FitConfig, io, simulate
from radarsdf.evaluation import adjacent_angles, holdout, surface_metrics

from . import samples

PACKAGE = Path(radarsdf.__file__).parent
NO_PATH = (None, b"a", 2.5)
NO_ARRAY = ("a", {}, [[1], [2, 3]], np.array([1, {}], object), 1j)
NO_ITERABLE = (np.nan, 3, np.array(1.0))
NO_NUMBER = ("a", [], np.zeros((2, 2)), np.array(["a"]), {}, np.nan)


@pytest.fixture(scope="module")
def wall():
    return simulate.wall(frames=2)


@pytest.fixture(scope="module")
def a_map(tmp_path_factory):
    path = tmp_path_factory.mktemp("map") / "map.safetensors"
    path.write_bytes(samples.maps()[0])
    return radarsdf.load(path)


def refused(name, function, values, /, *given, **others):
    """Each of the `values` of the argument is refused by a line of the package that says the name."""
    for value in values:
        with pytest.raises((TypeError, ValueError)) as caught:
            function(*given, **others | {name: value})
        where = traceback.extract_tb(caught.value.__traceback__)[-1]
        assert Path(where.filename).is_relative_to(PACKAGE), (value, caught.value)
        assert where.line.startswith("raise"), (value, caught.value)
        assert name.removesuffix("s") in str(caught.value), (value, caught.value)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("function", [radarsdf.fit, radarsdf.estimate, radarsdf.check])
def test_scans(function, wall):
    given = {"points": wall.points, "poses": wall.poses, "intensities": wall.intensities}
    refused("points", function, (None, *NO_ITERABLE), **given)
    refused("intensities", function, NO_ITERABLE, **given)
    refused("poses", function, NO_ARRAY, **given)
    refused("config", function, ("a", {}, FitConfig), **given)


def test_fits(wall, tmp_path):
    given = {"points": wall.points, "poses": wall.poses, "intensities": wall.intensities}
    given["config"] = FitConfig.quick()
    refused("doppler_mps", radarsdf.fit, NO_ITERABLE, **given)
    refused("origin", radarsdf.fit, NO_ARRAY, **given)
    refused("intensity_range", radarsdf.fit, (*NO_ARRAY, 3, (1, 2, 3), (2, 1), (0, np.inf)), **given)
    refused("checkpoint", radarsdf.fit, NO_PATH[1:], **given)
    refused("progress", radarsdf.fit, ("no", [], np.zeros(2)), **given)
    scans = io.Scans(wall.points, wall.poses)
    refused("out", radarsdf.fit_tiles, NO_PATH, scans)
    refused("config", radarsdf.fit_tiles, ("a",), scans, tmp_path / "city")
    refused("scans", radarsdf.fit_tiles, (None, 3), out=tmp_path / "city")


def test_maps(a_map):
    refused("path", radarsdf.load, NO_PATH)
    refused("path", a_map.save, NO_PATH)
    for name in ("min_confidence", "max_uncertainty", "voxel_size"):
        refused(name, a_map.mesh, NO_NUMBER)
    refused("box", a_map.mesh, NO_ARRAY)
    refused("viewpoint", a_map.mesh, NO_ARRAY)
    pose = np.eye(4)
    refused("sensor", a_map.render, ("a", 3), pose)
    refused("noise", a_map.render, (None, "yes", np.zeros(0)), pose)
    refused("seed", a_map.render, ("a", -1, 1.5, None), pose, noise=True)


def test_files(wall, tmp_path):
    for function in (io.read_scans, io.read_mesh, io.read_points, io.read):
        refused("path", function, NO_PATH)
    refused("path", io.write_scans, NO_PATH, scans=io.Scans(wall.points, wall.poses))
    refused("scans", io.write_scans, ("a", None), tmp_path / "a.npz")
    refused("points", io.Scans, NO_ITERABLE, poses=wall.poses)
    refused("intensities", io.Scans, NO_ITERABLE, points=wall.points, poses=wall.poses)


def test_evaluation():
    refused("mesh", surface_metrics, ("a", None), ground_truth=np.zeros((1, 3)))
    refused("mesh", adjacent_angles, ("a", None))
    refused("frames", holdout, (*NO_ARRAY, np.array([None, 1], object)))


def test_simulation(wall):
    for name in ("specular", "lobe_width_rad", "looks", "texture_db", "mirror_loss_db", "reflectivity_db"):
        others = {"name": "wood", "reflectivity_db": 0.0}
        refused(name, simulate.Material, NO_NUMBER, **others)
    refused("seed", simulate.wall, ("a", -1, None, np.zeros(2)), frames=2)
    given = {"scene": wall.scene, "sensor": wall.sensor, "poses": wall.poses, "name": "a"}
    refused("scene", simulate.simulate, ("a", None), **given)
    refused("sensor", simulate.simulate, ("a", None), **given)
    refused("poses", simulate.simulate, (None, *NO_ARRAY), **given)
    refused("lidar_rays", simulate.simulate, ("a", -1, 2.5), **given)
