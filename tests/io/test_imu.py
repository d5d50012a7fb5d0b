"""Inertial measurements of bags, on the clock of the scans, and of scan files."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from radarsdf.io import UNPOSED, Imu, Scans, read, read_scans, write_scans

from ..conftest import pose

START_S = 1_700_000_000.0
TIMES_S = START_S + np.arange(40) * 0.01
RATES = np.random.default_rng(0).normal(0, 1, (40, 3))
FORCES = RATES + [0.0, 0.0, 9.81]
MOUNTING = pose([0.1, 0.2, 0.3], np.pi / 2)  # T_imu_radar


def a_bag(folder, kind="ros1", *, stamps=True, topics=("/imu",), force=True, transforms=False):
    """Four scans and an IMU, which is recorded four measurements at a time, 0.05 s late."""
    pytest.importorskip("rosbags", reason="the extra ros is not installed")
    from .bag_writing import BagWriter  # noqa: PLC0415 - an extra

    path = folder / ("drive.bag" if kind == "ros1" else "drive")
    cloud = {name: np.ones(3, np.float32) for name in ("x", "y", "z", "doppler")}
    with BagWriter(path, kind) as bag:
        if transforms:
            bag.write("/tf_static", bag.transforms(START_S, {("imu", "radar"): MOUNTING}), START_S)
        for i in range(4):
            at_s = START_S + 0.1 * i
            bag.write("/radar", bag.cloud2(at_s if stamps else 0.0, cloud), at_s + 0.02)
        for topic in topics:
            for i, at_s in enumerate(TIMES_S):
                message = bag.imu(at_s, RATES[i], FORCES[i] if force else None)
                bag.write(topic, message, TIMES_S[i // 4 * 4] + 0.05)
    return path


def test_bags_have_them_by_the_clock_of_the_scans(tmp_path):
    imu = read(a_bag(tmp_path, "mcap"), UNPOSED).imu
    assert_array_equal(imu.angular_velocity, RATES)
    assert_array_equal(imu.specific_force, FORCES)
    assert_allclose(imu.times_s, TIMES_S, rtol=0, atol=1e-6)
    assert imu.R_sensor_imu is None


def test_with_the_record_time_they_are_as_far_apart_as_their_stamps(tmp_path):
    scans = read(a_bag(tmp_path, stamps=False), UNPOSED)
    assert_allclose(np.diff(scans.imu.times_s), 0.01, rtol=0, atol=1e-6)
    assert_allclose(scans.times_s[0], START_S + 0.02, rtol=0, atol=1e-6)
    assert 0.02 <= scans.imu.times_s[0] - START_S <= 0.05


def test_the_bag_gives_its_rotation_on_the_radar(tmp_path):
    path = a_bag(tmp_path, transforms=True)
    assert_allclose(read(path, UNPOSED).imu.R_sensor_imu, MOUNTING[:3, :3].T, atol=1e-12)
    given = read(path, UNPOSED, R_sensor_imu=np.eye(3)).imu
    assert_array_equal(given.R_sensor_imu, np.eye(3))


def test_which_topic(tmp_path):
    path = a_bag(tmp_path, topics=("/camera/imu", "/imu"), force=False)
    scans = read(path, UNPOSED)
    assert scans.imu is None
    assert any("choose one with imu_topic, of /camera/imu, /imu" in note for note in scans.notes)
    chosen = read(path, UNPOSED, imu_topic="/imu").imu
    assert chosen.specific_force is None
    assert len(chosen) == 40
    with pytest.raises(ValueError, match="no inertial measurements in /radar: there are /camera/imu"):
        read(path, UNPOSED, imu_topic="/radar")


def test_our_files_keep_them(tmp_path):
    given = Imu(TIMES_S, RATES, FORCES, MOUNTING[:3, :3])
    scans = Scans([np.ones((2, 3))] * 3, np.tile(np.eye(4), (3, 1, 1)), times_s=TIMES_S[:3], imu=given)
    for kept in (scans, scans.select(np.arange(2))):
        write_scans(tmp_path / "scans.npz", kept)
        for again in (read_scans(tmp_path / "scans.npz").imu, read(tmp_path / "scans.npz").imu):
            for name, values in vars(given).items():
                assert_array_equal(getattr(again, name), values)
    turned = read(tmp_path / "scans.npz", R_sensor_imu=np.eye(3)).imu
    assert_array_equal(turned.R_sensor_imu, np.eye(3))
    write_scans(tmp_path / "none.npz", Scans(scans.points, scans.poses, imu=Imu(TIMES_S, RATES)))
    assert read(tmp_path / "none.npz").imu.specific_force is None
