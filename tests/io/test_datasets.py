"""Published data sets: a tiny folder or bag in the layout of each is read as the expected scans and poses."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from radarsdf.io import read
from radarsdf.io.datasets import find_dataset
from scipy.spatial.transform import Rotation

from ..conftest import pose
from .test_folders import radar_cloud, snail, write_pcd  # noqa: F401 - a fixture

START_S = 1_600_000_000.0
TIMES_S = START_S + np.array([0.0, 0.1, 0.2])
POSES = np.stack([pose([10.0 + i, 2, 3], 0.2 * i) for i in range(3)])
MOUNTING = pose([0.1, 0.2, 0.3], np.pi / 2)


def returns(i, width):
    table = np.zeros((i + 2, width), "<f4")
    table[:, 0], table[:, 1], table[:, 2] = i, np.arange(i + 2), 1
    table[:, 3] = 10 * i + np.arange(i + 2)
    return table


def check(scans, poses, times_s=TIMES_S):
    seen = list(scans)
    assert len(seen) == 3
    for i, scan in enumerate(seen):
        assert_array_equal(scan.points, returns(i, 4)[:, :3])
        assert_array_equal(scan.intensities, returns(i, 4)[:, 3])
        assert_array_equal(scan.doppler_mps, np.full(i + 2, -1.5))
    assert_allclose(scans.poses, poses, rtol=0, atol=1e-5)
    if times_s is None:
        assert scans.times_s is None
    else:
        assert_allclose(scans.times_s, times_s, rtol=0, atol=1e-6)


def quaternion(matrix):
    return Rotation.from_matrix(matrix[:3, :3]).as_quat()


def tum_rows(times_s=TIMES_S, poses=POSES):
    rows = [(t, *T[:3, 3], *quaternion(T)) for t, T in zip(times_s, poses, strict=True)]
    return "".join(" ".join(f"{x:.9f}" for x in row) + "\n" for row in rows)


@pytest.fixture
def coloradar(tmp_path):
    folder = tmp_path / "kitti" / "ec_hallways_run0"
    clouds = folder / "single_chip" / "pointclouds"
    (clouds / "data").mkdir(parents=True)
    for i in range(3):
        table = returns(i, 5)
        table[:, 4] = -1.5
        table.tofile(clouds / "data" / f"radar_pointcloud_{i}.bin")
    (clouds / "timestamps.txt").write_text("".join(f"{t:.9f}\n" for t in TIMES_S))
    (folder / "groundtruth").mkdir()
    (folder / "groundtruth" / "timestamps.txt").write_text("".join(f"{t:.9f}\n" for t in TIMES_S))
    rows = [line.split(" ", 1)[1] for line in tum_rows().splitlines(keepends=True)]
    (folder / "groundtruth" / "groundtruth_poses.txt").write_text("".join(rows))
    transforms = tmp_path / "calib" / "transforms"
    transforms.mkdir(parents=True)
    (transforms / "base_to_single_chip.txt").write_text(
        " ".join(map(str, MOUNTING[:3, 3])) + "\n" + " ".join(map(str, quaternion(MOUNTING))) + "\n"
    )
    return folder


def test_coloradar(coloradar):
    assert find_dataset(coloradar).name == "ColoRadar"
    check(read(coloradar), POSES @ MOUNTING)
    check(read(coloradar, extrinsic=np.eye(4)), POSES)
    check(read(coloradar, POSES), POSES @ MOUNTING)
    (coloradar.parent.parent / "calib" / "transforms" / "base_to_single_chip.txt").unlink()
    scans = read(coloradar)
    assert "the poses are taken as those of the radar" in scans.notes[0]
    check(scans, POSES)
    (coloradar / "single_chip" / "pointclouds" / "timestamps.txt").write_text("1\n2\n")
    with pytest.raises(ValueError, match="3 scans"):
        read(coloradar)


# The radar looks along x; the camera along z, its x to the right. The camera is 0.5 m above the radar.
T_CAMERA_RADAR = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0.5], [1, 0, 0, 0], [0, 0, 0, 1]])


@pytest.fixture
def delft(tmp_path):
    radar, lidar = tmp_path / "radar" / "training", tmp_path / "lidar" / "training"
    for folder in (radar / "velodyne", radar / "calib", lidar / "pose", lidar / "velodyne"):
        folder.mkdir(parents=True)
    zeros = " ".join(["0.0"] * 12)
    tr = " ".join(map(repr, T_CAMERA_RADAR[:3].ravel().tolist()))
    for i, T_map_radar in enumerate(POSES):
        table = returns(i, 7)
        table[:, 4] = -1.5
        table.tofile(radar / "velodyne" / f"{i + 544:05d}.bin")
        np.ones((5, 4), "<f4").tofile(lidar / "velodyne" / f"{i + 544:05d}.bin")
        (radar / "calib" / f"{i + 544:05d}.txt").write_text(
            "".join(f"P{n}: {zeros}\n" for n in range(4))
            + f"R0_rect: 1 0 0 0 1 0 0 0 1\nTr_velo_to_cam: {tr}\n"
        )
        camera = T_map_radar @ np.linalg.inv(T_CAMERA_RADAR)
        records = [{"odomToCamera": np.eye(4).ravel().tolist()}, {"mapToCamera": camera.ravel().tolist()},
                   {"UTMToCamera": np.eye(4).ravel().tolist()}]  # fmt: skip
        (lidar / "pose" / f"{i + 544:05d}.json").write_text("\n".join(map(json.dumps, records)))
    return tmp_path


def test_view_of_delft(delft):
    for folder in (delft, delft / "radar"):
        assert find_dataset(folder).name == "View-of-Delft"
        check(read(folder), POSES, None)
    check(read(delft, POSES), POSES, None)
    np.zeros((1, 7), "<f4").tofile(delft / "radar" / "training" / "velodyne" / "00999.bin")
    scans = read(delft)
    check(scans, POSES, None)
    assert scans.notes[0] == "1 scans left out: they have no file of a pose"
    (delft / "lidar" / "training" / "pose" / "00544.json").write_text('{"mapToCamera": [1, 2]}')
    with pytest.raises(ValueError, match=r"00544\.json is not a pose"):
        read(delft)


def test_msc_rad4r(tmp_path):
    folder = tmp_path / "RURAL_A0"
    for i in range(3):
        table = returns(i, 4)
        write_pcd(
            folder / "3_RADAR" / "PCD" / f"{i:06d}.pcd",
            radar_cloud(table[:, :3], Doppler=np.full(i + 2, -1.5), Range=table[:, 0], Power=table[:, 3]),
        )
    lines = [f"{i} {int(t)} {round((t - int(t)) * 1e9)}\n" for i, t in enumerate(TIMES_S)]
    (folder / "3_RADAR" / "timestamp_radar.txt").write_text("".join(lines))
    assert find_dataset(folder).name == "MSC-RAD4R"
    with pytest.raises(ValueError, match="has no poses"):
        read(folder)
    (tmp_path / "odometry.tum").write_text(tum_rows())
    check(read(folder, tmp_path / "odometry.tum"), POSES)
    check(read(folder, tmp_path / "odometry.tum", extrinsic=MOUNTING), POSES @ MOUNTING)
    (folder / "3_RADAR" / "timestamp_radar.txt").write_text("0 1 2\n")
    with pytest.raises(ValueError, match="3 scans"):
        read(folder, POSES)


def bag_columns(i):
    table = returns(i, 4)
    return {
        "x": table[:, 0],
        "y": table[:, 1],
        "z": table[:, 2],
        "Doppler": np.full(i + 2, -1.5, "f4"),
        "Power": table[:, 3],
    }


def test_ntu4dradlm(tmp_path):
    pytest.importorskip("rosbags", reason="the extra ros is not installed")
    from .bag_writing import BagWriter  # noqa: PLC0415 - it takes rosbags

    folder = tmp_path / "cp"
    folder.mkdir()
    for part in range(2):
        with BagWriter(folder / f"cp_2022-02-26_{part}.bag", "ros1") as bag:
            for i in ((0, 1), (2,))[part]:
                for topic in ("/radar_pcl", "/radar_enhanced_pcl", "/radar_trk"):
                    cloud = bag_columns(i) if topic == "/radar_enhanced_pcl" else bag_columns(0)
                    bag.write(topic, bag.cloud(TIMES_S[i], cloud), TIMES_S[i])
    with BagWriter(folder / "gt_odom.bag", "ros1") as bag:
        bag.write("/gt_odom", bag.odometry(START_S, np.eye(4)), START_S)
    (folder / "gt_odom.txt").write_text(tum_rows())
    scans = read(folder)
    check(scans, POSES)
    scans = read(folder, extrinsic=MOUNTING)
    check(scans, POSES @ MOUNTING)
    assert [note.partition(" (")[0] for note in scans.notes] == [
        "poses: of gt_odom.txt",
        "scans: those of /radar_enhanced_pcl",
    ]


def test_viking_hill(tmp_path):
    pytest.importorskip("rosbags", reason="the extra ros is not installed")
    from .bag_writing import BagWriter  # noqa: PLC0415 - it takes rosbags

    folder = tmp_path / "viking"
    folder.mkdir()
    with BagWriter(folder / "viking_hill.bag", "ros1") as bag:
        for i, time_s in enumerate(TIMES_S):
            bag.write("/icp_odom", bag.odometry(time_s, POSES[i], "map"), time_s)
            bag.write("/imu_odom", bag.odometry(time_s, np.eye(4), "odom"), time_s)
            columns = {name.lower(): column for name, column in bag_columns(i).items()}
            bag.write("/ouster/points", bag.cloud2(time_s, columns, "ouster"), time_s)
            bag.write("/hugin_raf_1/radar_data", bag.cloud2(time_s, columns, "hugin_raf_1"), time_s + 0.1)
    check(read(folder, extrinsic=MOUNTING), POSES @ MOUNTING)
    (folder / "base_T_radar.txt").write_text("\n".join(" ".join(map(repr, row)) for row in MOUNTING.tolist()))
    check(read(folder), POSES @ MOUNTING)
