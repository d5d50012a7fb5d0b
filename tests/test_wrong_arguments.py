# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What is no argument at all is refused by an error that names the argument."""

import numpy as np
import pytest
import radarsdf
from radarsdf import FitConfig, io, simulate
from radarsdf.evaluation import holdout, intensity_metrics, surface_metrics

from . import samples

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
    """Each of the `values` of the argument is refused by an error that has its name."""
    for value in values:
        with pytest.raises((TypeError, ValueError), match=name.removesuffix("s")):
            function(*given, **others | {name: value})


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


def test_arrays_of_other_types_or_with_masked_values():
    for wrong in ([1 + 2j, 2, 3], ["1", "2", "3"], np.array(["2026-01-01"] * 3, "datetime64[D]")):
        with pytest.raises(TypeError, match="real numbers"):
            intensity_metrics(np.array(wrong), [1.0, 2.0, 3.0])
        with pytest.raises(TypeError, match="scan 0 must be real numbers"):
            radarsdf.check([np.array([wrong])], np.eye(4)[None])
    with pytest.raises(ValueError, match="masked"):
        intensity_metrics(np.ma.array([1.0, 2.0, 3.0], mask=[False, True, False]), [1.0, 2.0, 3.0])


def test_masked_integers_masks_and_returns(scene):
    volume = np.zeros((2, 2, 2))
    masked = np.ma.array(volume == 0, mask=volume == 0)
    scan = np.ma.array(scene.points[0], mask=scene.points[0] > 5)
    for call in (
        lambda: holdout(np.ma.array([1, 2, 3], mask=[0, 1, 0])),
        lambda: radarsdf.marching_cubes(np.ma.array(volume, mask=masked)),
        lambda: radarsdf.marching_cubes(volume, mask=masked),
        lambda: radarsdf.fit([scan], scene.poses[:1]),
    ):
        with pytest.raises(ValueError, match="masked"):
            call()


def test_generators_of_scans_are_counted(scene):
    config = FitConfig.quick(training={"intensity_iterations": 1})
    points, intensities = iter(scene.points), iter(scene.intensities)
    radar_map = radarsdf.fit(points, scene.poses, intensities, config=config, progress=False)
    assert radar_map.report["returns"] == sum(map(len, scene.points))
