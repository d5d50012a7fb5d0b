# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The same scans written in each format, and how others read them."""

from __future__ import annotations

import importlib
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from radarsdf.io import Scans, write_scans

from .bag_writing import BagWriter

START_S = 1_700_000_000.0
_PERIOD_S = 0.1
_LITERALS = 32


@dataclass(frozen=True)
class Format:
    """A format: how it is written, and how a peer reads it."""

    write: Callable[[Path, list[NDArray[np.float32]]], Path]
    """Writes scans (N, 5) of x, y, z, intensity and Doppler; returns what is to be read."""
    peer: str | None = None
    peer_reads: Callable[[Path], float] | None = None
    """Returns the sum of all coordinates, so that nothing is left unread."""


def make_scans(count: int, returns: int) -> list[NDArray[np.float32]]:
    """`count` scans of `returns` returns (N, 5), with an intensity in steps of 0.5 as sensors give it."""
    rng = np.random.default_rng(0)
    scans = []
    for _ in range(count):
        table = rng.normal(scale=20, size=(returns, 5))
        table[:, 3] = np.round(rng.uniform(90, 180, returns)) / 2
        scans.append(table.astype(np.float32))
    return scans


def poses(count: int) -> NDArray[np.float64]:
    """(F, 4, 4) of a sensor that drives along x."""
    matrices = np.tile(np.eye(4), (count, 1, 1))
    matrices[:, 0, 3] = np.arange(count)
    return matrices


def _columns(scan: NDArray[np.float32]) -> dict[str, NDArray[np.float32]]:
    names = ("x", "y", "z", "power", "doppler")
    return dict(zip(names, np.ascontiguousarray(scan.T), strict=True))


def _npz(folder: Path, scans: list[NDArray[np.float32]]) -> Path:
    write_scans(
        folder / "scans.npz",
        Scans(
            [scan[:, :3] for scan in scans],
            poses(len(scans)),
            [scan[:, 3] for scan in scans],
            doppler_mps=[scan[:, 4] for scan in scans],
        ),
    )
    return folder / "scans.npz"


def _pcd(data: str) -> Callable[[Path, list[NDArray[np.float32]]], Path]:
    def write(folder: Path, scans: list[NDArray[np.float32]]) -> Path:
        for i, scan in enumerate(scans):
            header = (
                "VERSION 0.7\nFIELDS x y z power doppler\nSIZE 4 4 4 4 4\nTYPE F F F F F\nCOUNT 1 1 1 1 1\n"
                f"WIDTH {len(scan)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(scan)}\nDATA {data}\n"
            ).encode()
            if data == "ascii":
                body = "\n".join(" ".join(f"{x:.4f}" for x in row) for row in scan.tolist()).encode() + b"\n"
            elif data == "binary":
                body = scan.tobytes()
            else:  # without any reference, which is the slowest to unpack: noise does not compress
                raw = np.ascontiguousarray(scan.T).tobytes()
                parts = (raw[at : at + _LITERALS] for at in range(0, len(raw), _LITERALS))
                packed = b"".join(bytes([len(part) - 1]) + part for part in parts)
                body = struct.pack("<II", len(packed), len(raw)) + packed
            (folder / f"{i}.pcd").write_bytes(header + body)
        return folder

    return write


def _ply(folder: Path, scans: list[NDArray[np.float32]]) -> Path:
    for i, scan in enumerate(scans):
        cloud: Any = trimesh.PointCloud(scan[:, :3])  # type: ignore[no-untyped-call]
        (folder / f"{i}.ply").write_bytes(cloud.export(file_type="ply"))
    return folder


def _bin(folder: Path, scans: list[NDArray[np.float32]]) -> Path:
    for i, scan in enumerate(scans):
        scan[:, :4].tofile(folder / f"{i}.bin")
    return folder


def _npy(folder: Path, scans: list[NDArray[np.float32]]) -> Path:
    for i, scan in enumerate(scans):
        np.save(folder / f"{i}.npy", scan)
    return folder


def _csv(folder: Path, scans: list[NDArray[np.float32]]) -> Path:
    for i, scan in enumerate(scans):
        np.savetxt(folder / f"{i}.csv", scan, "%.4f", ",", header="x,y,z,power,doppler", comments="")
    return folder


def _las(suffix: str) -> Callable[[Path, list[NDArray[np.float32]]], Path]:
    def write(folder: Path, scans: list[NDArray[np.float32]]) -> Path:
        import laspy  # noqa: PLC0415 - an extra

        for i, scan in enumerate(scans):
            header = laspy.LasHeader(point_format=0, version="1.2")
            header.scales = np.full(3, 1e-4)
            cloud = laspy.LasData(header)
            cloud.x, cloud.y, cloud.z = scan[:, :3].T.astype(np.float64)
            cloud.write(folder / f"{i}.{suffix}")
        return folder

    return write


def _bag(kind: str, message: str = "cloud2") -> Callable[[Path, list[NDArray[np.float32]]], Path]:
    def write(folder: Path, scans: list[NDArray[np.float32]]) -> Path:
        path = folder / ("drive.bag" if kind == "ros1" else "drive")
        with BagWriter(path, kind) as bag:
            for i, scan in enumerate(scans):
                time_s = START_S + _PERIOD_S * i
                bag.write("/odom", bag.odometry(time_s, poses(i + 1)[-1], child="radar"), time_s)
                bag.write("/radar", getattr(bag, message)(time_s, _columns(scan)), time_s)
        return path

    return write


def _by_open3d(folder: Path) -> float:
    open3d: Any = importlib.import_module("open3d")  # of the extra peers, which may be missing
    total = 0.0
    for path in sorted(folder.iterdir()):
        cloud = open3d.t.io.read_point_cloud(str(path))
        total += float(cloud.point.positions.numpy().sum(dtype=np.float64))
    return total


def _by_rosbags(path: Path) -> float:
    """Messages by the type system of rosbags, points by a view, as its manual shows it."""
    from rosbags.highlevel import AnyReader  # noqa: PLC0415 - an extra

    total = 0.0
    with AnyReader([path]) as reader:
        connections = [c for c in reader.connections if c.topic == "/radar"]
        for connection, _, raw in reader.messages(connections=connections):
            message: Any = reader.deserialize(raw, connection.msgtype)
            if connection.msgtype.endswith("PointCloud2"):
                record = np.dtype({"names": ["xyz"], "formats": ["(3,)<f4"], "itemsize": message.point_step})
                total += float(np.frombuffer(message.data, record)["xyz"].sum(dtype=np.float64))
            else:
                total += sum(point.x + point.y + point.z for point in message.points)
    return total


FORMATS = {
    ".npz of radarsdf": Format(_npz),
    "PCD ascii": Format(_pcd("ascii"), "Open3D", _by_open3d),
    "PCD binary": Format(_pcd("binary"), "Open3D", _by_open3d),
    "PCD binary_compressed": Format(_pcd("binary_compressed"), "Open3D", _by_open3d),
    "PLY, x y z": Format(_ply, "Open3D", _by_open3d),
    "KITTI .bin": Format(_bin),
    ".npy": Format(_npy),
    "CSV": Format(_csv),
    "LAS, x y z": Format(_las("las")),
    "LAZ, x y z": Format(_las("laz")),
    "ROS 1, PointCloud2": Format(_bag("ros1"), "rosbags", _by_rosbags),
    "ROS 1, PointCloud": Format(_bag("ros1", "cloud"), "rosbags", _by_rosbags),
    "ROS 2 sqlite3, PointCloud2": Format(_bag("sqlite3"), "rosbags", _by_rosbags),
    "ROS 2 mcap, PointCloud2": Format(_bag("mcap"), "rosbags", _by_rosbags),
}
