# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Files of one point cloud, in each format, and damaged ones."""

from __future__ import annotations

import struct

import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose, assert_array_equal
from radarsdf.io import read, read_points
from radarsdf.io.clouds import read_columns, unpack_lzf

from .test_folders import write_pcd

TABLE = np.array([[1.5, -2, 3, 40.5], [4, 5, 6, 70]])
IDENTITY = np.eye(4)[None]


def one(path, **options):
    (scan,) = read(path, IDENTITY, **options)
    return scan


def check(path, **options):
    scan = one(path, **options)
    assert_array_equal(scan.points, TABLE[:, :3])
    assert_array_equal(scan.intensities, TABLE[:, 3])


def packed_pcd(path, columns, packed, **header):
    """A PCD file that is compressed; `packed` is made from its bytes, field by field."""
    write_pcd(path, columns, DATA="binary_compressed", **header)
    text = path.read_bytes().partition(b"DATA binary_compressed\n")
    raw = b"".join(np.asarray(c).tobytes() for c in columns.values())
    data = packed(raw)
    path.write_bytes(text[0] + text[1] + struct.pack("<II", len(data), len(raw)) + data)


def as_literals(raw):
    """LZF without any reference."""
    return b"".join(bytes([len(raw[i : i + 32]) - 1]) + raw[i : i + 32] for i in range(0, len(raw), 32))


COLUMNS = {
    "x": np.array([1.5, 4], np.float32),
    "y": np.array([-2, 5], np.float32),
    "z": np.array([3, 6], np.float32),
    "power": np.array([40.5, 70]),
}


def test_compressed_pcd(tmp_path):
    packed_pcd(tmp_path / "a.pcd", COLUMNS, as_literals)
    assert {n: c.dtype for n, c in read_columns(tmp_path / "a.pcd").items()} == {
        n: c.dtype for n, c in COLUMNS.items()
    }
    check(tmp_path / "a.pcd")


@pytest.mark.parametrize(
    ("data", "unpacked"),
    [
        (b"\x02abc", b"abc"),
        (b"\x00a\x20\x00", b"aaaa"),  # three from one byte back: it overlaps with itself
        (b"\x01ab\xe0\x09\x01", b"ab" * 10),
        (b"\x02abc\x20\x02", b"abcabc"),
    ],
)
def test_lzf(data, unpacked):
    assert unpack_lzf(data, len(unpacked)) == unpacked
    for damaged in (b"", data[:-1], b"\x00a\x20\x05", data + b"\x00a"):
        with pytest.raises(ValueError, match="compressed data"):
            unpack_lzf(damaged, len(unpacked))


def test_bin_with_names(tmp_path):
    np.column_stack([TABLE[:, 3], TABLE[:, :3], TABLE[:, :1]]).astype("<f4").tofile(tmp_path / "a.bin")
    check(tmp_path / "a.bin", columns=["power", "x", "y", "z", "other"])
    check(tmp_path / "a.bin", columns=5, fields={"x": 1, "y": 2, "z": 3, "intensity": 0, "doppler": None})
    with pytest.raises(ValueError, match="no column 5 for intensity"):
        one(tmp_path / "a.bin", columns=5, fields={"intensity": 5})
    with pytest.raises(ValueError, match=r"a\.bin.*5 x float32 or 10 x float32.*--columns"):
        one(tmp_path / "a.bin")
    with pytest.raises(ValueError, match=r"a\.bin.*no whole number of points of 4 float32"):
        one(tmp_path / "a.bin", columns=4)


def drive(width, scans, dtype, seed=0):
    """Scans of a radar as tables (N, width): x, y, z, intensity, Doppler, and others."""
    rng = np.random.default_rng(seed)
    for i in range(scans):
        ranges, azimuth, elevation = rng.uniform((2, -1, -0.2), (60, 1, 0.2), (40 + 7 * i, 3)).T
        xyz = [ranges * np.cos(azimuth), ranges * np.sin(azimuth), ranges * np.sin(elevation)]
        others = [rng.uniform(5, 30, len(ranges)), rng.normal(0, 2, len(ranges)), ranges, azimuth, elevation]
        yield np.stack([*xyz, *others], axis=1)[:, :width].astype(dtype)


@pytest.mark.parametrize("dtype", ["<f4", "<f8"])
@pytest.mark.parametrize("width", [3, 4, 5])
def test_the_content_of_bin_files_decides_how_many_numbers_a_return_has(tmp_path, width, dtype):
    tables = list(drive(width, 5, dtype))
    for i, table in enumerate(tables):
        data = table.tobytes()
        (tmp_path / f"{i}.bin").write_bytes(data[:-3] if i == 2 else data)
    scans = read(tmp_path, np.tile(IDENTITY, (5, 1, 1)))
    assert [len(scan) for scan in scans] == [40, 47, 61, 68]
    assert_array_equal(scans.points[1], tables[1][:, :3])
    assert any("2.bin" in note and note.startswith("1 scans left out") for note in scans.notes)
    assert any(f"have {width} numbers" in note for note in scans.notes) == ((width, dtype) != (4, "<f4"))


def test_npy(tmp_path):
    np.save(tmp_path / "a.npy", TABLE)
    check(tmp_path / "a.npy")
    assert one(tmp_path / "a.npy").points.dtype == np.float64
    records = np.zeros(2, [("Power", "f4"), ("X", "f8"), ("Y", "f8"), ("Z", "f8")])
    for name, column in zip("XYZ", TABLE.T, strict=False):
        records[name] = column
    records["Power"] = TABLE[:, 3]
    np.save(tmp_path / "a.npy", records)
    check(tmp_path / "a.npy")
    np.save(tmp_path / "a.npy", np.zeros((2, 2)))
    with pytest.raises(ValueError, match=r"a\.npy is not a whole \.npy file of points"):
        one(tmp_path / "a.npy")


@pytest.mark.parametrize(
    "text",
    [
        "x,y,z,intensity\n1.5,-2,3,40.5\n4,5,6,70\n",
        "X;Y;Z;RCS\n1.5;-2;3;40.5\n4;5;6;70",
        "1.5 -2 3 40.5\n4 5 6 70\n",
        "# made by hand\n\n1.5\t-2\t3\t40.5\n4\t5\t6\t70\n",
        '"power","x","y","z"\n40.5,1.5,-2,3\n70,4,5,6\n',
        "//X Y Z Intensity\n1.5 -2 3 40.5\n4 5 6 70\n",
    ],
)
def test_text(tmp_path, text):
    (tmp_path / "a.csv").write_text(text)
    check(tmp_path / "a.csv")


HALF = np.sqrt(0.5)


def test_viewpoint(tmp_path):
    """A quarter of a turn to the left, 100 m along x: points of ground truth move; poses place scans, given ones first."""
    for i in range(2):
        write_pcd(tmp_path / f"{i}.pcd", COLUMNS, VIEWPOINT=f"{100 + i} 0 0 {HALF} 0 0 {HALF}")
    moved = [[102, 1.5, 3], [95, 4, 6]]
    assert_allclose(read_points(tmp_path / "0.pcd"), moved, rtol=1e-6)
    scans = read(tmp_path)
    assert_allclose(next(iter(scans)).world_points, moved, rtol=1e-6)
    assert scans.notes == ["poses: VIEWPOINT of the PCD files"]
    scans = read(tmp_path, np.tile(IDENTITY, (2, 1, 1)))
    assert_array_equal(scans.points[0], TABLE[:, :3])
    assert any("VIEWPOINT" in note and "not applied" in note for note in scans.notes)


@pytest.mark.parametrize("name", ["frame", "Scan_ID", "scalar_scan"])
def test_a_table_of_several_scans(tmp_path, name):
    (tmp_path / "a.csv").write_text(f"{name},time,x,y,z\n3,0.3,1,0,0\n1,0.1,2,0,0\n3,0.3,4,0,0\n")
    poses = np.tile(IDENTITY, (4, 1, 1))
    poses[:, 0, 3] = [0, 10, 20, 30]
    for given in (poses, poses[[1, 3]]):  # scans without returns have poses, or none
        scans = read(tmp_path / "a.csv", given)
        assert [scan.points[:, 0].tolist() for scan in scans] == [[2], [1, 4]]
        assert scans.poses[:, 0, 3].tolist() == [10, 30]
        assert scans.times_s.tolist() == [0.1, 0.3]
    with pytest.raises(ValueError, match="2 scans but 1 poses"):
        read(tmp_path / "a.csv", IDENTITY)


def test_ply(tmp_path):
    header = "".join(
        f"property {kind} {name}\n"
        for kind, name in zip(["double"] * 3 + ["float"], ["x", "y", "z", "power"], strict=True)
    )
    rows = "".join(" ".join(map(repr, row)) + "\n" for row in (TABLE + [3380553.0, 0, 0, 0]).tolist())
    (tmp_path / "a.ply").write_text(f"ply\nformat ascii 1.0\nelement vertex 2\n{header}end_header\n{rows}")
    scan = one(tmp_path / "a.ply")
    assert_array_equal(scan.points, TABLE[:, :3] + [3380553.0, 0, 0])  # in double precision
    assert_array_equal(scan.intensities, TABLE[:, 3])
    data = trimesh.PointCloud(TABLE[:, :3]).export(file_type="ply")
    (tmp_path / "a.ply").write_bytes(data.replace(b"element", "comment Straße\nelement".encode("latin-1"), 1))
    assert_array_equal(read_points(tmp_path / "a.ply"), TABLE[:, :3])
    (tmp_path / "a.ply").write_bytes(
        data[:-5].replace(b"element", "comment Straße\nelement".encode("latin-1"), 1)
    )
    with pytest.raises(ValueError, match=r"a\.ply"):
        read_points(tmp_path / "a.ply")


@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_las(tmp_path, suffix):
    laspy = pytest.importorskip("laspy", reason="the extra las is not installed")
    header = laspy.LasHeader(point_format=3, version="1.2")
    header.scales, header.offsets = [0.001] * 3, [3380000, 0, 0]
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = (TABLE[:, :3] + [3380553, 0, 0]).T
    path = tmp_path / f"a.{suffix}"
    cloud.write(path)
    assert_allclose(read_points(path), TABLE[:, :3] + [3380553, 0, 0], rtol=0, atol=1e-6)
    data = bytearray(path.read_bytes())
    data[107:111] = struct.pack("<I", 2**31)  # the number of points
    path.write_bytes(data)
    with pytest.raises(ValueError, match=r"2147483648 points, for which the file is too small"):
        read_points(path)
