# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Scans from files. One function a format; all return :class:`Scans`."""

from __future__ import annotations

import zipfile
import zlib
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Scans:
    """What a fit needs, and a ground truth where the file has one."""

    points: list[NDArray[Any]]
    """F arrays (N_i, 3), sensor frame, m."""
    poses: NDArray[np.float64]
    """(F, 4, 4) T_world_sensor."""
    intensities: list[NDArray[Any]] | None
    """F arrays (N_i,), sensor units."""
    ground_truth: NDArray[Any] | None = None
    """(M, 3) lidar points, world, m."""

    def select(self, frames: NDArray[np.int64]) -> Scans:
        """The scans of these frames only."""
        intensities = None if self.intensities is None else [self.intensities[i] for i in frames]
        return Scans([self.points[i] for i in frames], self.poses[frames], intensities, self.ground_truth)


def read_scans(path: str | PathLike[str]) -> Scans:
    """Reads scans from a file.

    Parameters
    ----------
    path : path-like
        An ``.npz`` file with the arrays ``points`` (N, 3), sensor frame, m; ``frame`` (N,), each return's row in
        ``poses`` (F, 4, 4), T_world_sensor; and, where there are any, ``intensity`` (N,), ``static`` (N,) bool (only
        these returns are used) and ``lidar_points`` (M, 3), world, m. Frames without a return are left out.

    Raises
    ------
    ValueError
        If the file is of another kind, or its arrays do not fit together.
    OSError
        If it cannot be read.
    """
    if Path(path).suffix != ".npz":
        msg = f"{path}: only .npz files of scans can be read"
        raise ValueError(msg)
    try:
        with zipfile.ZipFile(path) as file:
            arrays = {Path(n).stem: np.lib.format.read_array(file.open(n)) for n in file.namelist()}
    except (zipfile.BadZipFile, zlib.error, EOFError, ValueError) as error:
        msg = f"{path} is not a whole .npz file: {error}"
        raise ValueError(msg) from error
    if missing := sorted({"points", "frame", "poses"} - set(arrays)):
        msg = f"{path} lacks the arrays {', '.join(missing)}"
        raise ValueError(msg)
    points, frame, poses = arrays["points"], arrays["frame"], arrays["poses"]
    if (
        points.ndim != 2
        or poses.ndim != 3
        or frame.dtype.kind not in "iuf"
        or (frame != np.floor(frame)).any()
    ):
        msg = f"{path}: points must have shape (N, 3), poses (F, 4, 4), and frame be row numbers"
        raise ValueError(msg)
    count = len(points)
    for name in ("frame", "intensity", "static"):
        if name in arrays and arrays[name].shape != (count,):
            msg = f"{path}: {name} must have shape ({count},), not {arrays[name].shape}"
            raise ValueError(msg)
    if count and not 0 <= frame.min() <= frame.max() < len(poses):
        msg = f"{path}: frame must lie in [0, {len(poses)})"
        raise ValueError(msg)
    used = arrays.get("static", np.ones(count, bool)).astype(bool)
    frame = frame.astype(np.int64)
    frames = np.unique(frame[used])
    rows = [np.flatnonzero(used & (frame == i)) for i in frames]
    return Scans(
        points=[points[r] for r in rows],
        poses=poses[frames].astype(np.float64),
        intensities=[arrays["intensity"][r] for r in rows] if "intensity" in arrays else None,
        ground_truth=arrays.get("lidar_points"),
    )


def write_scans(path: str | PathLike[str], scans: Scans) -> None:
    """Writes scans as the ``.npz`` file that :func:`read_scans` reads."""
    arrays: dict[str, NDArray[Any]] = {
        "points": np.concatenate(scans.points),
        "frame": np.repeat(np.arange(len(scans.points), dtype=np.int32), [len(p) for p in scans.points]),
        "poses": scans.poses,
    }
    if scans.intensities is not None:
        arrays["intensity"] = np.concatenate(scans.intensities)
    if scans.ground_truth is not None:
        arrays["lidar_points"] = scans.ground_truth
    np.savez_compressed(path, **arrays)  # type: ignore[arg-type]
