"""Point cloud files of each format, and damaged ones."""

import struct
from importlib.util import find_spec

import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose, assert_array_equal
from radarsdf.io import read
from radarsdf.io.clouds import CLOUD_OUT_SUFFIXES, read_columns, read_points, unpack_lzf, write_cloud
from radarsdf.scans import Notes, Scan, Scans

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


COLUMNS = {
    "x": np.array([1.5, 4], np.float32),
    "y": np.array([-2, 5], np.float32),
    "z": np.array([3, 6], np.float32),
    "power": np.array([40.5, 70]),
}


def test_compressed_pcd(tmp_path):
    write_pcd(tmp_path / "a.pcd", COLUMNS, DATA="binary_compressed")
    header = tmp_path.joinpath("a.pcd").read_bytes().partition(b"binary_compressed\n")[:2]
    raw = b"".join(column.tobytes() for column in COLUMNS.values())
    packed = b"".join(bytes([len(raw[i : i + 32]) - 1]) + raw[i : i + 32] for i in range(0, len(raw), 32))
    body = struct.pack("<II", len(packed), len(raw)) + packed
    (tmp_path / "a.pcd").write_bytes(b"".join(header) + body)
    check(tmp_path / "a.pcd")
    for damaged in (body[:-1], struct.pack("<II", len(packed), len(raw) + 8) + packed):
        (tmp_path / "a.pcd").write_bytes(b"".join(header) + damaged)
        with pytest.raises(ValueError, match=r"a\.pcd.*unpack"):
            one(tmp_path / "a.pcd")


@pytest.mark.parametrize(
    ("data", "unpacked"),
    [
        (b"\x02abc", b"abc"),
        (b"\x00a\x20\x00", b"aaaa"),  # a copy of three bytes from one byte back overlaps itself
        (b"\x01ab\xe0\x09\x01", b"ab" * 10),
        (b"\x02abc\x20\x02", b"abcabc"),
        (bytes([31]) + b"z" * 32 + bytes([31]) + b"y" * 32 + b"\x20\x27", b"z" * 32 + b"y" * 32 + b"zzz"),
    ],
)
def test_lzf(data, unpacked):
    assert unpack_lzf(data, len(unpacked)) == unpacked
    for damaged in (b"", data[:-1], b"\x00a\x20\x05", data + b"\x00a"):
        with pytest.raises(ValueError, match="compressed data"):
            unpack_lzf(damaged, len(unpacked))


def test_bin(tmp_path):
    TABLE.astype("<f4").tofile(tmp_path / "a.bin")
    check(tmp_path / "a.bin")
    np.column_stack([TABLE[:, 3], TABLE[:, :3], TABLE[:, :1]]).astype("<f4").tofile(tmp_path / "a.bin")
    check(tmp_path / "a.bin", columns=["power", "x", "y", "z", "other"])
    columns = {"x": "y", "y": "z", "z": "intensity", "intensity": "x", "doppler": None}
    check(tmp_path / "a.bin", columns=5, fields=columns)
    with pytest.raises(ValueError, match="no field snr for intensity"):
        one(tmp_path / "a.bin", columns=5, fields={"intensity": "snr"})
    for columns in (4, None):
        with pytest.raises(ValueError, match=r"a\.bin.*--columns"):
            one(tmp_path / "a.bin", columns=columns)


@pytest.mark.parametrize("dtype", ["<f4", "<f8"])
@pytest.mark.parametrize("width", [3, 4, 5, 8])
def test_bin_files_other_than_kitti_require_columns(tmp_path, width, dtype):
    """One of them is truncated, and some have the size of points with four columns."""
    rng = np.random.default_rng(0)
    for i in range(5):
        ranges, azimuth, elevation = rng.uniform((2, -1, -0.2), (60, 1, 0.2), (40 + 20 * i, 3)).T
        xyz = [ranges * np.cos(azimuth), ranges * np.sin(azimuth), ranges * np.sin(elevation)]
        others = [rng.uniform(5, 30, len(ranges)), rng.normal(0, 2, len(ranges)), ranges, azimuth, elevation]
        data = np.stack([*xyz, *others], axis=1)[:, :width].astype(dtype).tobytes()
        (tmp_path / f"{i}.bin").write_bytes(data[:-3] if i == 2 else data)
    poses = np.tile(IDENTITY, (5, 1, 1))
    if (width, dtype) != (4, "<f4"):
        with pytest.raises(ValueError, match="--columns"):
            read(tmp_path, poses)
    if dtype == "<f4":
        scans = read(tmp_path, poses, columns=width)
        assert [len(scan) for scan in scans] == [40, 60, 100, 120]
        assert any("2.bin" in note and note.startswith("1 scans left out") for note in scans.notes)


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
    with pytest.raises(ValueError, match=r"a\.npy"):
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


def test_an_unsupported_pcd_is_rejected_with_a_remedy(tmp_path):
    write_pcd(tmp_path / "0.pcd", COLUMNS, DATA="draco")
    with pytest.raises(ValueError, match="its DATA is draco: save it as binary"):
        read_points(tmp_path / "0.pcd")


def test_viewpoint(tmp_path):
    """A quarter of a turn to the left, 100 m along x: points of ground truth move, scans have the given poses."""
    half = np.sqrt(0.5)
    write_pcd(tmp_path / "0.pcd", COLUMNS, VIEWPOINT=f"100 0 0 {half} 0 0 {half}")
    assert_allclose(read_points(tmp_path / "0.pcd"), [[102, 1.5, 3], [95, 4, 6]], rtol=1e-6)
    check(tmp_path / "0.pcd")
    with pytest.raises(ValueError, match="has no poses"):
        read(tmp_path / "0.pcd")


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
    with pytest.raises(ValueError, match=r"2147483648 points: the file is too small"):
        read_points(path)


UTM_M = np.array([691_000.0, 5_335_000.0, 520.0])
COUNTS = (3, 1, 250)


def one_scan(number, origin, optional=True):
    rng = np.random.default_rng(number)
    count = COUNTS[number]
    T = np.eye(4)
    T[:2, :2] = [[0, -1], [1, 0]]
    T[:3, 3] = np.add(origin, [number, 0, 0])
    points = rng.normal(0, 30, (count, 3))
    if not optional:
        return Scan(points, T)
    intensities, doppler = (rng.normal(0, 30, count).astype(np.float32) for _ in range(2))
    return Scan(points, T, intensities, doppler, 1.7e9 + 0.1 * number)


def lazily(origin, optional=True):
    """Scans of a source, and how often they were read."""
    reads = []

    def source():
        reads.append(1)
        return (one_scan(number, origin, optional) for number in range(len(COUNTS)))

    return Scans.of_source(source, Notes()), reads


def expected(origin):
    scans = [one_scan(number, origin) for number in range(len(COUNTS))]
    world = np.concatenate([s.points @ s.T_world_sensor[:3, :3].T + s.T_world_sensor[:3, 3] for s in scans])
    columns = dict(zip("xyz", world.T, strict=True))
    columns["intensity"] = np.concatenate([s.intensities for s in scans])
    columns["doppler"] = np.concatenate([s.doppler_mps for s in scans])
    columns["scan"] = np.repeat(np.arange(len(COUNTS)), COUNTS)
    columns["time"] = np.concatenate([np.full(len(s), s.time_s) for s in scans])
    return columns


@pytest.mark.parametrize("suffix", CLOUD_OUT_SUFFIXES)
@pytest.mark.parametrize("origin", [np.zeros(3), UTM_M], ids=["near", "UTM"])
def test_written_clouds_are_read_back_unchanged(tmp_path, suffix, origin):
    if suffix in (".las", ".laz") and find_spec("laspy") is None:
        pytest.skip("laspy is not installed")
    scans, reads = lazily(origin)
    path = tmp_path / f"cloud{suffix}"
    if suffix == ".pcd" and origin[0] > 0:
        with pytest.raises(ValueError, match="float32"):
            write_cloud(path, scans)
        return
    assert (write_cloud(path, scans), reads) == (sum(COUNTS), [1])
    columns, right = read_columns(path), expected(origin)
    for name in ("intensity", "doppler", "scan", "time"):
        np.testing.assert_array_equal(columns[name].astype(right[name].dtype), right[name])
    tolerance_m = {".las": 6e-5, ".laz": 6e-5, ".pcd": 1e-5}.get(suffix, 0)
    world = np.stack([right[axis] for axis in "xyz"], axis=1)
    np.testing.assert_allclose(read_points(path), world, rtol=0, atol=tolerance_m)


def test_columns_missing_in_some_scans_are_omitted(tmp_path):
    scans, _ = lazily(np.zeros(3), optional=False)
    write_cloud(tmp_path / "cloud.ply", scans)
    assert list(read_columns(tmp_path / "cloud.ply")) == ["x", "y", "z", "scan"]
    mixed = Scans.of_source(lambda: iter([one_scan(0, 0.0), one_scan(1, 0.0, optional=False)]), Notes())
    write_cloud(tmp_path / "mixed.csv", mixed)
    assert "intensity" not in read_columns(tmp_path / "mixed.csv")
