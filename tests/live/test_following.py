# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Scans without poses are put where they were taken, or refused."""

from __future__ import annotations

import numpy as np
import pytest
import radarsdf
from radarsdf import FitConfig, LiveMap
from radarsdf.live.following import Lost

from ..poses.drift import first

SETTINGS = FitConfig(num_threads=1)


@pytest.fixture(scope="module")
def drive():
    scans = first(radarsdf.simulate.oculii, 25, seed=91, frames=60)
    return scans, radarsdf.simulate.measured_motion(scans)


@pytest.mark.parametrize(("sign", "most_mps"), [(1, np.inf), (-1, 4.0)])  # it drives at 7 m/s
def test_scans_are_put_where_they_were_taken(drive, sign, most_mps):
    scans, motion = drive
    live = LiveMap(SETTINGS)
    true = np.linalg.inv(scans.poses[0]) @ scans.poses
    for i in range(25):
        done = live.integrate(
            scans.points[i],
            intensities=scans.intensities[i],
            doppler_mps=_folded(sign * np.asarray(motion.doppler_mps[i]), most_mps),
            time=motion.times_s[i],
        )
    way_m = np.linalg.norm(true[24, :3, 3])
    assert np.linalg.norm(done.pose[:3, 3] - true[24, :3, 3]) < 0.006 * way_m  # 0.0094 without Doppler
    assert len(live.mesh().faces) > 3_000


def _folded(speeds, most_mps):
    return speeds if np.isinf(most_mps) else (speeds + most_mps) % (2 * most_mps) - most_mps


def test_scans_go_on_from_given_poses(drive):
    scans, motion = drive
    live = LiveMap(SETTINGS)
    for i in range(20):
        pose = scans.poses[i] if i < 10 else None
        done = live.integrate(
            scans.points[i], pose, doppler_mps=motion.doppler_mps[i], time=motion.times_s[i]
        )
    assert np.linalg.norm(done.pose[:3, 3] - scans.poses[19, :3, 3]) < 0.1


def test_what_cannot_be_followed_is_refused_and_leaves_nothing(drive):
    scans, motion = drive
    live, other = LiveMap(SETTINGS), LiveMap(SETTINGS)

    def add(to, i, **changes):
        scan = {"points": scans.points[i], "doppler_mps": motion.doppler_mps[i], "time": motion.times_s[i]}
        return to.integrate(**scan | changes)

    for i in range(8):
        add(other, i)
        add(live, i)
        with pytest.raises(ValueError, match="must be later"):
            add(live, i)
        with pytest.raises(ValueError, match="a pose, or a time"):
            add(live, i, time=None)
    noise = np.random.default_rng(0).uniform(-30, 30, (2000, 3))
    with pytest.raises(Lost, match="nowhere near"):  # a scan of clutter, after a gap in time
        add(live, 8, points=noise, doppler_mps=None, time=motion.times_s[8] + 3)
    assert add(live, 8).pose.tobytes() == add(other, 8).pose.tobytes()


def test_the_way_along_a_wall_is_not_guessed():
    scans = radarsdf.simulate.wall(seed=91, frames=24)
    live = LiveMap(SETTINGS)

    def follow(speeds=None):
        for i in range(len(scans)):
            live.integrate(scans.points[i], time=0.1 * i, doppler_mps=None if speeds is None else speeds[i])

    with pytest.raises(Lost, match="do not tell how the sensor moves: give their Doppler"):
        follow()
    assert len(live) < len(scans)
    live, rng = LiveMap(SETTINGS), np.random.default_rng(0)
    speeds = [rng.uniform(-20, 20, len(scan)) for scan in scans.points]
    with pytest.raises(Lost, match="The Doppler is not used"):
        follow(speeds)


def test_a_sensor_that_stands_leaves_the_sign_of_its_doppler_open(drive):
    scans, motion = drive
    live, rng = LiveMap(SETTINGS), np.random.default_rng(0)
    for i in range(6):
        noisy = scans.points[0] + rng.normal(0, 0.02, scans.points[0].shape)
        live.integrate(noisy, doppler_mps=rng.normal(0, 0.05, len(noisy)), time=motion.times_s[i])
        assert live._follower._sign == 0
    for i in range(1, 25):
        live.integrate(scans.points[i], doppler_mps=-motion.doppler_mps[i], time=motion.times_s[i] + 0.5)
    assert live._follower._sign == -1
