# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Scans and their ``.npz`` files."""

from __future__ import annotations

import io
import zipfile
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from radarsdf.io.files import check_regular_file, write_whole

_ARRAYS = ("points", "frame", "poses", "intensity", "static", "lidar_points")
# A few megabytes of zeros can unpack to gigabytes. Measurements are mostly noise and compress by a factor of 2 to 5.
_MAX_COMPRESSION = 100
_ALWAYS_UNPACKED = 1 << 28  # bytes; smaller files are unpacked at any compression


@dataclass(frozen=True)
class Scans:
    """F scans with poses, and lidar points as ground truth where there are any."""

    points: list[NDArray[Any]]
    """F arrays (N_i, 3), sensor frame, m."""
    poses: NDArray[np.float64]
    """(F, 4, 4) T_world_sensor, m."""
    intensities: list[NDArray[Any]] | None
    """F arrays (N_i,), sensor units. None if the sensor does not measure them."""
    ground_truth: NDArray[Any] | None = None
    """(M, 3) lidar points, world frame, m."""

    def select(self, frames: NDArray[np.int64]) -> Scans:
        """The scans with the numbers `frames`, (K,), in this order."""
        intensities = None if self.intensities is None else [self.intensities[i] for i in frames]
        return Scans([self.points[i] for i in frames], self.poses[frames], intensities, self.ground_truth)


def read_scans(path: str | PathLike[str]) -> Scans:
    """Reads scans from a file.

    Parameters
    ----------
    path : path-like
        An ``.npz`` file with these arrays:

        - ``points`` (N, 3): returns, sensor frame, m;
        - ``poses`` (F, 4, 4): T_world_sensor, m;
        - ``frame`` (N,): row of ``poses`` for each return;
        - ``intensity`` (N,), optional: sensor units;
        - ``static`` (N,) bool, optional: only returns with True are used;
        - ``lidar_points`` (M, 3), optional: ground truth, world frame, m.

    Returns
    -------
    Scans
        One scan for each row of ``poses`` with at least one return.

    Raises
    ------
    ValueError
        If the file has another format, or its arrays do not fit together.
    OSError
        If the file cannot be read.
    """
    if Path(path).suffix != ".npz":
        msg = f"{path} is not an .npz file: only .npz files of scans can be read"
        raise ValueError(msg)
    check_regular_file(path)
    try:
        arrays = _read_arrays(Path(path))
    except Exception as error:  # damaged files raise exceptions of many kinds, among them OSError
        msg = f"{path} is not a whole .npz file: {error}"
        raise ValueError(msg) from error
    if missing := sorted({"points", "frame", "poses"} - set(arrays)):
        msg = f"{path} lacks the arrays {', '.join(missing)}"
        raise ValueError(msg)
    points, frame, poses = arrays["points"], arrays["frame"], arrays["poses"]
    count, num_poses = points.shape[:1], poses.shape[:1]
    for name, shape in {
        "points": (*count, 3), "poses": (*num_poses, 4, 4), "frame": count, "intensity": count, "static": count
    }.items():  # fmt: skip
        if name in arrays and arrays[name].shape != shape:
            msg = f"{path}: {name} must have shape {shape}, not {arrays[name].shape}"
            raise ValueError(msg)
    truth = arrays.get("lidar_points", points)
    if truth.ndim != 2 or truth.shape[1] != 3:
        msg = f"{path}: lidar_points must have shape (M, 3), not {truth.shape}"
        raise ValueError(msg)
    for name, array in arrays.items():
        if array.dtype.kind not in ("biuf" if name == "static" else "iuf"):
            msg = f"{path}: {name} must be real numbers, not {array.dtype}"
            raise ValueError(msg)
    if (frame != np.floor(frame)).any():
        msg = f"{path}: frame must hold row numbers of poses"
        raise ValueError(msg)
    if len(frame) and not 0 <= frame.min() <= frame.max() < len(poses):
        msg = f"{path}: frame must lie in [0, {len(poses)})"
        raise ValueError(msg)
    used = arrays.get("static", np.ones(len(frame), bool)).astype(bool)
    frame = frame.astype(np.int64)
    order = np.flatnonzero(used)
    order = order[np.argsort(frame[order], kind="stable")]
    frames, first = np.unique(frame[order], return_index=True)
    rows = np.split(order, first)[1:]  # the part before the first scan is empty
    return Scans(
        points=[points[r] for r in rows],
        poses=poses[frames].astype(np.float64),
        intensities=[arrays["intensity"][r] for r in rows] if "intensity" in arrays else None,
        ground_truth=arrays.get("lidar_points"),
    )


def _read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    with zipfile.ZipFile(path) as file:
        names = file.namelist()
        members = {name: file.getinfo(f"{name}.npy") for name in _ARRAYS if f"{name}.npy" in names}
        unpacked = sum(member.file_size for member in members.values())
        if unpacked > max(_ALWAYS_UNPACKED, _MAX_COMPRESSION * path.stat().st_size):
            msg = f"its arrays would unpack to {unpacked} bytes: measurements do not compress that much"
            raise ValueError(msg)
        arrays = {}
        for name, member in members.items():
            with file.open(member) as stream:
                arrays[name] = np.lib.format.read_array(stream, allow_pickle=False)
        return arrays


def write_scans(path: str | PathLike[str], scans: Scans) -> None:
    """Writes scans as the ``.npz`` file that :func:`read_scans` reads, whole or not at all.

    Parameters
    ----------
    path : path-like
        Where the file goes. ``.npz`` is appended where it is missing.
    scans : Scans
        At least one scan. Where `intensities` or `ground_truth` is None, the file lacks its array.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    arrays: dict[str, NDArray[Any]] = {
        "points": np.concatenate(scans.points),
        "frame": np.repeat(np.arange(len(scans.points), dtype=np.int32), [len(p) for p in scans.points]),
        "poses": scans.poses,
    }
    if scans.intensities is not None:
        arrays["intensity"] = np.concatenate(scans.intensities)
    if scans.ground_truth is not None:
        arrays["lidar_points"] = scans.ground_truth
    file = io.BytesIO()
    np.savez_compressed(file, **arrays)  # type: ignore[arg-type]
    target = Path(path)
    write_whole(
        target if target.suffix == ".npz" else target.with_name(f"{target.name}.npz"), file.getvalue()
    )
