# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Good data have no finding worse than a note; broken in one way, the finding is named."""

from __future__ import annotations

import numpy as np
import pytest
import radarsdf
from radarsdf.checking.check import check_cheaply
from radarsdf.checking.frames import FULL, check_frames
from radarsdf.checking.recording import Recording
from scipy.spatial.transform import Rotation

from tests.conftest import recorded_file, recorded_scans

from .breakages import slow

_CAMERA_OF_RADAR = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])


def with_positions(poses, positions):
    moved = poses.copy()
    moved[:, :3, 3] = positions
    return moved


def in_world(points, poses):
    return [scan @ pose[:3, :3].T + pose[:3, 3] for scan, pose in zip(points, poses, strict=True)]


def of_vehicle(poses, axis, degrees):
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler(axis, -degrees, degrees=True).as_matrix()
    return poses @ turn


def with_rolled_quaternions(poses):
    rolled = poses.copy()
    quaternions = np.roll(Rotation.from_matrix(poses[:, :3, :3]).as_quat(), 1, axis=1)
    rolled[:, :3, :3] = Rotation.from_quat(quaternions).as_matrix()
    return rolled


BREAKAGES = {
    "quaternion_order": lambda points, poses: (points, with_rolled_quaternions(poses)),
    "sensor_turned": lambda points, poses: (points, of_vehicle(poses, "z", 20)),
    "points_in_world_frame": lambda points, poses: (in_world(points, poses), poses),
    "poses_inverted": lambda points, poses: (points, np.linalg.inv(poses)),
    "camera_frame": lambda points, poses: ([p @ _CAMERA_OF_RADAR.T for p in points], poses),
    "mirrored": lambda points, poses: ([p * [1, -1, 1] for p in points], poses),
    "axes_swapped": lambda points, poses: ([p[:, [1, 0, 2]] for p in points], poses),
    "units": lambda points, poses: (points, with_positions(poses, 100 * poses[:, :3, 3])),
}


def worse_than_notes(findings):
    return [finding.name for finding in findings if finding.severity != "note"]


@pytest.fixture(scope="module", params=["wall", "astyx", "oculii"])
def good(request):
    scans = getattr(radarsdf.simulate, request.param)(
        frames={"wall": 24, "astyx": 12, "oculii": 48}[request.param]
    )
    return scans.points, scans.poses


def found_in(points, poses):
    """The findings of both checks; of the cheap one alone where the whole one takes up to ten times as long."""
    return [check_cheaply(points, poses), *([radarsdf.check(points, poses)] if len(points) == 12 else [])]


def test_good_data_have_no_finding(good):
    assert worse_than_notes(radarsdf.check(*good)) == []
    assert worse_than_notes(check_cheaply(*good)) == []


@pytest.mark.parametrize("finding", BREAKAGES)
def test_a_breakage_is_named(good, finding):
    for found in found_in(*BREAKAGES[finding](*good)):
        assert (found[0].name, found[0].severity) == (finding, "error")


@pytest.mark.parametrize("how", ["equal", "zero"])
def test_positions_that_stay_while_the_scans_change_are_named(good, how):
    points, poses = good
    held = np.repeat(poses[:1], len(poses), axis=0) if how == "equal" else with_positions(poses, 0)
    found = radarsdf.check(points, held)
    told = len(points) >= 24  # so many scans tell that the sensor moved
    assert (found[0].name, found[0].severity) == ("poses_stand_still", "error" if told else "warning")


def room_of(poses, rng, returns=250, noise_m=0.1):
    """Scans of a room of 12 m x 9 m x 5 m, by a sensor that looks 60 degrees to both sides."""
    scans = []
    for pose in poses:
        azimuth, elevation = rng.uniform(-1.0, 1.0, returns), rng.uniform(-0.3, 0.3, returns)
        rays = np.stack(
            [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], 1
        )
        world = rays @ pose[:3, :3].T
        walls_m = (np.where(world > 0, [8, 4, 3], [-4, -5, -2]) - pose[:3, 3]) / world
        scans.append(rays * (walls_m.min(axis=1, keepdims=True) + rng.normal(0, noise_m, (returns, 1))))
    return scans


@pytest.mark.parametrize("scans", [6, 24])
def test_a_sensor_that_stands_still_is_no_error(scans):
    poses = np.repeat(np.eye(4)[None], scans, axis=0)
    found = radarsdf.check(room_of(poses, np.random.default_rng(0)), poses)
    assert worse_than_notes(found) == ["poses_stand_still"]
    assert found[0].severity == "warning"


@pytest.mark.parametrize("scans", [10, 40])
def test_a_slow_sensor_has_no_finding(scans):
    poses = np.repeat(np.eye(4)[None], scans, axis=0)
    poses[:, 0, 3] = 0.02 * np.arange(scans)
    assert worse_than_notes(radarsdf.check(room_of(poses, np.random.default_rng(0)), poses)) == []


def test_a_slow_sensor_with_coarse_cells_has_no_finding():
    data = slow("yard", 0.2, seed=1, cell=0.5)
    assert worse_than_notes(check_cheaply(data.points, data.poses)) == []


@pytest.mark.parametrize("rows", [slice(None), slice(-40, None)])
def test_a_small_gain_is_no_error_however_certain(rows):
    with np.load(recorded_file("other_simulator/loading_yard.npz")) as yard:
        points = [yard["points"][yard["frame"] == i] for i in range(len(yard["poses"]))]
        poses = yard["poses"].astype(np.float64)
    recording = Recording.of(points[rows], poses[rows], None, None, None)
    (found,) = check_frames(recording, FULL)
    assert found.severity == "note"
    feet = Recording.of(points[rows], with_positions(poses, poses[:, :3, 3] / 0.3048)[rows], None, None, None)
    assert [(f.name, f.severity) for f in check_frames(feet, FULL)] == [("units", "error")]


@pytest.mark.parametrize(("frames", "seed"), [(6, 2), (4, 1), (5, 3), (8, 1)])
def test_few_sparse_scans_have_no_finding(frames, seed):
    scans = radarsdf.simulate.oculii(frames=frames, seed=seed)
    assert worse_than_notes(radarsdf.check(scans.points, scans.poses)) == []
    assert worse_than_notes(check_cheaply(scans.points, scans.poses)) == []


def test_a_clock_that_is_off_is_found_where_the_motion_changes():
    scans = radarsdf.simulate.wall(frames=30)
    found = radarsdf.check(scans.points[1:], scans.poses[:-1])
    assert "clock_offset" in worse_than_notes(found)


@pytest.mark.parametrize("name", ["r0009_0024", "r0057_0068", "r0133_0142", "r0144_0167", "r0309_0320"])
def test_recorded_drives_have_no_finding_until_their_poses_are_inverted(name):
    with np.load(recorded_scans(name)) as drive:
        points = [drive["points"][drive["frame"] == i] for i in range(len(drive["poses"]))]
        poses = drive["poses"]
    assert worse_than_notes(radarsdf.check(points, poses)) == []
    assert check_cheaply(points, np.linalg.inv(poses))[0].name == "poses_inverted"
