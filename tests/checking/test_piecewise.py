"""Faults that begin or end at a scan, and large time offsets, are not taken for drift."""

import numpy as np
import pytest
import radarsdf
from radarsdf.checking.frames import check_clock
from radarsdf.checking.noise import check_drift
from radarsdf.checking.piecewise import check_order
from radarsdf.checking.recording import checked_input
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
    assert (
        f"scans {first} to {first + length - 1} and scans {second} to {second + length - 1}" in found.evidence
    )


def test_drift_is_no_other_fault(drive):
    poses = radarsdf.simulate.drifted(drive.poses[:SCANS], 0.05, 0.004, 1)
    drifted = checked_input(drive.points[:SCANS], poses)
    assert list(check_order(drifted, NUMBERS)) == []
    assert list(check_clock(drifted, far=True)) == []


def test_a_changed_mounting_is_no_drift(drive):
    turn = Rotation.from_euler("z", 6, degrees=True).as_matrix()
    points = [scan if i < 18 else scan @ turn for i, scan in enumerate(drive.points[:SCANS])]
    (found,) = check_drift(checked_input(points, drive.poses[:SCANS]), radarsdf.FitConfig(num_threads=1))
    assert found.name == "undecided"


def test_a_large_clock_offset_replaces_drift(drive):
    found = radarsdf.check(drive.points[15:], drive.poses[:SCANS])
    assert found[0].name == "clock_offset"
    assert "poses_drift" not in {finding.name for finding in found}
