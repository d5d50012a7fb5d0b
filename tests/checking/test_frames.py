"""Good data have no finding worse than a note; each breakage has its finding."""

import numpy as np
import pytest
import radarsdf
from radarsdf.checking.check import check_cheaply
from radarsdf.checking.frames import CHEAP, FULL, check_frames, check_still
from radarsdf.checking.recording import checked_input

from tests.conftest import recorded_file, recorded_scans
from tests.poses.drift import thinned

from .breakages import Data, slow


def with_positions(poses, positions):
    moved = poses.copy()
    moved[:, :3, 3] = positions
    return moved


def worse_than_notes(findings):
    return [finding.name for finding in findings if finding.severity != "note"]


@pytest.fixture(scope="module", params=["astyx", "oculii"])
def good(request):
    frames, every = {"astyx": (12, 1), "oculii": (48, 2)}[request.param]
    scans = thinned(getattr(radarsdf.simulate, request.param)(frames=frames), every)
    return Data(scans.points, scans.poses, scans.intensities)


def test_good_data_have_no_finding(good):
    assert worse_than_notes(radarsdf.check(good.points, good.poses)) == []
    assert worse_than_notes(check_cheaply(good.points, good.poses)) == []


@pytest.mark.parametrize("how", ["equal", "zero"])
def test_constant_positions_of_changing_scans_are_named(good, how):
    points, poses = good.points, good.poses
    held = np.repeat(poses[:1], len(poses), axis=0) if how == "equal" else with_positions(poses, 0)
    (found,) = check_still(checked_input(points, held))
    moved = len(points) >= 24  # this many scans show that the sensor moved
    assert (found.name, found.severity) == ("poses_stand_still", "error" if moved else "warning")


def room_of(poses, rng, returns=250, noise_m=0.1):
    """Scans of a room of 12 m x 9 m x 5 m by a sensor with a field of view of ±60 degrees."""
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
def test_a_stationary_sensor_has_no_finding(scans):
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


def test_a_small_gain_is_no_error_at_any_significance():
    with np.load(recorded_file("other_simulator/loading_yard.npz")) as yard:
        count = len(yard["poses"])
        points = [yard["points"][yard["frame"] == i] for i in range(count - 40, count)]
        poses = yard["poses"][-40:].astype(np.float64)
    (found,) = check_frames(checked_input(points, poses), FULL)
    assert found.severity == "note"
    feet = checked_input(points, with_positions(poses, poses[:, :3, 3] / 0.3048))
    assert [(f.name, f.severity) for f in check_frames(feet, CHEAP)] == [("units", "error")]


@pytest.mark.parametrize(("frames", "seed"), [(4, 1), (8, 1)])
def test_few_sparse_scans_have_no_finding(frames, seed):
    scans = radarsdf.simulate.oculii(frames=frames, seed=seed)
    assert worse_than_notes(radarsdf.check(scans.points, scans.poses)) == []


@pytest.mark.parametrize("name", ["r0009_0024", "r0133_0142"])
def test_recorded_drives_have_no_finding_until_their_poses_are_inverted(name):
    with np.load(recorded_scans(name)) as drive:
        points = [drive["points"][drive["frame"] == i] for i in range(len(drive["poses"]))]
        poses = drive["poses"]
    assert worse_than_notes(check_cheaply(points, poses)) == []
    assert check_cheaply(points, np.linalg.inv(poses))[0].name == "poses_inverted"
