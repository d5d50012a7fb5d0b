# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Drives in windows: bounded memory, and the same way as of all scans at once."""

from __future__ import annotations

import numpy as np
import pytest
import radarsdf
from radarsdf.evaluation import trajectory_metrics
from radarsdf.io import Scan
from radarsdf.poses import windows
from radarsdf.poses.odometry import UnobservedMotionError
from radarsdf.poses.rigid import moved, transform
from radarsdf.poses.windows import JoinedPoses, find_in_windows, refine_in_windows

from .drift import drifting_drive, trajectory

CONFIG = radarsdf.FitConfig(num_threads=1)


@pytest.fixture
def short_windows(monkeypatch):
    """Of 30 scans, of which 8 are in the next one, too: the drive takes two."""
    monkeypatch.setattr(windows, "_SCANS", 30)


@pytest.mark.usefixtures("short_windows")
def test_windows_overlap_and_read_each_scan_once(monkeypatch):
    read = []

    def scans():
        for i in range(60):
            read.append(i)
            yield Scan(np.full((10, 3), float(i)), np.eye(4))

    found = list(windows.windows(scans()))
    assert read == list(range(60))
    assert [(window.begin, len(window.scans), window.common) for window in found] == [
        (0, 30, 0),
        (22, 30, 8),
        (44, 16, 8),
    ]
    for window in found:
        assert [int(scan.points[0, 0]) for scan in window.scans] == list(
            range(window.begin, window.begin + len(window.scans))
        )
    monkeypatch.setattr(windows, "_RETURNS", 100)
    monkeypatch.setattr(windows, "_LEAST_SCANS", 8)
    assert len(next(windows.windows(scans())).scans) == 10
    assert list(windows.windows(iter([]))) == []


def test_windows_of_one_way_are_joined_to_it():
    true = trajectory(50)
    joined = JoinedPoses()
    for k, begin in enumerate(range(0, 40, 10)):
        T = transform(np.array([0.1, -0.2, 0.3]) * k, np.array([5.0, -3.0, 1.0]) * k)
        covariance = np.tile(np.diag([1.0, 2, 3, 4, 5, 6]), (20, 1, 1))
        joined.add(begin, np.einsum("ij,fjk->fik", T, true[begin : begin + 20]), covariance)
    np.testing.assert_allclose(joined.poses, true, atol=1e-9)
    assert not joined.pieces.any()
    # Only axes are turned: what is known stays as well known.
    np.testing.assert_allclose(np.trace(joined.covariance, axis1=1, axis2=2), 21, rtol=1e-9)


def test_what_differs_between_windows_is_spread_over_what_they_have_in_common():
    true = trajectory(30)
    bent = moved(true[10:], np.linspace(-1, 1, 20)[:, None] * [0.1, 0, 0, 0, 0, 0.01])
    joined = JoinedPoses()
    joined.add(0, true[:20], np.zeros((20, 6, 6)))
    joined.add(10, bent, np.zeros((20, 6, 6)))
    off_m = np.linalg.norm((joined.poses - true)[:, :3, 3], axis=1)
    assert off_m[:10].max() == 0
    assert np.abs(np.diff(off_m)).max() < 0.04  # without: 0.06


def test_pieces_are_joined_where_they_go_on():
    true = trajectory(40)
    joined = JoinedPoses()
    joined.add(0, true[:20], np.zeros((20, 6, 6)), np.repeat([0, 1], [12, 8]))
    joined.add(15, true[15:30], np.zeros((15, 6, 6)), np.repeat([0, 1], [10, 5]))
    np.testing.assert_array_equal(joined.pieces, np.repeat([0, 1, 2], [12, 13, 5]))
    np.testing.assert_allclose(joined.poses, true[:30], atol=1e-9)
    joined.skip(25, 10)
    joined.add(33, true[33:], np.zeros((7, 6, 6)))
    # Each scan without a pose is a piece of its own, which nobody would use.
    np.testing.assert_array_equal(joined.pieces[30:], [3, 4, 5, 6, 6, 6, 6, 6, 6, 6])


def test_no_tilt_adds_up_between_levelled_windows():
    true = trajectory(30)
    tilted = np.einsum("ij,fjk->fik", transform(np.array([0.02, 0, 0.5]), np.zeros(3)), true[10:])
    joined = JoinedPoses()
    joined.add(0, true[:20], np.zeros((20, 6, 6)), upright=True)
    joined.add(10, tilted, np.zeros((20, 6, 6)), upright=True)
    np.testing.assert_allclose(
        joined.poses[-1, 2, :3], tilted[-1, 2, :3], atol=1e-9
    )  # of up, in the radar's frame


@pytest.mark.usefixtures("short_windows")
def test_drift_is_mended_window_by_window():
    scans, true = drifting_drive()
    refined, given = refine_in_windows(scans, CONFIG, False)
    np.testing.assert_array_equal(given, scans.poses)
    assert refined.improved
    assert refined.report["windows"] == [True, True]
    assert "in 2 of 2 windows" in refined.report["verdict"]
    before, after = (trajectory_metrics(poses, true)["absolute_m"] for poses in (given, refined.poses))
    assert after < 0.4 * before
    assert refined.covariance.shape == (48, 6, 6)


@pytest.mark.usefixtures("short_windows")
def test_poses_are_found_window_by_window():
    scans, true = drifting_drive()
    found = find_in_windows(scans, None, CONFIG, False)
    assert found.report["pieces"] == 1
    assert trajectory_metrics(found.poses, true)["absolute_m"] < 0.05
    assert "2 windows" in found.report["verdict"]


@pytest.mark.usefixtures("short_windows")
def test_a_window_that_tells_nothing_ends_a_piece(monkeypatch):
    scans, _ = drifting_drive()
    asked, told = [], "the returns alone do not tell how the sensor moved"

    def odometry(part, **given):
        asked.append(len(part.points))
        if len(asked) == 2:
            raise UnobservedMotionError(told)
        return radarsdf.odometry(part, **given)

    monkeypatch.setattr(windows, "odometry", odometry)
    found = find_in_windows(scans, None, CONFIG, False)
    assert found.longest_piece() == slice(0, 30)
    assert found.report["notes"] == [f"There are no poses of the scans 22 to 47: {told}"]


@pytest.mark.usefixtures("short_windows")
def test_errors_name_the_window():
    scans, _ = drifting_drive()
    bad = scans.select(np.arange(48))
    bad.points[40] = np.zeros((3, 2))
    with pytest.raises(ValueError, match=r"scans 22 to 47, numbered from the first of them: .*scan 18"):
        refine_in_windows(bad, CONFIG, False)
    with pytest.raises(ValueError, match="there are no scans"):
        refine_in_windows([], CONFIG, False)
