# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Valid files of what `radarsdf.io.read` reads, to be damaged."""

from __future__ import annotations

import io
import logging
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from radarsdf.io import read
from radarsdf.io.poses import read_poses
from radarsdf.scans import Notes

from .bag_writing import BagWriter

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


def arrays() -> list[bytes]:
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


def text() -> list[bytes]:
    """Tables with and without a header."""
    rows = "".join(" ".join(map(str, row)) + "\n" for row in _TABLE.tolist())
    return [rows.encode(), ("x,y,z,power\n" + rows.replace(" ", ",")).encode()]


def plys() -> list[bytes]:
    """Point clouds as PLY, binary and ASCII."""
    cloud: Any = trimesh.PointCloud(_TABLE[:, :3])  # type: ignore[no-untyped-call]
    return [cloud.export(file_type="ply", encoding=encoding) for encoding in ("binary", "ascii")]


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


def poses() -> list[bytes]:
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
