"""Doppler and times that contradict the motion by returns or poses."""

import dataclasses

import numpy as np
import pytest
import radarsdf
from radarsdf.live.tracking import Lost
from radarsdf.poses.agreement import sign_significance, turns_fast
from radarsdf.poses.checked_scans import CheckedScans
from radarsdf.poses.consistency import Clock, Consistency
from radarsdf.poses.tracking import Drive
from radarsdf.simulate import measured_motion

from scenes.kinds import KINDS

from ..conftest import recorded_file
from .drift import thinned

HALF = np.arange(20) >= 10
FACTORS = {
    "sign from half": np.where(HALF, -1, 1),
    "zero from half": np.where(HALF, 0, 1),
    "1.3 from half": np.where(HALF, 1.3, 1),
}


@pytest.fixture(scope="module")
def street():
    return thinned(radarsdf.simulate.hugin(seed=5, frames=20), 2)


@pytest.fixture(scope="module")
def motion(street):
    return measured_motion(street, seed=5)


@pytest.fixture(autouse=True)
def right_frames(monkeypatch):
    """Hypotheses on frames and axes, which take most of the time of a check, are tested in tests/checking."""
    monkeypatch.setattr("radarsdf.checking.frames.check_frames", lambda *_: [])


def odometry(street, speeds, times_s):
    found = radarsdf.odometry(street.points, doppler_mps=speeds, times_s=times_s, progress=False)
    middle = len(street.poses) // 2
    off = (np.linalg.inv(poses[middle]) @ poses for poses in (found.poses, street.poses))
    errors_m = np.linalg.norm(np.subtract(*(poses[:, :3, 3] for poses in off)), axis=1)
    sigmas_m = np.sqrt(np.trace(found.covariance[:, :3, :3], axis1=1, axis2=2))
    return found, float((errors_m / np.maximum(sigmas_m, 1e-3)).max())


def names(street, speeds, times_s):
    found = radarsdf.check(street.points, street.poses, doppler_mps=speeds, times_s=times_s)
    return {one.name for one in found if one.severity != "note"}


@pytest.mark.parametrize("fault", FACTORS)
def test_wrong_speeds_are_excluded_and_named(street, motion, fault):
    speeds = [factor * values for factor, values in zip(FACTORS[fault], motion.doppler_mps, strict=True)]
    found, worst = odometry(street, speeds, motion.times_s)
    assert not found.report["doppler"]
    assert worst < 4
    assert "doppler_contradicts_poses" in names(street, speeds, motion.times_s)
    refined = radarsdf.refine_poses(street.points, street.poses, doppler_mps=speeds, times_s=motion.times_s)
    assert len(refined.report["notes"]) == 1


@pytest.mark.parametrize("first", [0, 10])
def test_an_offset_of_all_speeds_is_found(street, motion, first):
    speeds = [values + np.float32(0.5 * (i >= first)) for i, values in enumerate(motion.doppler_mps)]
    assert not odometry(street, speeds, motion.times_s)[0].report["doppler"]
    assert "doppler_offset" in names(street, speeds, motion.times_s)


def test_good_doppler_is_used_without_a_mark(street, motion):
    found, worst = odometry(street, motion.doppler_mps, motion.times_s)
    assert found.report["doppler"]
    assert found.report["notes"] == []
    assert worst < 4
    assert names(street, motion.doppler_mps, motion.times_s) == set()


@pytest.mark.parametrize("jitter_s", [0.0, 0.012])
def test_wrong_times_are_evened_and_noted(street, motion, jitter_s):
    times_s = motion.times_s + jitter_s * np.random.default_rng(5).standard_normal(20)
    if jitter_s == 0:
        times_s[10] = times_s[9]
    found, worst = odometry(street, motion.doppler_mps, times_s)
    assert worst < 4
    assert found.report["notes"]
    assert names(street, motion.doppler_mps, times_s) & {"times", "times_uneven"}


def test_true_uneven_times_are_kept():
    rng = np.random.default_rng(1)
    times_s = np.arange(20) * 0.1 + 0.02 * rng.standard_normal(20)
    moved_m = 20 * np.diff(times_s)[:, None] * [1.0, 0, 0]
    shown_m = moved_m + 0.01 * rng.standard_normal((19, 3))
    assert not Clock.of(times_s, shown_m, moved_m, np.ones(19, bool)).errors_s.any()
    even_m = np.full((19, 1), 2.0) * [1.0, 0, 0] + 0.01 * rng.standard_normal((19, 3))
    evened_s = times_s - Clock.of(times_s, even_m, moved_m, np.ones(19, bool)).errors_s
    assert np.diff(evened_s).std() < 0.2 * np.diff(times_s).std()


@pytest.mark.parametrize("factor", [1, -1])
def test_a_changed_sign_of_a_sensor_that_turns_fast_is_found(factor):
    """Regression: scans turned by 20 degrees a step agreed with no motion, and poses were off by 137 standard deviations."""
    lap = radarsdf.simulate.oculii(seed=5, frames=20)
    motion = measured_motion(lap, seed=5)
    speeds = [values if i < 10 else factor * values for i, values in enumerate(motion.doppler_mps)]
    checked = CheckedScans.of(lap.points, speeds, motion.times_s)
    significance, yaws = sign_significance(checked.scans, checked.velocities, checked.times_s)
    assert turns_fast(yaws[0])
    drive = Drive(checked.scans, checked.times_s, checked.velocities, yaws=yaws)
    tested = next(filter(None, Consistency.of_returns(drive, radarsdf.FitConfig(num_threads=1))))
    if factor == 1:
        assert significance > 4
        assert (tested.contradicted, tested.doubts) == (None, ())
    else:
        assert (tested.contradicted.ratio, tested.contradicted.first) == (-1, 9)


def test_motions_that_a_tunnel_does_not_exclude_widen_the_deviations():
    tunnel = KINDS["tunnel"](seed=5, frames=20)
    motion = measured_motion(tunnel, seed=5)
    factors = FACTORS["sign from half"]
    speeds = [factor * values for factor, values in zip(factors, motion.doppler_mps, strict=True)]
    found, worst = odometry(tunnel, speeds, motion.times_s)
    assert found.report["notes"]
    assert worst < 4


def test_a_delay_that_the_returns_do_not_exclude_widens_the_deviations():
    """Regression: poses of a sensor that hardly observes its vertical motion were off by 10 standard deviations."""
    flat = radarsdf.simulate.astyx(seed=4, frames=20)
    motion = measured_motion(flat, seed=4)
    means = CheckedScans.of(flat.points, motion.doppler_mps, motion.times_s).velocities.mean_mps
    late = means[np.maximum(np.arange(20) - 3, 0)]
    rays = [points / np.linalg.norm(points, axis=1, keepdims=True) for points in flat.points]
    speeds = [mps + x @ off for mps, x, off in zip(motion.doppler_mps, rays, means - late, strict=True)]
    found, worst = odometry(flat, speeds, motion.times_s)
    assert found.report["doppler"]
    assert worst < 4


def test_doppler_of_other_scans_contradicts_given_poses(street, motion):
    velocities = CheckedScans.of(street.points, motion.doppler_mps, motion.times_s).velocities
    assert Consistency.of_poses(velocities, motion.times_s, street.poses).contradiction is None
    late = dataclasses.replace(velocities, mean_mps=velocities.mean_mps[np.maximum(np.arange(20) - 3, 0)])
    assert "3 scans later" in Consistency.of_poses(late, motion.times_s, street.poses).contradiction
    # Displacements that are wrong by a share of the change of the speed agree with no delay.
    before = velocities.mean_mps[np.maximum(np.arange(20) - 1, 0)]
    mixed = dataclasses.replace(velocities, mean_mps=0.7 * velocities.mean_mps + 0.3 * before)
    assert Consistency.of_poses(mixed, motion.times_s, street.poses).contradiction is None


def test_noise_at_a_constant_velocity_is_no_delay(street, motion):
    """Regression: a radar on a motorway seemed 5 scans late, since its own noise explains half of any change."""
    velocities = CheckedScans.of(street.points, motion.doppler_mps, motion.times_s).velocities
    poses, times_s = np.tile(np.eye(4), (20, 1, 1)), 0.1 * np.arange(20)
    poses[:, 0, 3] = 30.0 * times_s
    for seed in range(5):
        noisy = np.random.default_rng(seed).normal([30.0, 0, 0], [0.0, 0.1, 0.5], (20, 3))
        of_motorway = dataclasses.replace(velocities, mean_mps=noisy)
        assert Consistency.of_poses(of_motorway, times_s, poses).contradiction is None


@pytest.mark.parametrize("fault", ["sign from half", "zero from half"])
def test_a_live_map_is_lost_where_its_doppler_turns_wrong(street, motion, fault):
    live = radarsdf.LiveMap()

    def drive():
        for i, factor in enumerate(FACTORS[fault]):
            speeds = factor * motion.doppler_mps[i]
            live.integrate(street.points[i], doppler_mps=speeds, time_s=motion.times_s[i])

    with pytest.raises(Lost):
        drive()
    assert 10 <= len(live) < 14


def test_a_live_map_is_not_lost_at_a_standstill():
    """Regression: it was where returns changed while, by the IMU, the sensor stood still."""
    pytest.importorskip("rosbags", reason="the extra ros is not installed")
    scans = radarsdf.io.read(recorded_file("ti_iwr6843/ti_mmwave_rospkg_demo.bag"), radarsdf.io.UNPOSED)
    live = radarsdf.LiveMap()
    for i in range(24):
        live.integrate(scans.points[i], doppler_mps=scans.doppler_mps[i], time_s=scans.times_s[i])
    assert len(live) == 24
