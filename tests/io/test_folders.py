# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Folders of recorded scans: tiny ones in each layout, whose numbers come back exactly; and damaged ones."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose, assert_array_equal
from radarsdf.io import read
from radarsdf.io.clouds.reading import read_columns

from bench.scenes import load_scene

START_S = 1706001766.0
TURN_LEFT = np.array([0, 0, np.sqrt(0.5), np.sqrt(0.5)])  # by 90 degrees about z, qx qy qz qw
STRAIGHT = np.array([0, 0, 0, 1.0])
KINDS = {"f": "F", "i": "I", "u": "U"}


def write_pcd(path, columns, data="binary", **header):
    """`columns` is {name: (N,) array}; `header` overrides what is true of them."""
    arrays = [np.asarray(c) for c in columns.values()]
    count = len(arrays[0])
    lines = {
        "VERSION": "0.7",
        "FIELDS": " ".join(columns),
        "SIZE": " ".join(str(a.itemsize) for a in arrays),
        "TYPE": " ".join(KINDS[a.dtype.kind] for a in arrays),
        "COUNT": " ".join("1" for _ in arrays),
        "WIDTH": str(count),
        "HEIGHT": "1",
        "VIEWPOINT": "0 0 0 1 0 0 0",
        "POINTS": str(count),
        "DATA": data,
    } | header
    text = "# .PCD v0.7 - Point Cloud Data file format\n" + "".join(
        f"{k} {v}\n" for k, v in lines.items() if v is not None
    )
    if data == "ascii":
        body = "".join(
            " ".join(repr(x.item()) for x in row) + "\n" for row in zip(*arrays, strict=True)
        ).encode()
    else:
        record = np.zeros(count, [(f"f{i}", a.dtype.newbyteorder("<")) for i, a in enumerate(arrays)])
        for i, a in enumerate(arrays):
            record[f"f{i}"] = a
        body = record.tobytes()
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(text.encode() + body)


def radar_cloud(points, **fields):
    xyz = np.asarray(points, np.float32).reshape(-1, 3)
    return dict(zip("xyz", xyz.T, strict=True)) | {k: np.asarray(v, np.float32) for k, v in fields.items()}


def write_poses(path, rows):
    """Rows of (time after START_S, position, quaternion)."""
    lines = [
        " ".join(f"{x:.9f}" for x in (START_S + time_s, *position, *quaternion))
        for time_s, position, quaternion in rows
    ]
    path.write_text("# time x y z qx qy qz qw\n" + "\n".join(lines) + "\n")


def stamp(time_s):
    return f"{START_S + time_s:.9f}.pcd"


def pose(position, R_world_sensor):
    T_world_sensor = np.eye(4)
    T_world_sensor[:3, :3] = R_world_sensor
    T_world_sensor[:3, 3] = position
    return T_world_sensor


@pytest.fixture
def posed(tmp_path):
    """Three scans; the base moves 1 m along x and turns left by 90 degrees in 0.4 s."""
    folder = tmp_path / "viking"
    write_pcd(
        folder / "radar" / stamp(0.0), radar_cloud([[1, 2, 3], [4, 5, 6]], doppler=[0, 0], power=[70, 80])
    )
    write_pcd(folder / "radar" / stamp(0.2), radar_cloud([[7, 8, 9]], doppler=[0], power=[90]))
    write_pcd(folder / "radar" / stamp(0.4), radar_cloud([[3, 2, 1]], doppler=[0], power=[75.5]))
    write_poses(folder / "poses.txt", [(0.0, (10, 0, 1), STRAIGHT), (0.4, (11, 0, 1), TURN_LEFT)])
    return folder


def test_posed_folder(posed):
    scans = read(posed)
    assert scans.notes == []
    assert [p.dtype for p in scans.points] == [np.float32] * 3
    assert_array_equal(scans.points[0], [[1, 2, 3], [4, 5, 6]])
    assert_array_equal(scans.points[1], [[7, 8, 9]])
    assert_array_equal(np.concatenate(scans.intensities), [70, 80, 90, 75.5])
    assert scans.ground_truth is None
    c = np.sqrt(0.5)
    expected = [
        pose([10, 0, 1], np.eye(3)),
        pose([10.5, 0, 1], [[c, -c, 0], [c, c, 0], [0, 0, 1]]),
        pose([11, 0, 1], [[0, -1, 0], [1, 0, 0], [0, 0, 1]]),
    ]
    assert_allclose(scans.poses, expected, atol=2e-6)  # of 1.7e9 s, float64 resolves 0.2 microseconds


def test_mounting_turns_and_shifts_with_the_base(posed):
    (posed / "base_T_radar.txt").write_text(
        "0 -1 0 2\n1 0 0 0\n0 0 1 0.5  # a radar that looks left\n0 0 0 1\n"
    )
    poses = read(posed).poses
    assert_allclose(poses[0], pose([12, 0, 1.5], [[0, -1, 0], [1, 0, 0], [0, 0, 1]]), atol=1e-6)
    assert_allclose(poses[2], pose([11, 2, 1.5], [[-1, 0, 0], [0, -1, 0], [0, 0, 1]]), atol=1e-6)


def test_posed_folder_as_a_scene(posed):
    scene = load_scene(str(posed), frames=2, box=[[0, 0, 0], [1, 1, 1]])
    assert (scene.name, len(scene), scene.holdout_every) == ("viking", 2, 10)
    assert (scene.min_range_m, scene.max_range_m, scene.simulation) == (2.5, None, None)
    assert_array_equal(scene.points[1], [[7, 8, 9]])
    assert_array_equal(scene.box, [[0, 0, 0], [1, 1, 1]])


@pytest.mark.parametrize("kind", ["pcd", "ply"])
def test_ground_truth(posed, kind):
    points = np.array([[245821.25, 3380553.5, 20.0], [0.5, 1, 2]])
    if kind == "pcd":
        write_pcd(posed / "lidar.pcd", dict(zip("xyz", points.T, strict=True)))
    else:
        (posed / "lidar.ply").write_text(
            "ply\nformat ascii 1.0\nelement vertex 2\nproperty double x\nproperty double y\nproperty double z\n"
            "end_header\n" + "".join(f"{x} {y} {z}\n" for x, y, z in points)
        )
    truth = load_scene(str(posed)).ground_truth
    assert truth.dtype == np.float64
    assert_array_equal(truth, points)


def test_what_is_left_out(posed):
    nan = np.nan
    for time_s, xyz, power in (
        (-0.1, [[9, 9, 9]], [1]),
        (0.5, [[9, 9, 9]], [1]),
        (0.1, [], []),
        (0.2, [[nan, 8, 9], [7, 8, 9], [1, 1, 1]], [1, 2, nan]),
    ):
        write_pcd(
            posed / "radar" / stamp(time_s), radar_cloud(xyz, doppler=np.zeros(len(power)), power=power)
        )
    scans = read(posed)
    assert [len(p) for p in scans.points] == [2, 1, 1]
    assert_array_equal(scans.points[1], [[7, 8, 9]])
    assert_array_equal(scans.intensities[1], [2])


def test_without_intensities(posed):
    for path in (posed / "radar").iterdir():
        write_pcd(path, radar_cloud([[1, 2, 3]]))
    assert read(posed).intensities is None


@pytest.mark.parametrize(
    "text", ["1 0 0 0\n0 1 0 0\n0 0 1 0\n", "2 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n", "\x80"]
)
def test_damaged_mounting(posed, text):
    (posed / "base_T_radar.txt").write_text(text)
    with pytest.raises(ValueError, match="base_T_radar"):
        read(posed)


def test_damaged_ground_truth(posed):
    cloud = trimesh.PointCloud(np.arange(300.0).reshape(-1, 3))
    whole = cloud.export(file_type="ply")
    for size in (len(whole) // 2, 20, 0):
        (posed / "lidar.ply").write_bytes(whole[:size])
        scans = read(posed)
        with pytest.raises(ValueError, match=r"lidar\.ply"):
            _ = scans.ground_truth


UTM = np.array([245821.0, 3380553.0, 20.0])


@pytest.fixture
def snail(tmp_path):
    """The lidar stands level, its y axis (back) to the south: forward is north. It moves 1 m east in 0.4 s."""
    folder = tmp_path / "data3"
    clouds = folder / "eagleg7" / "enhanced"
    write_pcd(clouds / stamp(0.0), radar_cloud([[5, 0, 0]], Doppler=[1], Range=[5], Power=[12.5]))
    write_pcd(
        clouds / stamp(0.2), radar_cloud([[6, 0, 0], [0, 7, 0]], Doppler=[1, 2], Range=[6, 7], Power=[1, 2])
    )
    (clouds / "times.txt").write_text("0\n")
    # Left, back, up are west, south, up: half a turn about z.
    facing_north = (0, 0, 1, 0)
    write_poses(
        folder / "utm50r_T_xt32.txt",
        [
            (0.0, UTM, facing_north),
            (0.2, UTM + [0.5, 0, 0], facing_north),
            (0.4, UTM + [1, 0, 0], facing_north),
        ],
    )
    return folder


def test_snail_radar(snail):
    scans = read(snail)
    assert_array_equal(scans.points[0], [[5, 0, 0]])
    assert_array_equal(scans.points[1], [[6, 0, 0], [0, 7, 0]])
    assert_array_equal(np.concatenate(scans.intensities), [12.5, 1, 2])
    assert scans.ground_truth is None
    # The radar is 7 cm before the lidar and 11.5 cm below, and looks forward, to within 2 degrees.
    assert_allclose(scans.poses[:, :3, 3] - UTM, [[0, 0.07, -0.115], [0.5, 0.07, -0.115]], rtol=0, atol=1e-5)
    forward_left_up = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    angle = np.arccos((np.trace(scans.poses[0, :3, :3].T @ forward_left_up) - 1) / 2)
    assert np.deg2rad(1) < angle < np.deg2rad(3)


def test_snail_radar_with_a_calibration_of_its_own(snail):
    (snail / "body_T_oculii.txt").write_text("1 0 0 1\n0 1 0 2\n0 0 1 3\n0 0 0 1\n")
    poses = read(snail).poses
    # 1 m forward, 2 m left and 3 m up of the lidar: to the north, the west and up.
    assert_allclose(poses[0], pose(UTM + [-2, 1, 3], [[0, -1, 0], [1, 0, 0], [0, 0, 1]]), rtol=0, atol=1e-5)


def test_snail_radar_lidar_points_move_with_their_own_time(snail):
    seconds = START_S + np.array([0.0, 0.1, 0.1, 0.0, 0.0, 0.2, -0.1])
    # Left, back, up; the last four are too near, too far, in the cell of the third, and before the first pose.
    xyz = [
        [0, -3, 1],
        [0, -3, 1],
        [2.02, 0.02, 0.02],
        [0.5, 0, 0],
        [70, 0, 0],
        [2.273, 0.023, 0.023],
        [5, 5, 5],
    ]
    columns = radar_cloud(xyz, intensity=np.ones(7)) | {"timestamp": seconds, "ring": np.zeros(7, np.uint16)}
    write_pcd(snail / "xt32" / stamp(0.0), columns)
    write_pcd(snail / "xt32" / stamp(0.3), radar_cloud([[9, 9, 9]]))  # after the last radar scan
    expected = UTM + [[0, 3, 1], [0.25, 3, 1], [-1.77, -0.02, 0.02]]
    assert_allclose(read(snail).ground_truth, expected, rtol=0, atol=1e-5)
    scene = load_scene(str(snail))
    assert (scene.name, len(scene), scene.min_range_m, scene.max_range_m) == ("data3", 2, 1.0, None)
    assert_allclose(scene.ground_truth, expected, rtol=0, atol=1e-5)
    write_pcd(snail / "lidar.pcd", dict(zip("xyz", UTM[:, None], strict=True)))
    assert_array_equal(read(snail).ground_truth, UTM[None])


def test_damaged_snail_radar(snail):
    columns = radar_cloud([[5, 5, 5]]) | {"timestamp": np.array([12.0])}
    write_pcd(snail / "xt32" / stamp(0.0), columns)
    scans = read(snail)
    with pytest.raises(ValueError, match="times of its points"):
        _ = scans.ground_truth
    wrong = snail / "eagleg7" / "enhanced" / "first.pcd"
    wrong.touch()
    with pytest.raises(ValueError, match="not named by its time"):
        read(snail)
    wrong.unlink()
    (snail / "utm50r_T_xt32.txt").unlink()
    with pytest.raises(ValueError, match="full_trajs"):
        load_scene(str(snail))


COLUMNS = {
    "x": np.array([1.5, -2], np.float32),
    "n": np.array([3, 65535], np.uint16),
    "t": np.array([1706001766.577286344, 0.25]),
    "i": np.array([-1, 4], np.int8),
}


@pytest.mark.parametrize("data", ["ascii", "binary"])
def test_pcd(data, tmp_path):
    write_pcd(tmp_path / "cloud.pcd", COLUMNS, data)
    columns = read_columns(tmp_path / "cloud.pcd")
    assert list(columns) == list(COLUMNS)
    for name, expected in COLUMNS.items():
        assert_array_equal(columns[name], expected)


def test_pcd_with_padding_and_fields_of_several_values(tmp_path):
    cloud = {"x": np.ones(2, np.float32), "_": np.zeros(2, np.int64), "z": np.full(2, 3, np.float32)}
    write_pcd(tmp_path / "cloud.pcd", cloud, SIZE="4 1 4", COUNT="1 8 1", TYPE="F U F")
    assert {name: c.tolist() for name, c in read_columns(tmp_path / "cloud.pcd").items()} == {
        "x": [1, 1],
        "z": [3, 3],
    }
    write_pcd(tmp_path / "cloud.pcd", {"x": np.ones(6, np.float32)}, WIDTH="3", HEIGHT="2", COUNT=None)
    assert read_columns(tmp_path / "cloud.pcd")["x"].tolist() == [1] * 6


@pytest.mark.parametrize("data", ["ascii", "binary"])
def test_empty_pcd(data, tmp_path):
    write_pcd(tmp_path / "cloud.pcd", radar_cloud(np.zeros((0, 3))), data)
    assert [len(c) for c in read_columns(tmp_path / "cloud.pcd").values()] == [0, 0, 0]


@pytest.mark.parametrize("data", ["ascii", "binary"])
def test_pcd_cut_short(data, tmp_path):
    path = tmp_path / "cloud.pcd"
    write_pcd(path, COLUMNS, data)
    whole = path.read_bytes()
    for size in (0, 10, 60, whole.index(b"DATA") + 2, len(whole) - (1 if data == "binary" else 3)):
        path.write_bytes(whole[:size])
        with pytest.raises(ValueError, match=r"not a whole \.pcd file of points"):
            read_columns(path)


@pytest.mark.parametrize(
    ("header", "message"),
    [
        ({"WIDTH": "1000000000000"}, "are there"),
        ({"WIDTH": "-1"}, "negative"),
        ({"WIDTH": "two"}, "invalid literal"),
        ({"WIDTH": None}, "lacks WIDTH"),
        ({"COUNT": "1 1 1 0"}, "zero"),
        ({"COUNT": "1 1 1 1000000000000"}, "not a whole"),
        ({"COUNT": "1 1 1"}, "fit together"),
        ({"SIZE": "4 2 8"}, "not a whole"),
        ({"SIZE": "4 2 8 3"}, "fit together"),
        ({"TYPE": "F U F O"}, "fit together"),
        ({"DATA": "binary_compressed"}, "compressed bytes do not fit"),
        ({"DATA": "zipped"}, "is not known"),
        ({"FIELDS": "x \xff t i"}, "not a whole"),
    ],
)
def test_hostile_pcd(header, message, tmp_path):
    write_pcd(tmp_path / "cloud.pcd", COLUMNS, **header)
    with pytest.raises(ValueError, match=message):
        read_columns(tmp_path / "cloud.pcd")
