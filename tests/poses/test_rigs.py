"""Poses of the body of a rig: kinematics of lever arms, odometry, refinement and an IMU."""

import dataclasses

import numpy as np
import pytest
import radarsdf
from radarsdf.io import Scans
from radarsdf.poses.doppler import BodyVelocities, DopplerMotion, SensorVelocities
from radarsdf.poses.motion import MotionRate
from radarsdf.poses.rigid import aligned, rotation, turned_by
from radarsdf.rig import Rig
from radarsdf.simulate import drifted, measured_imu

from scenes.kinds import KINDS
from scenes.rigs import FRAME_S, drive_of_rig

from .drift import first


@pytest.fixture(scope="module")
def drive():
    return first(radarsdf.simulate.hugin, 20, seed=5, frames=30)


@pytest.fixture(scope="module")
def scans(drive):
    return drive_of_rig(drive, ["front", "side"], seed=2).scans


@pytest.fixture(scope="module")
def found(scans):
    return radarsdf.odometry(scans)


def errors(poses, scans):
    placed = aligned(poses, scans.poses)
    off_m = np.linalg.norm((placed - scans.poses)[:, :3, 3], axis=1)
    return np.sqrt((off_m**2).mean()), np.degrees(turned_by(placed, scans.poses)).max()


def turning_body(count=9, turn_rad_s=0.4, speed_mps=10.0, interval_s=0.05):
    """Poses of a body that turns steadily, and its rig of two radars, which measure by turns."""
    at_s = interval_s * np.arange(count)
    turns = np.outer(turn_rad_s * at_s, [0.0, 0.0, 1.0])
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = rotation(turns)
    poses[:, 0, 3] = speed_mps / turn_rad_s * np.sin(turns[:, 2])
    poses[:, 1, 3] = speed_mps / turn_rad_s * (1 - np.cos(turns[:, 2]))
    rear = np.diag([-1.0, -1.0, 1.0, 1.0])
    rear[:3, 3] = -2.0, 0.5, 0.3
    front = np.eye(4)
    front[:3, 3] = 1.5, 0.0, 0.0
    rig = Rig.of((["front", "rear"] * count)[:count], {"front": front, "rear": rear})
    levers = rig.mountings[:, :3, 3]
    velocities = np.array([speed_mps, 0.0, 0.0]) + np.cross([0.0, 0.0, turn_rad_s], levers)
    velocities = np.einsum("fji,fj->fi", rig.mountings[:, :3, :3], velocities)
    measured = []
    for rows in rig.scans_of_radars().values():
        covariance = np.tile(1e-4 * np.eye(3), (len(rows), 1, 1))
        of_radar = SensorVelocities(velocities[rows], covariance, np.full(3, 1e-4), np.ones(len(rows), bool))
        measured.append((rows, of_radar))
    return poses, at_s, BodyVelocities.of_radars(rig, measured, at_s)


def test_steps_of_the_body_follow_from_velocities_at_lever_arms():
    poses, at_s, velocities = turning_body()
    np.testing.assert_allclose(DopplerMotion.by(velocities, at_s, poses).errors(poses), 0, atol=2e-4)


def test_two_lever_arms_measure_the_turn():
    _, at_s, velocities = turning_body()
    biased = dataclasses.replace(
        velocities, of_radars_mps=velocities.of_radars_mps + [[[0.0, 0.0, 0.2]], [[0.0, 0.0, 0.0]]]
    )
    assert not biased.measure_turns(np.diff(at_s), 0.01)  # what differs in the mean is no turn
    rates = [MotionRate(np.array([0.0, 0.0, 0.4]), np.eye(3))] * (len(at_s) - 1)
    velocities = biased.learnt(rates)
    unknown = MotionRate(np.zeros(3), np.eye(3))
    turn = velocities.turn_given(unknown, 3, at_s[1])
    assert turn.mean[2] == pytest.approx(0.4 * at_s[1], abs=1e-3)
    assert turn.covariance[2, 2] < 0.01
    assert turn.covariance[0, 0] > 0.9  # about the line between them
    assert velocities.measure_turns(np.diff(at_s), 0.5)
    one = dataclasses.replace(velocities, levers=np.tile(velocities.levers[:1], (2, 1, 1)))
    assert not one.measure_turns(np.diff(at_s), 0.01)


def test_odometry_of_radars_that_measure_at_their_own_times_places_the_body(scans, found):
    error_m, turned_deg = errors(found.poses, scans)
    assert found.report["segments"] == 1
    assert error_m < 0.03
    assert turned_deg < 1.0
    middle = len(scans) // 2
    placed = scans.poses[middle] @ np.linalg.inv(found.poses[middle]) @ found.poses
    off_m = (placed - scans.poses)[:, :3, 3]
    squares = np.einsum("fi,fij,fj->f", off_m, np.linalg.pinv(found.covariance[:, :3, :3]), off_m)
    assert np.median(squares) < 3 * 9


def test_two_radars_at_one_place_are_as_good_as_one_radar(scans):
    front = scans.select([i for i, label in enumerate(scans.sensors) if label == "front"][:12])
    alone = radarsdf.odometry(front.points, doppler_mps=front.doppler_mps, times_s=front.times_s)
    T = front.T_body_sensor["front"]
    alternating = Scans(
        front.points,
        front.poses,
        doppler_mps=front.doppler_mps,
        times_s=front.times_s,
        sensors=["a", "b"] * (len(front) // 2),
        T_body_sensor={"a": T, "b": T},
    )
    both = radarsdf.odometry(alternating)
    of_one = errors(alone.poses @ np.linalg.inv(T), front)[0]
    assert errors(both.poses, front)[0] < 1.5 * of_one + 0.005


def test_an_imu_and_several_radars_place_the_body(drive, scans):
    times_s = FRAME_S * np.arange(len(drive))
    imu = dataclasses.replace(measured_imu(drive.poses, times_s), R_sensor_imu=np.eye(3), specific_force=None)
    scans = scans.select(range(20))
    found = radarsdf.odometry(scans, imu=imu)
    assert found.report["gyroscope"]
    assert errors(found.poses, scans)[0] < 0.03


def test_refinement_mends_drifted_poses_of_the_body(scans):
    given = drifted(scans.poses, 0.02, 0.002, seed=3)
    refined = radarsdf.refine_poses(scans, given)
    assert refined.improved
    assert errors(refined.poses, scans)[0] < 0.3 * errors(given, scans)[0]


def test_mountings_are_required(scans):
    unmounted = Scans(scans.points, scans.poses, times_s=scans.times_s, sensors=scans.sensors)
    with pytest.raises(ValueError, match="T_body_sensor"):
        radarsdf.odometry(unmounted)
    with pytest.raises(ValueError, match="T_body_sensor"):
        radarsdf.refine_poses(unmounted)


def test_a_radar_that_turns_fast_from_the_start_is_not_placed_as_if_it_began_at_rest():
    """At 90 degrees a second, the first scan was 168 degrees off."""
    scans = drive_of_rig(KINDS["hall"](seed=3, frames=30), ["side"], seed=2).scans
    found = radarsdf.odometry(scans.points, times_s=scans.times_s, doppler_mps=scans.doppler_mps)
    true = scans.sensor_poses
    first = found.poses[20] @ np.linalg.inv(true[20]) @ true[0]
    assert np.degrees(turned_by(found.poses[:1], first[None]))[0] < 4
