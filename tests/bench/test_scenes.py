# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The scenes of the experiments: simulated ones, files and folders arrive in one form."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from radarsdf.io.npz import read_scans, write_scans
from radarsdf.io.scans import Scans
from radarsdf.simulate import SCENES
from scipy.spatial import cKDTree

from bench.paper.scenes import load_scene

from ..conftest import recorded_scans


@pytest.fixture(scope="module")
def wall():
    return load_scene("wall", frames=6, seed=3)


@pytest.mark.parametrize(("name", "min_range_m"), [("hugin", 2.5), ("oculii", 1.0), ("wall", 2.5)])
def test_simulated_scene(name, min_range_m):
    scene = load_scene(name, frames=2, seed=1)
    expected = SCENES[name](seed=1, frames=2)
    assert (scene.name, len(scene), scene.holdout_every) == (name, 2, 10)
    assert (scene.min_range_m, scene.max_range_m, scene.box) == (min_range_m, None, None)
    for i in range(2):
        assert scene.points[i].dtype == scene.intensities[i].dtype == np.float32
        assert_array_equal(scene.points[i], expected.points[i])
        assert_array_equal(scene.intensities[i], expected.intensities[i])
    assert_array_equal(scene.poses, expected.poses)
    assert_array_equal(scene.ground_truth, expected.ground_truth)
    assert scene.simulation.seed == 1


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
    with pytest.raises(ValueError, match="n must be at least 1, not 0"):
        wall.every_nth(0)


def test_first_is_the_beginning(wall):
    beginning = wall.first(2)
    assert len(beginning) == len(beginning.simulation) == 2
    assert_array_equal(beginning.points[1], wall.points[1])
    assert_array_equal(beginning.poses, wall.poses[:2])
    assert beginning.ground_truth is wall.ground_truth
    for n in (0, len(wall) + 1):
        with pytest.raises(ValueError, match=f"n must be from 1 to {len(wall)}, not {n}"):
            wall.first(n)


def test_split_holds_out_the_first_frame(wall):
    train, test = wall.split()
    assert_array_equal(train.poses, wall.poses[1:])
    assert_array_equal(test.poses, wall.poses[:1])
    assert train.ground_truth is test.ground_truth is wall.ground_truth
    assert (train.name, train.min_range_m) == (wall.name, wall.min_range_m)


def test_box(wall):
    assert wall.box is None
    box = load_scene("wall", frames=2, box=[[0, 0, 0], [1, 2, 3]]).box
    assert_array_equal(box, [[0, 0, 0], [1, 2, 3]])
    with pytest.raises(ValueError, match="a lower and an upper corner"):
        load_scene("wall", frames=2, box=[[0, 0, 0], [1, 0, 3]])


@pytest.mark.parametrize("spec", ["hugo", "scans.csv", "absent.npz"])
def test_what_is_no_scene(spec, tmp_path):
    (tmp_path / "scans.csv").touch()
    with pytest.raises(ValueError, match=r"hugin, oculii, wall.*\.npz"):
        load_scene(spec if spec == "hugo" else str(tmp_path / spec))


def test_too_few_frames():
    with pytest.raises(ValueError, match=r"at least 2.*not 1"):
        load_scene("hugin", frames=1)


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


def test_damaged_file(tmp_path):
    path = tmp_path / "street.npz"
    write_scans(path, scans_with_lidar(2))
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(ValueError, match="not a whole"):
        load_scene(str(path))


@pytest.mark.parametrize(("name", "frames"), [("r0144_0167", 24), ("r0133_0142", 10)])
def test_recorded_file(name, frames):
    path = recorded_scans(name)
    scene = load_scene(str(path))
    arrays = np.load(path)
    assert (len(scene), scene.holdout_every, scene.max_range_m) == (frames, 5, 60.0)
    assert sum(map(len, scene.points)) == arrays["static"].sum()
    assert sum(map(len, scene.intensities)) == arrays["static"].sum()
    lidar = read_scans(path).ground_truth
    assert 0.05 * len(lidar) < len(scene.ground_truth) < 0.9 * len(lidar)
    world = np.concatenate(
        [p @ T[:3, :3].T + T[:3, 3] for p, T in zip(scene.points, scene.poses, strict=True)]
    )
    assert cKDTree(world).query(scene.ground_truth)[0].max() < 1.0 + 1e-4
    train, test = scene.split()
    assert len(test) == -(-frames // 5)
    assert len(train) + len(test) == frames
