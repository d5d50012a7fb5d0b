# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The scenes of the experiments: simulated ones, files and folders arrive in one form."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from radarsdf.io.npz import write_scans
from radarsdf.scans import Scans

from bench.scenes import load_scene


@pytest.fixture(scope="module")
def wall():
    return load_scene("wall", frames=6, seed=3)


def test_every_nth_takes_the_simulation_along(wall):
    third = wall.every_nth(3)
    assert len(third) == 2
    assert_array_equal(third.points[1], wall.points[3])
    assert_array_equal(third.intensities[1], wall.intensities[3])
    assert_array_equal(third.poses, wall.poses[[0, 3]])
    assert third.ground_truth is wall.ground_truth
    assert (
        third.simulation.is_surface().size
        == len(third.simulation.world_points())
        == sum(map(len, third.points))
    )
    assert_array_equal(third.simulation.noiseless_intensities[1], wall.simulation.noiseless_intensities[3])


@pytest.mark.parametrize("spec", ["hugo", "scans.csv", "absent.npz"])
def test_what_is_no_scene(spec, tmp_path):
    (tmp_path / "scans.csv").touch()
    with pytest.raises(ValueError, match=r"hugin.*\.npz"):
        load_scene(spec if spec == "hugo" else str(tmp_path / spec))


def scans_with_lidar(frames):
    """Each scan sees a point 2 m, one 10 m and one 70 m ahead; lidar points are beside them and elsewhere."""
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, 1, 3] = 0.01 * np.arange(frames)
    points = [np.array([[2, 0, 0], [10, 0, 0], [70, 0, 0]], np.float32)] * frames
    intensities = [np.array([1, 2, 3], np.float32)] * frames
    lidar = np.array([[2, 0, 0], [10, 0, 0.9], [10, 0, 1.5], [70, 0, 0], [30, 0, 0]], np.float32)
    return Scans(points, poses, intensities, lidar)


@pytest.mark.parametrize(("frames", "every"), [(49, 5), (50, 10)])
def test_file(frames, every, tmp_path):
    write_scans(tmp_path / "street.npz", scans_with_lidar(frames))
    scene = load_scene(str(tmp_path / "street.npz"))
    assert (scene.name, len(scene), scene.holdout_every) == ("street", frames, every)
    assert (scene.min_range_m, scene.max_range_m, scene.simulation) == (2.5, 60.0, None)
    assert_array_equal(scene.points[1], [[2, 0, 0], [10, 0, 0], [70, 0, 0]])
    assert_array_equal(scene.intensities[1], [1, 2, 3])
    assert_array_equal(scene.ground_truth, np.float32([[10, 0, 0.9]]))
    assert len(load_scene(str(tmp_path / "street.npz"), frames=3)) == 3
