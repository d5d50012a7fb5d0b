# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""All returns of all scans as one point cloud in the world frame, written scan by scan."""

from __future__ import annotations

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
from radarsdf.io.clouds.las import write_las
from radarsdf.io.files import origin_for, whole_file, write_origin
from radarsdf.io.ply import ply_header, records
from radarsdf.io.scans import Scan, Scans
from radarsdf.progress import hides_bar

_FLOAT32_SUFFIXES = (".pcd",)
_CSV_FORMATS = {"f8": "%.17g", "f4": "%.9g", "i4": "%d"}  # as many digits as give the same number back
_COUNT_BYTES = 20  # of the largest number of points

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
    origin = None
    # Of an iterator: the number of scans is not known before the first pass through their files.
    rows = _rows(tqdm(iter(scans), desc="convert", unit="scan", disable=hides_bar(progress)))
    with whole_file(path) as file:
        if suffix in _FLOAT32_SUFFIXES:
            first = next(rows)
            origin = origin_for(np.stack([first[axis] for axis in "xyz"], axis=1))
            rows = _in_float32(itertools.chain([first], rows), np.zeros(3) if origin is None else origin)
        written = _WRITERS[suffix](file, rows)
        if suffix in _FLOAT32_SUFFIXES:
            write_origin(path, origin)
    return CloudWritten(written, len(scans), origin)


def _rows(scans: Iterable[Scan]) -> Rows:
    """One record a return, an array a scan."""
    names: tuple[str, ...] = ()
    for number, scan in enumerate(scans):
        columns = _columns(scan, number)
        names = names or tuple(columns)
        missing = np.full(len(scan), np.nan, np.float32)
        yield records({name: columns.get(name, missing) for name in names})


def _in_float32(rows: Rows, origin: NDArray[np.float64]) -> Rows:
    """The same records with positions in a local frame."""
    for part in rows:
        columns = {name: part[name] for name in part.dtype.names or ()}
        for axis, shift in zip("xyz", origin, strict=True):
            columns[axis] = (columns[axis] - shift).astype(np.float32)
        yield records(columns)


def _columns(scan: Scan, number: int) -> dict[str, NDArray[Any]]:
    columns: dict[str, NDArray[Any]] = dict(zip("xyz", scan.world_points.T, strict=True))
    if scan.intensities is not None:
        columns["intensity"] = scan.intensities.astype(np.float32)
    if scan.doppler_mps is not None:
        columns["doppler"] = scan.doppler_mps.astype(np.float32)
    columns["scan"] = np.full(len(scan), number, np.int32)
    if scan.time_s is not None:
        columns["time"] = np.full(len(scan), scan.time_s)
    return columns


def _ply(dtype: np.dtype[Any], count: int) -> bytes:
    # The number of points is known in the end: the header keeps its length, as its comment makes up for the digits.
    return ply_header(dtype, count, comment="." * (_COUNT_BYTES - len(str(count))))


def _pcd(dtype: np.dtype[Any], count: int) -> bytes:
    kinds = [dtype[name].str[1:] for name in dtype.names or ()]
    lines = [
        "# .PCD v0.7, radarsdf: world frame, m " + "." * 2 * (_COUNT_BYTES - len(str(count))),
        "VERSION 0.7",
        f"FIELDS {' '.join(dtype.names or ())}",
        f"SIZE {' '.join(kind[1] for kind in kinds)}",
        f"TYPE {' '.join(kind[0].upper() for kind in kinds)}",
        f"COUNT {' '.join('1' for _ in kinds)}",
        f"WIDTH {count}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {count}",
        "DATA binary",
    ]
    return ("\n".join(lines) + "\n").encode("ascii")


def _npy(dtype: np.dtype[Any], count: int) -> bytes:
    header = repr({"descr": dtype.descr, "fortran_order": False, "shape": (count,)})
    padding = 64 * (3 + len(repr(dtype.descr)) // 64) - 11 - len(header)
    return (
        b"\x93NUMPY\x01\x00"
        + (len(header) + padding + 1).to_bytes(2, "little")
        + (header + " " * padding + "\n").encode("latin1")
    )


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
