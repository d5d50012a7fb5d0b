"""Folders of recorded scans: tiny ones of each layout are read exactly; and damaged ones."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from radarsdf.io import read
from radarsdf.io.clouds import read_columns

from ..conftest import pose

START_S = 1706001766.0
TURN_LEFT = np.array([0, 0, np.sqrt(0.5), np.sqrt(0.5)])  # by 90 degrees about z, qx qy qz qw
STRAIGHT = np.array([0, 0, 0, 1.0])
KINDS = {"f": "F", "i": "I", "u": "U", "V": "B"}


def write_pcd(path, columns, data="binary", **header):
    """`columns` is {name: (N,) array}; `header` overrides its true entries."""
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
    written = (f"{k} {v}\n" for k, v in lines.items() if v is not None)
    text = "".join(["# .PCD v0.7 - Point Cloud Data file format\n", *written])
    if data == "ascii":
        rows = (" ".join(repr(x.item()) for x in row) for row in zip(*arrays, strict=True))
        body = "".join(f"{row}\n" for row in rows).encode()
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


@pytest.fixture
def posed(tmp_path):
    """Three scans; the base moves 1 m along x and turns left by 90 degrees in 0.4 s."""
    folder = tmp_path / "viking"
    first = radar_cloud([[1, 2, 3], [4, 5, 6]], doppler=[0, 0], power=[70, 80])
    write_pcd(folder / "radar" / stamp(0.0), first)
    write_pcd(folder / "radar" / stamp(0.2), radar_cloud([[7, 8, 9]], doppler=[0], power=[90]))
    write_pcd(folder / "radar" / stamp(0.4), radar_cloud([[3, 2, 1]], doppler=[0], power=[75.5]))
    write_poses(folder / "poses.txt", [(0.0, (10, 0, 1), STRAIGHT), (0.4, (11, 0, 1), TURN_LEFT)])
    return folder


def test_posed_folder(posed):
    scans = read(posed)
    assert scans.notes == ["times in the names of the files: seconds with decimals, 0.2 s apart"]
    assert [p.dtype for p in scans.points] == [np.float32] * 3
    assert_array_equal(scans.points[0], [[1, 2, 3], [4, 5, 6]])
    assert_array_equal(scans.points[1], [[7, 8, 9]])
    assert_array_equal(np.concatenate(scans.intensities), [70, 80, 90, 75.5])
    assert scans.ground_truth is None
    expected = [pose([10, 0, 1]), pose([10.5, 0, 1], np.pi / 4), pose([11, 0, 1], np.pi / 2)]
    assert_allclose(scans.poses, expected, atol=2e-6)  # of 1.7e9 s, float64 resolves 0.2 microseconds


def test_ground_truth(posed):
    points = np.array([[245821.25, 3380553.5, 20.0], [0.5, 1, 2]])
    write_pcd(posed / "lidar.pcd", dict(zip("xyz", points.T, strict=True)))
    truth = read(posed).ground_truth
    assert truth.dtype == np.float64
    assert_array_equal(truth, points)


UTM = np.array([245821.0, 3380553.0, 20.0])


@pytest.fixture
def snail(tmp_path):
    """The lidar is level, its y axis (back) points south: forward is north. It moves 1 m east in 0.4 s."""
    folder = tmp_path / "data3"
    clouds = folder / "eagleg7" / "enhanced"
    write_pcd(clouds / stamp(0.0), radar_cloud([[5, 0, 0]], Doppler=[1], Range=[5], Power=[12.5]))
    second = radar_cloud([[6, 0, 0], [0, 7, 0]], Doppler=[1, 2], Range=[6, 7], Power=[1, 2])
    write_pcd(clouds / stamp(0.2), second)
    (clouds / "times.txt").write_text("0\n")
    # Left, back, up are west, south, up: half a turn about z.
    facing_north = (0, 0, 1, 0)
    eastwards = [(0.2 * i, UTM + [0.5 * i, 0, 0], facing_north) for i in range(3)]
    write_poses(folder / "utm50r_T_xt32.txt", eastwards)
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


def test_pcd_with_padding_and_fields_of_several_values(tmp_path):
    cloud = {"x": np.ones(2, np.float32), "_": np.zeros(2, np.int64), "z": np.full(2, 3, np.float32)}
    write_pcd(tmp_path / "cloud.pcd", cloud, SIZE="4 1 4", COUNT="1 8 1", TYPE="F U F")
    assert {name: c.tolist() for name, c in read_columns(tmp_path / "cloud.pcd").items()} == {
        "x": [1, 1],
        "z": [3, 3],
    }
    for size, count, kind in (
        ("4 8 4", "1 0 1", "F I F"),
        ("4 3 4", "1 1 1", "F U F"),
        ("4 4 4", "1 1 1", "F B F"),
    ):
        cloud["_"] = np.zeros(2, f"V{int(size[2]) * int(count[2])}") if count[2] == "1" else np.zeros(2, "V0")
        write_pcd(tmp_path / "cloud.pcd", cloud, FIELDS="x y z", SIZE=size, COUNT=count, TYPE=kind)
        assert {n: c.tolist() for n, c in read_columns(tmp_path / "cloud.pcd").items()} == {
            "x": [1, 1],
            "z": [3, 3],
        }
    write_pcd(tmp_path / "cloud.pcd", {"x": np.ones(6, np.float32)}, WIDTH="3", HEIGHT="2", COUNT=None)
    assert read_columns(tmp_path / "cloud.pcd")["x"].tolist() == [1] * 6


def test_notes_and_labels_next_to_scans_are_not_scans(tmp_path):
    inner = tmp_path / "velodyne"
    inner.mkdir()
    for i in range(3):
        np.ones((2, 4), np.float32).tofile(inner / f"{i:06d}.bin")
        (inner / f"{i:06d}.txt").write_text("0 0.5 0.5 0.1\n")
    for name in (
        "notes.txt",
        "gps.txt",
        "velodyne/weather.txt",
        "velodyne/extra.txt",
        "velodyne/merged_cloud.bin",
    ):
        (tmp_path / name).write_text("1 2 3\n")
    assert len(read(tmp_path, [np.eye(4)] * 3)) == 3
    for path in inner.glob("*.bin"):
        path.unlink()
    assert len(read(tmp_path, [np.eye(4)] * 3)) == 3  # text may be scans


@pytest.mark.parametrize("width", [12, 16])
def test_poses_with_numbers_belong_to_the_scans_of_these_numbers(tmp_path, width):
    for i in (1, 2, 5):
        (tmp_path / f"{i:010d}.csv").write_text("x,y,z\n5,0,0\n")
    rows = {i: pose([i, 0, 0]).ravel()[:width] for i in (1, 2, 4, 5, 6)}
    table = tmp_path / "k.txt"
    table.write_text("".join(f"{i} {' '.join(map(str, row))}\n" for i, row in rows.items()))
    assert read(tmp_path, table).poses[:, 0, 3].tolist() == [1, 2, 5]
    table.write_text(table.read_text().replace("\n2 ", "\n7 "))
    scans = read(tmp_path, table)
    assert scans.poses[:, 0, 3].tolist() == [1, 5]
    assert any(note.startswith("1 scans left out") for note in scans.notes)
    for name in (1, 2, 5):
        (tmp_path / f"{name:010d}.csv").rename(tmp_path / f"{1.7e9 + name:.2f}.csv")
    table.write_text("".join(f"{1.7e9 + i:.2f} {' '.join(map(str, row))}\n" for i, row in rows.items()))
    assert read(tmp_path, table).poses[:, 0, 3].tolist() == [1, 2, 5]
