# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Drives in legs: where they lead, when they are scanned, and what is measured on the way."""

from __future__ import annotations

import numpy as np
import pytest
from radarsdf.simulate import Leg, drive_legs, measured_imu, measured_motion, oculii, wall
from scipy.spatial.transform import Rotation

SPEED_MPS = 4.0


@pytest.fixture(scope="module")
def straight():
    return wall(seed=2, frames=9)


def speeds_mps(drive):
    way = drive.way_poses[:, :3, 3]
    return np.linalg.norm(np.diff(way, axis=0), axis=1) / np.diff(drive.way_times_s)


def test_there_and_back_with_a_turn_on_the_spot_and_a_gap(straight):
    legs = [Leg(ahead_m=3, wait_s=0.5), Leg(turn_deg=180), Leg(ahead_m=3, scanned=False), Leg(wait_s=0.3)]
    drive = drive_legs(straight, legs, speed_mps=SPEED_MPS, rate_hz=5)
    poses, ends = drive.simulation.poses, drive.way_poses[[0, -1]]
    assert len(drive.simulation) == len(drive.times_s)
    np.testing.assert_allclose(ends[0, :3, 3], ends[1, :3, 3], atol=1e-6)
    assert Rotation.from_matrix(ends[0, :3, :3].T @ ends[1, :3, :3]).magnitude() == pytest.approx(np.pi)
    assert speeds_mps(drive).max() == pytest.approx(SPEED_MPS, rel=0.05)
    gaps = np.diff(drive.times_s)
    assert (gaps > 0.3).sum() == 1
    assert gaps.max() == pytest.approx(1.875 * 3 / SPEED_MPS, abs=0.25)
    # Each pose of a scan is that of the way at its time.
    rows = np.searchsorted(drive.way_times_s, drive.times_s - 1e-6)
    np.testing.assert_array_equal(drive.way_poses[rows], poses)


def test_a_path_that_is_closed_is_driven_round_and_round():
    court = oculii(seed=2, frames=60)
    step_m = np.linalg.norm(np.diff(court.poses[:, :3, 3], axis=0), axis=1)
    drive = drive_legs(court, [Leg(ahead_m=1.5 * 60 * step_m.mean())], rate_hz=0.5)
    length_m = speeds_mps(drive).sum() / 50
    assert length_m == pytest.approx(1.5 * 60 * step_m.mean(), rel=0.01)
    assert (
        np.linalg.norm(drive.way_poses[:, :2, 3], axis=1).max() < 1.05 * np.abs(court.poses[:, :2, 3]).max()
    )


def test_what_is_measured_beside_a_gap_is_that_of_the_way(straight):
    legs = [Leg(ahead_m=2), Leg(wait_s=2, scanned=False), Leg(ahead_m=2)]
    drive = drive_legs(straight, legs, rate_hz=10)
    way = (drive.way_times_s, drive.way_poses)
    motion = measured_motion(drive.simulation, times_s=drive.times_s, way=way, movers=0, doppler_noise_mps=0)
    standing = np.abs(drive.times_s - 0.9375) < 0.05  # as the first leg ends
    assert standing.any()
    assert max(np.abs(motion.doppler_mps[i]).max() for i in np.flatnonzero(standing)) < 0.2
    imu = measured_imu(drive.way_poses, drive.way_times_s)
    resting = (imu.times_s > 1.2) & (imu.times_s < 2.6)
    np.testing.assert_allclose(imu.specific_force[resting].mean(axis=0), [0, 0, 9.8], atol=0.5)


def test_legs_that_lead_nowhere(straight):
    with pytest.raises(ValueError, match="beyond the path of"):
        drive_legs(straight, [Leg(ahead_m=-1)])
