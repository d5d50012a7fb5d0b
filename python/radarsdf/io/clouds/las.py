# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""LAS and LAZ, read and written by laspy."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from radarsdf.extras import require

# The extra dimension of intensities: LAS's own are whole numbers from 0 to 65535.
_INTENSITY = "radar_intensity"
_SCALE_M = 1e-4
_POINT_FORMAT = 6  # the first of LAS 1.4, with a time

_MAX_COMPRESSION = 200  # LAZ packs lidar points to a tenth
_HEADER_BYTES, _COUNT_AT, _RECORD_BYTES = 227, 100, 54  # of the least header, and the least record behind it


def read_las(path: Path) -> dict[str, NDArray[Any]]:
    """The columns (N,) of a file by their names. Those of radars that :func:`write_las` wrote have the names as there."""
    laspy = require("laspy", what=f"{path}: LAS and LAZ files are read by")
    size = path.stat().st_size
    with path.open("rb") as raw:  # laspy would count to four billion
        records = int.from_bytes(raw.read(_HEADER_BYTES)[_COUNT_AT : _COUNT_AT + 4], "little")
    if records * _RECORD_BYTES > size:
        msg = f"its header says {records} records, for which the file is too small"
        raise ValueError(msg)
    # Of its two readers of LAZ, the parallel one allocates by sizes that nobody can check.
    with laspy.open(path, laz_backend=laspy.LazBackend.Lazrs, read_evlrs=False) as file:
        header = file.header
        compression = _MAX_COMPRESSION if header.are_points_compressed else 1
        if header.point_count * header.point_format.size > size * compression:
            msg = f"its header says {header.point_count} points, for which the file is too small"
            raise ValueError(msg)
        cloud = file.read_points(header.point_count)
    # Scaled and shifted, in double precision: the integers in the file are no metres.
    columns = {axis: np.asarray(getattr(cloud, axis), np.float64) for axis in "xyz"}
    if "intensity" in header.point_format.dimension_names:
        columns["intensity"] = np.asarray(cloud.intensity)
    if "gps_time" in header.point_format.dimension_names:
        columns["time"] = np.asarray(cloud.gps_time)
    for name in header.point_format.extra_dimension_names:
        columns["intensity" if name == _INTENSITY else str(name)] = np.asarray(cloud[name])
    return columns


def write_las(file: Any, rows: Iterator[NDArray[Any]], *, compressed: bool) -> int:
    """Writes records, an array a scan, to an open file, and returns their number."""
    laspy = require("laspy", what="LAS and LAZ files are written by")
    first = next(rows)
    header = _header(laspy, first)
    count = 0
    with laspy.open(file, mode="w", header=header, closefd=False, do_compress=compressed) as writer:
        for part in itertools.chain([first], rows):
            writer.write_points(_points(laspy, part, header))
            count += len(part)
    return count


def _extra(part: NDArray[Any]) -> dict[str, str]:
    """Columns that are extra dimensions, by their names in the file."""
    names = [name for name in part.dtype.names or () if name not in ("x", "y", "z", "time")]
    return {_INTENSITY if name == "intensity" else name: name for name in names}


def _header(laspy: Any, first: NDArray[Any]) -> Any:
    header = laspy.LasHeader(point_format=_POINT_FORMAT, version="1.4")
    header.add_extra_dims(
        [laspy.ExtraBytesParams(name, first.dtype[column]) for name, column in _extra(first).items()]
    )
    header.offsets = np.round([first[axis].mean() for axis in "xyz"])
    header.scales = np.full(3, _SCALE_M)
    return header


def _points(laspy: Any, part: NDArray[Any], header: Any) -> Any:
    points = laspy.ScaleAwarePointRecord.zeros(len(part), header=header)
    for axis in "xyz":
        points[axis] = part[axis]
    for name, column in _extra(part).items():
        points[name] = part[column]
    if "time" in (part.dtype.names or ()):
        points["gps_time"] = part["time"]
    return points
