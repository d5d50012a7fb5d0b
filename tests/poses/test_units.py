"""Times, ranges, speeds and rates in wrong units, signs and axes are reported, and long gaps end a segment."""

import dataclasses

import numpy as np
import pytest
import radarsdf
from radarsdf import FitConfig
from radarsdf.io import Imu
from radarsdf.poses.agreement import sign_significance
from radarsdf.poses.checked_scans import CheckedScans
from radarsdf.poses.consistency import Consistency
from radarsdf.poses.imu import Gyroscope, UnusableGyroscopeError
from radarsdf.poses.motion import MotionRate
from radarsdf.poses.rigid import aligned
from radarsdf.poses.tracking import Drive
from radarsdf.simulate import measured_motion

from scenes.kinds import KINDS

from .drift import first, measured, position_error_m, thinned


@pytest.fixture(scope="module")
def drive():
    return thinned(first(radarsdf.simulate.hugin, 16, seed=61, frames=30), 2)


@pytest.fixture(scope="module")
def motion(drive):
    return measured_motion(drive)


@pytest.mark.parametrize("factor", [1e3, 1e9, 1 / 60])
@pytest.mark.parametrize("with_doppler", [True, False])
def test_times_in_other_units_are_rejected_early(drive, motion, factor, with_doppler):
    speeds = motion.doppler_mps if with_doppler else None
    with pytest.raises(ValueError, match="give times in s"):
        radarsdf.odometry(drive.points, times_s=motion.times_s * factor, doppler_mps=speeds)


@pytest.mark.parametrize("factor", [1e2, 1e3])
def test_ranges_in_other_units_are_rejected_early(drive, motion, factor):
    points = [factor * scan for scan in drive.points]
    with pytest.raises(ValueError, match=r"median range of .*mm"):
        radarsdf.refine_poses(points, drive.poses)
    with pytest.raises(ValueError, match=r"median range of .*mm"):
        radarsdf.odometry(points, times_s=motion.times_s)


def test_speeds_in_other_units_are_excluded(drive, motion):
    checked = CheckedScans.of(drive.points, [100 * speeds for speeds in motion.doppler_mps], motion.times_s)
    assert checked.velocities is None
    assert "Doppler in m/s" in checked.notes[0]


@pytest.fixture(scope="module")
def yard():
    return KINDS["yard"](seed=2, frames=24)


@pytest.fixture(scope="module")
def slope():
    return first(KINDS["slope"], 24, seed=2, frames=40)


@pytest.mark.parametrize("factor", [0.8, 1.0, 1.25])
def test_the_scale_of_the_doppler_is_estimated(yard, factor):
    """Regression: 0.8 or 1.25 times the speed counted as right, with poses up to 100 standard deviations off."""
    motion = measured_motion(yard, seed=2)
    speeds = [factor * speeds for speeds in motion.doppler_mps]
    checked = CheckedScans.of(yard.points, speeds, motion.times_s)
    _, yaws = sign_significance(checked.scans, checked.velocities, checked.times_s)
    drive = Drive(checked.scans, checked.times_s, checked.velocities, yaws=yaws)
    tests = next(filter(None, Consistency.of_returns(drive, FitConfig(num_threads=1))))
    assert (tests.contradicted is None) == (factor == 1)
    assert factor == 1 or tests.contradicted.ratio * factor == pytest.approx(1, abs=0.08)
    assert (tests.delay, tests.doubts) == (0, ()) or factor != 1


@pytest.mark.parametrize(("late", "named"), [(3, "3 scans later"), (-5, "5 scans earlier")])
def test_doppler_of_other_scans_is_excluded(slope, late, named):
    """Regression: velocities of three scans ago were believed, with poses 12 standard deviations off."""
    motion = measured_motion(slope, seed=2)
    checked = CheckedScans.of(slope.points, motion.doppler_mps, motion.times_s)
    velocities = checked.velocities
    others = velocities.mean_mps[np.clip(np.arange(24) - late, 0, 23)]
    velocities = dataclasses.replace(velocities, mean_mps=others)
    drive = Drive(checked.scans, checked.times_s, velocities)
    tests = next(filter(None, Consistency.of_returns(drive, FitConfig(num_threads=1))))
    assert tests.delay == late
    unused, (note,) = tests.applied(velocities)
    assert unused is None
    assert named in note


def test_too_few_scans_do_not_measure_the_scale_of_the_doppler(drive):
    """Regression: it counted as confirmed."""
    found = radarsdf.odometry(measured(drive).select(range(5)))
    assert found.report["doppler"]
    assert any("the Doppler is in m/s" in note for note in found.report["notes"])


@pytest.mark.parametrize(
    "wrong",
    [np.degrees, lambda rates: -rates, lambda rates: rates[:, [2, 0, 1]]],
    ids=["degrees", "sign", "axes"],
)
def test_a_gyroscope_contradicting_returns_is_excluded(drive, motion, wrong):
    imu = Imu(motion.times_s, wrong(motion.angular_velocity), R_sensor_imu=np.eye(3))
    found = radarsdf.odometry(drive.points, times_s=motion.times_s, doppler_mps=motion.doppler_mps, imu=imu)
    assert not found.report["gyroscope"]
    (note,) = found.report["notes"]
    assert "The gyroscope is not used" in note
    assert position_error_m(aligned(found.poses, drive.poses), drive.poses) < 0.1


@pytest.mark.parametrize(("bias_rad_s", "named"), [(0.02, None), (1.0, "bias of 1.0")])
def test_an_implausible_gyroscope_bias_is_named(bias_rad_s, named):
    rng = np.random.default_rng(0)
    turns = 0.02 * rng.standard_normal((40, 3))
    rates = Gyroscope.of(np.zeros((41, 3)), np.arange(41) / 10, np.arange(41) / 10)
    shown = [MotionRate(10 * turn, 1e-4 * np.eye(3)) for turn in turns]
    measured_rates = dataclasses.replace(rates, turns=turns + [0, 0, bias_rad_s / 10])
    if named is None:
        assert measured_rates.learnt(shown).bias.mean[2] == pytest.approx(bias_rad_s, rel=0.1)
        return
    with pytest.raises(UnusableGyroscopeError, match=named):
        measured_rates.learnt(shown)


def test_a_gap_of_a_day_starts_a_new_segment(drive, motion):
    times_s = motion.times_s + 86400.0 * (np.arange(16) >= 8)
    found = radarsdf.odometry(drive.points, times_s=times_s, doppler_mps=motion.doppler_mps)
    assert found.segments.tolist() == [0] * 8 + [1] * 8
    for rows in (slice(0, 8), slice(8, 16)):
        assert position_error_m(aligned(found.poses[rows], drive.poses[rows]), drive.poses[rows]) < 0.1
