"""Faults that begin or end at a scan, and large time offsets, are not taken for drift."""

import numpy as np
import pytest
import radarsdf
from radarsdf.checking.recording import checked_input
from radarsdf.checking.trajectory import check_drift, check_order
from scipy.spatial.transform import Rotation

SCANS = 40
NUMBERS = np.arange(SCANS)


@pytest.fixture(scope="module")
def drive():
    return radarsdf.simulate.wall(frames=SCANS + 15, seed=1)


@pytest.mark.parametrize(("first", "second", "length"), [(10, 30, 1), (8, 25, 5), (10, 20, 10)])
def test_exchanged_blocks_are_found(drive, first, second, length):
    order = NUMBERS.copy()
    order[first : first + length], order[second : second + length] = (
        NUMBERS[second : second + length],
        NUMBERS[first : first + length],
    )
    broken = checked_input([drive.points[i] for i in order], drive.poses[:SCANS])
    (found,) = check_order(broken, NUMBERS)
    assert found.name == "scans_exchanged"
    parts = [f"scans {start} to {start + length - 1}" for start in (first, second)]
    assert " and ".join(parts) in found.evidence


def turned(pose, degrees):
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    return pose @ turn


@pytest.mark.parametrize(
    ("name", "words", "broken"),
    [
        ("poses_drift", "", lambda poses: radarsdf.simulate.drifted(poses[:SCANS], 0.05, 0.004, 1)),
        ("clock_offset", "scans earlier", lambda poses: poses[1 : SCANS + 1]),
        ("clock_offset", "about 15 scans earlier", lambda poses: poses[15:]),
        ("clock_offset", "about 10 scans", lambda poses: np.roll(poses[:SCANS], 10, axis=0)),
        ("sensor_turned", "degrees against the frame of the poses (", lambda poses: turned(poses[:SCANS], 3)),
        (
            "sensor_turned",
            "against the frame of the poses from scan 18 on",
            lambda poses: np.concatenate([poses[:18], turned(poses[18:SCANS], 10)]),
        ),
    ],
)
def test_a_fault_that_explains_refined_poses_better_than_drift_is_named(drive, name, words, broken):
    recording = checked_input(drive.points[:SCANS], broken(drive.poses))
    assert list(check_order(recording, NUMBERS)) == []
    (found,) = check_drift(recording, radarsdf.FitConfig(num_threads=1))
    assert (found.name, words in found.evidence) == (name, True), found


def test_reversed_scans_are_no_mirrored_ones():
    drive = radarsdf.simulate.hugin(frames=40, seed=3)
    assert radarsdf.check(drive.points[::-1], drive.poses)[0].name == "scans_exchanged"
