"""Simulated rigs: mountings, times and Doppler of each radar, and the same bits as the radar alone."""

from dataclasses import replace

import numpy as np
import pytest
from radarsdf import simulate as sim
from radarsdf.returns.moving import sensor_velocity
from scipy.spatial.transform import Rotation

from scenes.rigs import drive_of_rig, three_radars


@pytest.fixture(scope="module")
def drive():
    return sim.oculii(seed=2, frames=12)


@pytest.fixture(scope="module")
def rig(drive):
    return drive_of_rig(drive, seed=3)


def test_scans_of_all_radars_are_in_order_of_time(drive, rig):
    scans = rig.scans
    assert (np.diff(scans.times_s) >= 0).all()
    counts = {label: scans.sensors.count(label) for label in scans.sensors}
    assert counts == {"front": 12, "rear": 15, "side": 23} == {k: len(v) for k, v in rig.radars.items()}
    for label, one in rig.radars.items():
        own = scans.select([i for i, sensor in enumerate(scans.sensors) if sensor == label])
        np.testing.assert_allclose(own.sensor_poses, one.poses, atol=1e-12)
        if label == "rear":
            alone = sim.simulate(one.scene, one.sensor, one.poses, name=label, seed=one.seed)
            for ours, theirs in zip(own.points, alone.points, strict=True):
                np.testing.assert_array_equal(ours, theirs)
    # The front radar scans at the times of the poses of the body.
    front = [i for i, sensor in enumerate(scans.sensors) if sensor == "front"]
    np.testing.assert_allclose(scans.poses[front], drive.poses, atol=1e-9)
    distances = np.abs(drive.scene.signed_distance(scans.ground_truth))
    assert np.median(distances) < 0.02


def test_doppler_includes_the_lever_arm(drive):
    times_s, body = 0.1 * np.arange(9), np.tile(np.eye(4), (9, 1, 1))
    # A circle of 3 m radius at 1 rad/s.
    body[:, :3, :3] = Rotation.from_euler("z", times_s[:, None]).as_matrix()
    body[:, :3, 3] = 3.0 * np.stack([np.sin(times_s), 1 - np.cos(times_s), 0.5 + 0 * times_s], axis=1)
    rig = sim.simulate_rig(drive.scene, three_radars(drive.sensor), body, times_s)
    for label, one in rig.radars.items():
        mounted = rig.scans.T_body_sensor[label]
        expected = mounted[:3, :3].T @ (np.array([3.0, 0, 0]) + np.cross([0, 0, 1.0], mounted[:3, 3]))
        doppler = [v for v, k in zip(rig.scans.doppler_mps, rig.scans.sensors, strict=True) if k == label]
        found = [sensor_velocity(*scan).velocity_mps for scan in zip(one.points, doppler, strict=True)]
        np.testing.assert_allclose(np.median(found, axis=0), expected, atol=0.05)


def test_gains_rates_and_offsets_are_those_of_each_radar(drive):
    radars = three_radars(drive.sensor)
    radars["rear"] = replace(radars["rear"], time_offset_s=0.03, first_s=0.2, interval_mps=2.0)
    rig = sim.simulate_rig(drive.scene, radars, drive.poses, 5.0 + 0.1 * np.arange(12))
    rear = [i for i, label in enumerate(rig.scans.sensors) if label == "rear"]
    np.testing.assert_allclose(rig.scans.times_s[rear], 5.23 + np.arange(len(rear)) / 13.0)
    assert np.abs(np.concatenate([rig.scans.doppler_mps[i] for i in rear])).max() <= 1.0
    loudest = {k: max(x.max() for x in v.intensities) for k, v in rig.radars.items()}
    assert loudest["rear"] < loudest["front"] < loudest["side"]
