"""Faults that begin or end at a scan are not taken for drift."""

import numpy as np
import pytest
import radarsdf
from radarsdf.checking.frames import check_clock
from radarsdf.checking.noise import check_drift
from radarsdf.checking.piecewise import exchanged_scans
from radarsdf.checking.recording import checked_input
from scipy.spatial.transform import Rotation

SCANS = 40
NUMBERS = np.arange(SCANS)
CONFIG = radarsdf.FitConfig(num_threads=1)


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
    finding, back = exchanged_scans(
        checked_input([drive.points[i] for i in order], drive.poses[:SCANS]), NUMBERS
    )
    assert finding.name == "scans_exchanged"
    assert np.array_equal(order[back], NUMBERS)


def test_right_order_has_no_finding(drive):
    assert exchanged_scans(checked_input(drive.points[:SCANS], drive.poses[:SCANS]), NUMBERS) is None


def test_a_changed_mounting_is_no_drift(drive):
    turn = Rotation.from_euler("z", 6, degrees=True).as_matrix()
    points = [scan if i < 18 else scan @ turn for i, scan in enumerate(drive.points[:SCANS])]
    (found,) = check_drift(checked_input(points, drive.poses[:SCANS]), CONFIG)
    assert found.name == "mounting_changed"


def test_a_large_clock_offset_is_found(drive):
    (found,) = check_clock(checked_input(drive.points[15:], drive.poses[:SCANS]))
    assert found.name == "clock_offset"
