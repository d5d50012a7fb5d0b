# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""All returns of all scans as one point cloud in the world frame, written scan by scan."""

from __future__ import annotations

import io
import itertools
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from radarsdf.checks import path_of
from radarsdf.extras import require
from radarsdf.io.clouds.reading import LAS_INTENSITY
from radarsdf.io.files import origin_for, whole_file, write_origin
from radarsdf.io.scans import Columns, Scan, Scans
from radarsdf.progress import hides_bar

_FLOAT32_SUFFIX = ".pcd"
_CSV_FORMATS = {"f8": "%.17g", "f4": "%.9g", "i4": "%d"}  # as many digits as give the same number back
_COUNT_BYTES = 20  # of the largest number of points

_LAS_SCALE_M = 1e-4
_LAS_FORMAT = 6  # the first of LAS 1.4, with a time
_PLY_TYPES = {"f4": "float", "f8": "double", "u1": "uchar", "i4": "int"}

Rows = Iterator[NDArray[Any]]


class CloudWritten(NamedTuple):
    """Size and origin of a cloud that was written."""

    returns: int
    """Number of returns."""
    scans: int
    """Number of scans."""
    origin: NDArray[np.float64] | None
    """(3,) the origin that was subtracted, world, m; None where coordinates are the world's."""


def check_cloud_path(path: str | PathLike[str]) -> None:
    """Raises a ValueError unless `path` ends like a format that :func:`write_cloud` writes."""
    if path_of(path, "path").suffix.lower() not in CLOUD_OUT_SUFFIXES:
        msg = f"{path}: a point cloud can be written as {', '.join(CLOUD_OUT_SUFFIXES)}"
        raise ValueError(msg)


def write_cloud(path: str | PathLike[str], scans: Scans, *, progress: bool | None = False) -> CloudWritten:
    """Writes all returns of scans as one point cloud, whole or not at all, in memory bounded by a scan.

    The cloud has x, y, z in the world frame, m; intensity in sensor units and doppler in m/s where the first scan has
    them; scan, the number of the scan; and time, s, where the first scan has one. What a later scan lacks is NaN.
    Coordinates are float64. LAS and LAZ round them to 0.1 mm, and have the other columns as extra dimensions. PCD holds
    float32, since most programs read no other: further than 1000 m from the world's origin it is in a local frame,
    whose origin is written beside it, as ``NAME.origin.json``.

    Parameters
    ----------
    path : path-like
        One of `CLOUD_OUT_SUFFIXES`. NumPy's file holds one record a return.
    scans : Scans
        They are read once.
    progress : bool, optional
        Whether to show a progress bar. None: on a terminal.

    Returns
    -------
    CloudWritten
        What was written.

    Raises
    ------
    ValueError
        For another suffix, if `path` is no regular file, or the scans cannot be read.
    OSError
        If a file cannot be read or written.
    ImportError
        If the format takes a library that is not installed; the message says which.
    """
    check_cloud_path(path)
    suffix = Path(path).suffix.lower()
    # Of an iterator: the number of scans is not known before the first pass through their files.
    bar = tqdm(iter(scans), desc="convert", unit="scan", disable=hides_bar(progress))
    columns = map(_columns, itertools.count(), bar)
    first, origin = next(columns), None
    rows = _rows(itertools.chain([first], columns), tuple(first))
    with whole_file(path) as file:
        if suffix == _FLOAT32_SUFFIX:
            origin = origin_for(np.stack([first[axis] for axis in "xyz"], axis=1))
            rows = _in_float32(rows, np.zeros(3) if origin is None else origin)
        written = _WRITERS[suffix](file, rows)
        if suffix == _FLOAT32_SUFFIX:
            write_origin(path, origin)
    return CloudWritten(written, len(scans), origin)


def _columns(number: int, scan: Scan) -> Columns:
    columns: Columns = dict(zip("xyz", scan.world_points.T, strict=True))
    if scan.intensities is not None:
        columns["intensity"] = scan.intensities.astype(np.float32)
    if scan.doppler_mps is not None:
        columns["doppler"] = scan.doppler_mps.astype(np.float32)
    columns["scan"] = np.full(len(scan), number, np.int32)
    if scan.time_s is not None:
        columns["time"] = np.full(len(scan), scan.time_s)
    return columns


def _rows(scans: Iterable[Columns], names: tuple[str, ...]) -> Rows:
    """One record a return, an array a scan."""
    for columns in scans:
        missing = np.full(len(columns["scan"]), np.nan, np.float32)
        yield records({name: columns.get(name, missing) for name in names})


def _in_float32(rows: Rows, origin: NDArray[np.float64]) -> Rows:
    """The same records with positions in a local frame."""
    for part in rows:
        columns = {name: part[name] for name in part.dtype.names or ()}
        local = {
            axis: (part[axis] - shift).astype(np.float32) for axis, shift in zip("xyz", origin, strict=True)
        }
        yield records(columns | local)


def _ply(dtype: np.dtype[Any], count: int) -> bytes:
    # The number of points is known in the end: the header keeps its length, as its comment makes up for the digits.
    return ply_header(dtype, count, comment="." * (_COUNT_BYTES - len(str(count))))


def _pcd(dtype: np.dtype[Any], count: int) -> bytes:
    kinds = [dtype[name].str[1:] for name in dtype.names or ()]
    header = f"""\
# .PCD v0.7, radarsdf: world frame, m {"." * 2 * (_COUNT_BYTES - len(str(count)))}
VERSION 0.7
FIELDS {" ".join(dtype.names or ())}
SIZE {" ".join(kind[1] for kind in kinds)}
TYPE {" ".join(kind[0].upper() for kind in kinds)}
COUNT {" ".join("1" for _ in kinds)}
WIDTH {count}
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS {count}
DATA binary
"""
    return header.encode("ascii")


def _npy(dtype: np.dtype[Any], count: int) -> bytes:
    header = io.BytesIO()  # NumPy leaves space for the digits of the number
    np.lib.format.write_array_header_1_0(
        header, {"descr": dtype.descr, "fortran_order": False, "shape": (count,)}
    )
    return header.getvalue()


def _binary(file: BinaryIO, rows: Rows, header: Callable[[np.dtype[Any], int], bytes]) -> int:
    """Writes records behind a header, whose length does not depend on their number."""
    first = next(rows)
    file.write(header(first.dtype, 0))
    count = 0
    for part in itertools.chain([first], rows):
        file.write(part.tobytes())
        count += len(part)
    file.seek(0)
    file.write(header(first.dtype, count))
    return count


def _csv(file: BinaryIO, rows: Rows) -> int:
    count = 0
    for part in rows:
        names = part.dtype.names or ()
        if not count:
            file.write((",".join(names) + "\n").encode("ascii"))
        np.savetxt(file, part, ",".join(_CSV_FORMATS[part.dtype[name].str[1:]] for name in names))
        count += len(part)
    return count


def write_las(file: Any, rows: Iterator[NDArray[Any]], *, compressed: bool) -> int:
    """Writes records, an array a scan, to an open file, and returns their number."""
    laspy = require("laspy", what="LAS and LAZ files are written by")
    first = next(rows)
    names = {name: name for name in first.dtype.names or ()} | {
        "intensity": LAS_INTENSITY,
        "time": "gps_time",
    }
    extra = [name for name in first.dtype.names or () if name not in ("x", "y", "z", "time")]
    header = laspy.LasHeader(point_format=_LAS_FORMAT, version="1.4")
    header.add_extra_dims([laspy.ExtraBytesParams(names[name], first.dtype[name]) for name in extra])
    header.offsets = np.round([first[axis].mean() for axis in "xyz"])
    header.scales = np.full(3, _LAS_SCALE_M)
    count = 0
    with laspy.open(file, mode="w", header=header, closefd=False, do_compress=compressed) as writer:
        for part in itertools.chain([first], rows):
            points = laspy.ScaleAwarePointRecord.zeros(len(part), header=header)
            for name in part.dtype.names or ():
                points[names[name]] = part[name]
            writer.write_points(points)
            count += len(part)
    return count


def records(columns: Columns) -> NDArray[Any]:
    """(N,) one record for each row of the columns, of which there is at least one."""
    dtype = np.dtype([(name, array.dtype.newbyteorder("<")) for name, array in columns.items()])
    rows = np.zeros(len(next(iter(columns.values()))), dtype)
    for name, array in columns.items():
        rows[name] = array
    return rows


def face_records(faces: NDArray[np.integer[Any]]) -> NDArray[Any]:
    """(T,) one record for each triangle (T, 3), as in a binary PLY file."""
    rows = np.zeros(len(faces), np.dtype([("count", "u1"), ("rows", "<i4", (3,))]))
    rows["count"], rows["rows"] = 3, faces
    return rows


def ply_header(
    dtype: np.dtype[Any], count: int, num_faces: int | None = None, comment: str | None = None
) -> bytes:
    """The header of a binary PLY file of `count` such records, and of triangles if it is a mesh."""
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += [] if comment is None else [f"comment {comment}"]
    lines += ["comment radarsdf: world frame, m", f"element vertex {count}"]
    lines += [f"property {_PLY_TYPES[dtype[name].str[1:]]} {name}" for name in dtype.names or ()]
    if num_faces is not None:
        lines += [f"element face {num_faces}", "property list uchar int vertex_indices"]
    return ("\n".join([*lines, "end_header"]) + "\n").encode("ascii")


_WRITERS: dict[str, Callable[[Any, Rows], int]] = {
    ".ply": partial(_binary, header=_ply),
    ".pcd": partial(_binary, header=_pcd),
    ".las": partial(write_las, compressed=False),
    ".laz": partial(write_las, compressed=True),
    ".npy": partial(_binary, header=_npy),
    ".csv": _csv,
}

CLOUD_OUT_SUFFIXES = tuple(_WRITERS)
"""What :func:`write_cloud` writes."""
