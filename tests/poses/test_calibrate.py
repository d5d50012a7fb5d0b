"""Mountings of several radars, estimated from a drive."""

import dataclasses

import numpy as np
import pytest
import radarsdf
from radarsdf.checking.doppler import misread_radars
from radarsdf.poses.rigid import increments, moved, transform
from radarsdf.scans import Scans
from radarsdf.simulate import MountedRadar, measured_imu, simulate_rig

from scenes.kinds import KINDS
from scenes.rigs import drive_of_rig

LATE_S = 0.02
ERRORS = np.array([0.15, -0.1, 0.1, *np.radians([2.0, -1.5, 3.0])])  # of the given mounting of the side radar
COUNT, INTERVAL_S, RATE_HZ = 40, 0.25, 5.0


def driven(seed=0, straight=False):
    """Scans of a front and a side radar in a yard, with the true mountings."""
    base = KINDS["yard"](seed=seed, frames=COUNT)
    radar = dataclasses.replace(base.sensor, beams=900, ghost_share=0.0)
    wide = dataclasses.replace(radar, azimuth_fov_rad=1.4, elevation_fov_rad=0.6)
    true = {
        "front": transform(np.zeros(3), np.array([1.0, 0.0, 0.2])),
        "side": transform(np.radians([2.0, -3.0, 80.0]), np.array([-1.0, 0.8, 0.0])),
    }
    poses = base.poses
    if straight:
        poses = np.tile(poses[0], (COUNT // 2, 1, 1))
        poses[:, :3, 3] += np.outer(0.8 * np.arange(len(poses)), poses[0, :3, 0])
    radars = {
        "front": MountedRadar(radar, true["front"], RATE_HZ),
        "side": MountedRadar(wide, true["side"], RATE_HZ, first_s=0.03, time_offset_s=LATE_S),
    }
    rig = simulate_rig(base.scene, radars, poses, INTERVAL_S * np.arange(len(poses)), seed=seed)
    return rig.scans, true, poses


def given(scans, mountings, poses=None, imu=None):
    """The scans with other mountings, and only these poses."""
    others = {"doppler_mps": scans.doppler_mps, "times_s": scans.times_s, "sensors": scans.sensors}
    return Scans(scans.points, poses, T_body_sensor=mountings, imu=imu, **others)


def with_errors(true):
    return true | {"side": moved(true["side"][None], ERRORS[None])[0]}


@pytest.fixture(scope="module")
def drive():
    return driven()


def test_mounting_and_time_offset_are_found(drive):
    scans, true, _ = drive
    found = radarsdf.calibrate(given(scans, with_errors(true), scans.poses))
    assert found.against == "front"
    np.testing.assert_array_equal(found.mountings["front"].T_body_sensor, true["front"])
    side = found.mountings["side"]
    off = increments(true["side"][None], side.T_body_sensor[None])[0]
    sigmas = np.append(np.sqrt(side.covariance.diagonal()), side.time_offset_sigma_s)
    errors = np.append(off, side.time_offset_s - LATE_S)
    assert side.unobserved == ()
    assert (np.abs(errors) < 3 * sigmas).all(), errors / sigmas
    assert (sigmas < [0.05, 0.05, 0.1, *np.radians([1.0, 1.0, 0.5]), 0.004]).all(), sigmas
    assert (np.abs(errors) < 0.5 * np.abs([*ERRORS, LATE_S])).all(), errors


def test_without_poses_the_imu_is_found_as_well(drive):
    scans, true, body = drive
    R_body_imu = transform(np.array([0.0, 0.0, 0.5]), np.zeros(3))[:3, :3]
    imu = measured_imu(body, INTERVAL_S * np.arange(COUNT), R_sensor_imu=R_body_imu, lever_m=(0.3, -0.1, 0.2))
    found = radarsdf.calibrate(given(scans, with_errors(true), imu=imu))
    off_m = found.mountings["side"].T_body_sensor[:2, 3] - true["side"][:2, 3]  # z is hardly observed
    assert off_m == pytest.approx(0, abs=0.05)
    assert found.imu is not None
    assert found.imu.T_body_sensor[:3, :3] == pytest.approx(R_body_imu, abs=0.05)
    assert found.imu.time_offset_s == pytest.approx(0, abs=0.02)


def test_ghosts_do_not_turn_a_radar_that_looks_aside():
    scans = drive_of_rig(KINDS["car_park"](seed=1, frames=60), ("front", "side"), seed=1).scans
    true = scans.T_body_sensor["side"]
    found = radarsdf.calibrate(given(scans, scans.T_body_sensor)).mountings["side"]
    off = increments(true[None], found.T_body_sensor[None])[0]
    assert (np.abs(off) < 3 * np.sqrt(found.covariance.diagonal())).all(), off


def test_a_straight_steady_drive_leaves_the_lever_arm_along_it_open():
    scans, true, _ = driven(straight=True)
    side = radarsdf.calibrate(given(scans, with_errors(true))).mountings["side"]
    assert np.isnan(side.T_body_sensor[0, 3])
    assert np.isnan(side.covariance[0]).all()
    assert np.isnan([side.time_offset_s, side.time_offset_sigma_s]).all()
    assert any("lever arm along x" in why for why in side.unobserved)
    assert any("time offset" in why for why in side.unobserved)


@pytest.mark.parametrize(
    ("signs", "name"),
    [((1, 1, -1), "mounting_mirrored"), ((1, -1, -1), "mounting_upside_down"), ((1, 1, 1), None)],
)
def test_reversed_axes_of_a_radar_are_named(drive, signs, name):
    scans, _, _ = drive
    signs = np.array(signs, np.float32)
    reversed_ = [p * signs if of == "side" else p for p, of in zip(scans.points, scans.sensors, strict=True)]
    others = {"doppler_mps": scans.doppler_mps, "times_s": scans.times_s, "sensors": scans.sensors}
    found = dict(misread_radars(Scans(reversed_, scans.poses, T_body_sensor=scans.T_body_sensor, **others)))
    assert {label: one.name for label, one in found.items()} == ({} if name is None else {"side": name})


def test_what_is_missing_is_named(drive):
    scans, true, _ = drive
    with pytest.raises(ValueError, match="several radars"):
        radarsdf.calibrate(Scans(scans.points, None, times_s=scans.times_s))
    with pytest.raises(ValueError, match="times_s"):
        radarsdf.calibrate(Scans(scans.points, None, sensors=scans.sensors, T_body_sensor=true))
    with pytest.raises(TypeError):
        radarsdf.calibrate(scans.points)
