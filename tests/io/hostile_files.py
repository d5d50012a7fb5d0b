"""Damaged and malicious files: every reader must read a file, or raise a ValueError or OSError that names it."""

import collections
import io
import logging
import re
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np
import radarsdf
from numpy.typing import NDArray
from radarsdf.fitting.checkpoint import Checkpoint
from radarsdf.io import read
from radarsdf.io.meshes import read_ground_truth, read_mesh
from radarsdf.io.npz import read_scans
from radarsdf.io.poses import read_poses
from radarsdf.scans import Notes

from .. import samples
from .bag_writing import BagWriter

_Item = TypeVar("_Item")
_NUMBER = re.compile(rb"-?\d+\.?\d*(?:[eE][-+]?\d+)?")
_WORDS = [
    b"0", b"-1", b"1", b"nan", b"-inf", b"1e308", b"1e999", b"1e-320", b"2147483648", b"4294967296", b"9" * 19, b"9" * 40,
    b"9" * 5000, b"", b" ", b"\x00", b"\xff\xfe", b"0x10", b"1_000", "٣".encode(), b"None", b"true", b"[" * 3000,
]  # fmt: skip
_INTEGERS = [0, 1, 0xFF, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**64 - 1, 2**40, 2**62]


def boundaries(data: bytes) -> list[int]:
    """Lengths at which to cut a file: in the first bytes, at line ends, zip headers, ends of zeros and at the end."""
    ends = set(range(min(len(data), 64)))
    for match in list(re.finditer(rb"\n|PK..|\x00[^\x00]", data, re.DOTALL))[:200]:
        ends |= {match.start(), match.start() + 1, match.end()}
    return sorted(end for end in ends | {len(data) - 1, len(data) - 8} if 0 <= end < len(data))


def mutate(rng: np.random.Generator, data: bytes, others: list[bytes]) -> bytes:
    """`data` with one to three random changes, some with parts of `others`."""
    for _ in range(rng.integers(1, 4)):
        data = _one_of(rng, _CHANGES)(rng, data, others)
    return data


def _one_of(rng: np.random.Generator, items: Sequence[_Item]) -> _Item:
    return items[int(rng.integers(len(items)))]


def _position(rng: np.random.Generator, data: bytes) -> int:
    """A random position, in half of the cases near the beginning or the end, where headers are."""
    size = max(len(data), 1)
    if rng.random() < 0.5:
        return int(rng.integers(size))
    near = min(int(rng.integers(600)), size - 1)
    return near if rng.random() < 0.7 else size - 1 - near


def _flip(rng: np.random.Generator, data: bytes, _: list[bytes]) -> bytes:
    changed = bytearray(data or b"\0")
    for _i in range(rng.integers(1, 9)):
        changed[_position(rng, data)] ^= 1 << int(rng.integers(8))
    return bytes(changed)


def _truncate(rng: np.random.Generator, data: bytes, _: list[bytes]) -> bytes:
    return data[: _position(rng, data)]


def _integer(rng: np.random.Generator, data: bytes, _: list[bytes]) -> bytes:
    at, size = _position(rng, data), int(rng.choice([2, 4, 8]))
    value: int = _one_of(rng, _INTEGERS) % 2 ** (8 * size)
    return data[:at] + value.to_bytes(size, "little") + data[at + size :]


def _splice(rng: np.random.Generator, data: bytes, others: list[bytes]) -> bytes:
    other = _one_of(rng, others)
    return data[: _position(rng, data)] + other[_position(rng, other) :]


def _number(rng: np.random.Generator, data: bytes, _: list[bytes]) -> bytes:
    """A number in the text of the file is replaced."""
    matches = list(_NUMBER.finditer(data[:20_000]))
    if not matches:
        return data
    match = _one_of(rng, matches)
    return data[: match.start()] + _one_of(rng, _WORDS) + data[match.end() :]


_CHANGES: list[Callable[[np.random.Generator, bytes, list[bytes]], bytes]]
_CHANGES = [_flip, _truncate, _integer, _splice, _number]


_TABLE = np.random.default_rng(1).uniform(1, 9, (12, 4)).astype(np.float32)
_START_S = 1_700_000_000.0


def read_one(path: Path) -> None:
    """Reads the scan of one file."""
    logging.getLogger("radarsdf.io").setLevel(logging.CRITICAL)
    for scan in read(path, np.eye(4)[None]):
        assert scan.points.shape == (len(scan), 3)
        assert np.isfinite(scan.points).all()


def read_bag(path: Path) -> None:
    """Reads the scans of a bag."""
    logging.getLogger("radarsdf.io").setLevel(logging.CRITICAL)
    for scan in read(path, max_gap_s=1e12):
        assert scan.points.shape == (len(scan), 3)
        assert np.isfinite(scan.T_world_sensor).all()


def read_pose_file(path: Path) -> None:
    """Reads a file of poses."""
    poses = read_poses(path, Notes())
    assert not isinstance(poses, np.ndarray) or poses.shape[1:] == (4, 4)


def scan_arrays() -> list[bytes]:
    """Arrays of NumPy: a table, and records."""
    files = []
    records = np.zeros(12, [("x", "f8"), ("y", "f4"), ("z", "f4"), ("power", "u2")])
    records["x"] = _TABLE[:, 0]
    for array in (_TABLE, records):
        data = io.BytesIO()
        np.save(data, array)
        files.append(data.getvalue())
    return files


def kitti() -> list[bytes]:
    """Rows of four float32."""
    return [_TABLE.tobytes()]


def tables() -> list[bytes]:
    """Tables with and without a header."""
    rows = "".join(" ".join(map(str, row)) + "\n" for row in _TABLE.tolist())
    return [rows.encode(), ("x,y,z,power\n" + rows.replace(" ", ",")).encode()]


def las(suffix: str) -> Callable[[], list[bytes]]:
    """LAS or LAZ files."""

    def files() -> list[bytes]:
        import laspy  # noqa: PLC0415 - an extra

        written = []
        for point_format, version in ((0, "1.2"), (6, "1.4")):  # LAZ compresses the latter in layers
            header = laspy.LasHeader(point_format=point_format, version=version)
            header.scales = np.full(3, 1e-4)
            cloud = laspy.LasData(header)
            cloud.x, cloud.y, cloud.z = _TABLE[:, :3].T.astype(np.float64)
            written.append(_written(cloud.write, f"a.{suffix}"))
        return written

    return files


def pose_files() -> list[bytes]:
    """KITTI and 4 x 4."""
    matrices = np.tile(np.eye(4), (3, 1, 1))
    matrices[:, 0, 3] = [1, 2, 3]
    return [_rows(matrices[:, :3].reshape(3, 12)), _rows(matrices.reshape(12, 4))]


def bags(kind: str) -> Callable[[], list[bytes]]:
    """Bags with each kind of message of points; poses are odometry or transforms."""

    def files() -> list[bytes]:
        name = "a.bag" if kind == "ros1" else "a"
        return [_written(partial(_bag, kind=kind, points=points), name) for points in range(3)]

    return files


def _bag(path: Path, kind: str, points: int) -> None:
    columns = dict(zip(("x", "y", "z", "power"), np.ascontiguousarray(_TABLE.T), strict=True))
    with BagWriter(path, kind) as bag:
        for i in range(4):
            time_s, pose = _START_S + 0.1 * i, np.eye(4)
            pose[0, 3] = i
            if points == 0:
                bag.write("/odom", bag.odometry(time_s, pose, child="radar"), time_s)
            else:
                bag.write("/tf", bag.transforms(time_s, {("map", "radar"): pose}), time_s)
            message = (
                bag.cloud2(time_s, columns) if points == 0
                else bag.cloud(time_s, columns) if points == 1
                else bag.radar_scan(time_s, np.ones((5, 5)))
            )  # fmt: skip
            bag.write("/radar", message, time_s)


def _written(write: Callable[[Path], object], name: str) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        write(path)
        if path.is_dir():
            path = next(file for file in path.iterdir() if file.suffix in (".mcap", ".db3"))
        return path.read_bytes()


def _rows(table: NDArray[np.float64]) -> bytes:
    return "".join(" ".join(map(repr, row)) + "\n" for row in table.tolist()).encode()


MAX_SECONDS = 5.0  # processor time for one file


@dataclass(frozen=True)
class Reader:
    """A function that reads files of a name, and a function that returns valid ones."""

    read: Callable[[Path], object]
    name: str
    valid: Callable[[], list[bytes]]


def _load(path: Path) -> None:
    """Loads a map and queries it."""
    radar_map = radarsdf.load(path)
    x = np.zeros((2, 3))
    assert radar_map.sdf(x).shape == radar_map.observed(x).shape == (2,)


def _scans(path: Path) -> None:
    scans = read_scans(path)
    assert scans.poses.shape == (len(scans.points), 4, 4)
    assert all(points.ndim == 2 and points.shape[1] == 3 and len(points) for points in scans.points)
    if scans.intensities is not None:
        assert list(map(len, scans.intensities)) == list(map(len, scans.points))


def _checkpoint(path: Path) -> None:
    Checkpoint(path, *samples.fit_of_checkpoints()).resume(samples.training())


def _points(path: Path) -> None:
    assert isinstance(read_ground_truth(path), np.ndarray)


def _mesh(path: Path) -> None:
    mesh = read_mesh(path)
    assert np.asarray(mesh.faces).ndim == 2


def _folder(path: Path) -> None:
    """Reads a folder with the damaged file among valid ones. A ValueError may name any file of the folder."""
    folder = path.parent if path.parent.name != "radar" else path.parent.parent
    try:
        scans = read(folder)
        points, _ = scans.points, scans.ground_truth  # which reads the files
    except ValueError as error:
        if str(folder) in str(error):  # a valid file is named if it is inconsistent with the damaged one
            msg = f"{path}: {error}"
            raise ValueError(msg) from error
        raise
    assert 1 <= len(points) == len(scans.poses) <= 2  # one of the two scans may have no pose


READERS = {
    "checkpoint": Reader(_checkpoint, "state", samples.checkpoints),
    "eval: points": Reader(_points, "truth.ply", samples.meshes),
    "eval: mesh": Reader(_mesh, "mesh.ply", samples.meshes),
    "load": Reader(_load, "map.safetensors", samples.maps),
    "read_scans": Reader(_scans, "scans.npz", samples.scans),
    "folder: scan": Reader(_folder, "radar/100.0.pcd", samples.clouds),
    "folder: poses": Reader(_folder, "poses.txt", samples.trajectories),
    "folder: mounting": Reader(_folder, "base_T_radar.txt", samples.transforms),
    "folder: lidar": Reader(_folder, "lidar.ply", samples.meshes),
    "read: PCD": Reader(read_one, "scan.pcd", samples.clouds),
    "read: array": Reader(read_one, "scan.npy", scan_arrays),
    "read: KITTI": Reader(read_one, "scan.bin", kitti),
    "read: text": Reader(read_one, "scan.csv", tables),
    "read: LAS": Reader(read_one, "scan.las", las("las")),
    "read: LAZ": Reader(read_one, "scan.laz", las("laz")),
    "read: ROS 1": Reader(read_bag, "drive.bag", bags("ros1")),
    "read: sqlite3": Reader(read_bag, "drive.db3", bags("sqlite3")),
    "read: mcap": Reader(read_bag, "drive.mcap", bags("mcap")),
    "read_poses": Reader(read_pose_file, "poses.txt", pose_files),
}


@dataclass
class Outcomes:
    """Results of one reader."""

    counts: collections.Counter[str] = field(default_factory=collections.Counter)
    failures: list[str] = field(default_factory=list)


def damaged(reader: Reader, seed: int) -> Iterator[bytes]:
    """Infinite sequence of files, deterministic by seed: first the valid ones, complete and truncated at every boundary."""
    valid = reader.valid()
    for data in valid:
        yield data
        yield from (data[:end] for end in boundaries(data))
    rng = np.random.default_rng(seed)
    while True:
        yield mutate(rng, valid[rng.integers(len(valid))], valid)


def try_file(reader: Reader, path: Path, data: bytes, outcomes: Outcomes) -> None:
    """Read `data` from a file at `path`, and add the result to `outcomes`."""
    path.write_bytes(data)
    started = time.process_time()
    try:
        reader.read(path)
        kind = "read"
    except ValueError as error:
        kind = "ValueError" if str(path) in str(error) else "ValueError without the file's name"
        if kind != "ValueError":
            outcomes.failures.append(f"{error!r}")
    except OSError as error:
        kind = "OSError"
        if str(path) not in str(error):
            outcomes.failures.append(f"{error!r}")
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # noqa: BLE001 - a panic of the safetensors library is not an Exception
        kind = type(error).__name__
        outcomes.failures.append(f"{error!r}")
    seconds = time.process_time() - started
    outcomes.counts[kind] += 1
    if seconds > MAX_SECONDS:
        outcomes.failures.append(f"{seconds:.1f} s")


def place(reader: Reader, folder: Path) -> Path:
    """Path of the file of a reader in `folder`. For `radarsdf.io.read`, the other files are written."""
    if reader.read is _folder:
        samples.write_folder(folder)
    return folder / reader.name
