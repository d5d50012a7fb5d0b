# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Damaged and malicious files: every reader must read a file, or raise a ValueError or OSError that names it."""

from __future__ import annotations

import collections
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import radarsdf
from radarsdf.fitting.checkpoint import Checkpoint
from radarsdf.io import read
from radarsdf.io.meshes import read_ground_truth, read_mesh
from radarsdf.io.npz import read_scans
from radarsdf.io.poses import trajectory_of
from radarsdf.io.text import read_numbers

from .. import samples
from . import readers
from .mutations import boundaries, mutate

MAX_SECONDS = 5.0  # processor time for one file


@dataclass(frozen=True)
class Reader:
    """A function that reads files, and the files to test it with."""

    read: Callable[[Path], object]
    name: str
    """Name of the file."""
    valid: Callable[[], list[bytes]]
    """Returns valid files."""
    hostile: Callable[[np.random.Generator], bytes] | None = None
    """Returns a file that is damaged with knowledge of its format."""


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


def _trajectory(path: Path) -> None:
    trajectory = trajectory_of(read_numbers(path, 8), str(path))
    assert len(trajectory.times_s) == len(trajectory.positions) == len(trajectory.rotations) >= 2


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
        points, _ = scans.points, scans.ground_truth  # which read the files
    except ValueError as error:
        if str(folder) in str(error):  # a valid file is named if it does not fit to the damaged one
            msg = f"{path}: {error}"
            raise ValueError(msg) from error
        raise
    assert 1 <= len(points) == len(scans.poses) <= 2  # one of the two scans may have no pose


READERS = {
    "checkpoint": Reader(_checkpoint, "state", samples.checkpoints),
    "eval: text": Reader(_points, "truth.xyz", samples.tables),
    "eval: array": Reader(_points, "truth.npy", samples.arrays),
    "eval: points": Reader(_points, "truth.ply", samples.meshes),
    "eval: mesh": Reader(_mesh, "mesh.ply", samples.meshes),
    "load": Reader(_load, "map.safetensors", samples.maps, samples.hostile_map),
    "read_scans": Reader(_scans, "scans.npz", samples.scans, samples.hostile_scans),
    "trajectory_of": Reader(_trajectory, "poses.txt", samples.trajectories),
    "folder: scan": Reader(_folder, "radar/100.0.pcd", samples.clouds),
    "folder: poses": Reader(_folder, "poses.txt", samples.trajectories),
    "folder: mounting": Reader(_folder, "base_T_radar.txt", samples.transforms),
    "folder: lidar": Reader(_folder, "lidar.ply", samples.meshes),
    "read: PCD": Reader(readers.read_one, "scan.pcd", samples.clouds),
    "read: array": Reader(readers.read_one, "scan.npy", readers.arrays),
    "read: KITTI": Reader(readers.read_one, "scan.bin", readers.kitti),
    "read: text": Reader(readers.read_one, "scan.csv", readers.text),
    "read: PLY": Reader(readers.read_one, "scan.ply", readers.plys),
    "read: LAS": Reader(readers.read_one, "scan.las", readers.las("las")),
    "read: LAZ": Reader(readers.read_one, "scan.laz", readers.las("laz")),
    "read: ROS 1": Reader(readers.read_bag, "drive.bag", readers.bags("ros1")),
    "read: sqlite3": Reader(readers.read_bag, "drive.db3", readers.bags("sqlite3")),
    "read: mcap": Reader(readers.read_bag, "drive.mcap", readers.bags("mcap")),
    "read_poses": Reader(readers.read_pose_file, "poses.txt", readers.poses),
}


@dataclass
class Outcomes:
    """Results of one reader."""

    counts: collections.Counter[str] = field(default_factory=collections.Counter)
    failures: list[str] = field(default_factory=list)
    slowest_s: float = 0.0


def damaged(reader: Reader, seed: int) -> Iterator[bytes]:
    """Endless files, the same for the same seed. First come the valid ones, whole and cut at every boundary."""
    valid = reader.valid()
    for data in valid:
        yield data
        yield from (data[:end] for end in boundaries(data))
    rng = np.random.default_rng(seed)
    while True:
        if reader.hostile is not None and rng.random() < 0.4:
            data = reader.hostile(rng)
            yield mutate(rng, data, valid) if rng.random() < 0.2 else data
        else:
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
    outcomes.slowest_s = max(outcomes.slowest_s, seconds)
    if seconds > MAX_SECONDS:
        outcomes.failures.append(f"{seconds:.1f} s")


def place(reader: Reader, folder: Path) -> Path:
    """Path of the file of a reader in `folder`. For `radarsdf.io.read`, the other files are written."""
    if reader.read is _folder:
        samples.write_folder(folder)
    return folder / reader.name
