# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Files of one point cloud each: PCD, PLY, KITTI's .bin, NumPy, text, LAS. All of them become named columns."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from radarsdf.checks import path_of
from radarsdf.io.clouds.bin import read_bin
from radarsdf.io.clouds.fields import Fields, names_of
from radarsdf.io.clouds.las import read_las
from radarsdf.io.clouds.pcd import read_pcd, read_viewpoint
from radarsdf.io.files import check_regular_file, origin_of
from radarsdf.io.ply import Columns, read_ply
from radarsdf.io.scans import Notes
from radarsdf.io.text import read_table

TEXT_SUFFIXES = (".csv", ".txt", ".xyz")
_PANIC = "PanicException"  # of lazrs, which is written in Rust; it is no Exception


def read_columns(path: Path, columns: int | Sequence[str] | None = None) -> Columns:
    """The columns of a file of points, (N,) each, by name.

    `columns` are those of files without names: how many numbers a point has, or their names. By default the content of
    a ``.bin`` file decides.
    """
    check_regular_file(path)
    suffix = path.suffix.lower()
    if suffix not in CLOUD_SUFFIXES:
        msg = f"{path} is no file of points: those end in {', '.join(CLOUD_SUFFIXES)}"
        raise ValueError(msg)
    try:
        return READERS[suffix](path, columns)
    except (ImportError, MemoryError):
        raise
    except BaseException as error:  # libraries raise many kinds for damaged files, OSError among them
        if isinstance(error, OSError) and error.filename is not None:
            raise
        if not isinstance(error, Exception) and type(error).__name__ != _PANIC:
            raise
        msg = f"{path} is not a whole {suffix} file of points: {error}"
        raise ValueError(msg) from error


def read_points(path: str | PathLike[str]) -> NDArray[np.float64]:
    """Reads points, such as the ground truth of a lidar, from a file of any format that :func:`read` reads.

    Parameters
    ----------
    path : path-like
        A PCD, PLY, LAS, LAZ, ``.bin``, ``.npy`` or text file.

    Returns
    -------
    ndarray
        (M, 3) float64, frame of the file, m, in which the ``VIEWPOINT`` of a PCD file places them; the world's, if
        :func:`radarsdf.io.write_cloud` wrote an origin next to it. Points that are not finite are left out.

    Raises
    ------
    ValueError
        If the file is damaged, of another kind, or holds no points.
    OSError
        If it cannot be read.
    ImportError
        If it takes a library that is not installed; the message says which.
    """
    columns = read_columns(path_of(path, "path"))
    fields = Fields.of(list(columns), dict.fromkeys(("intensity", "doppler")), str(path))
    fields = fields.judged([columns], Notes(str(path)))
    points = fields.scan(columns, str(path), np.eye(4), None, Notes()).points.astype(np.float64)
    if path_of(path, "path").suffix.lower() == ".pcd":
        T_world_sensor = read_viewpoint(path_of(path, "path"))
        points = points @ T_world_sensor[:3, :3].T + T_world_sensor[:3, 3]
    if len(points) == 0:
        msg = f"{path} holds no points"
        raise ValueError(msg)
    origin = origin_of(path)
    return points if origin is None else points + origin


def _npy(path: Path, columns: int | Sequence[str] | None) -> Columns:
    # A memory map: a header that claims more than the file holds is refused before anything is allocated.
    array = np.load(path, mmap_mode="r", allow_pickle=False)
    if array.dtype.names is not None and array.ndim == 1:
        return {name: array[name] for name in array.dtype.names}
    if array.ndim != 2 or array.dtype.kind not in "iuf":
        msg = f"it holds an array {array.shape} of {array.dtype}, not one row of numbers a point"
        raise ValueError(msg)
    return dict(zip(names_of(array.shape[1], columns), np.array(array).T, strict=True))


def _text(path: Path, columns: int | Sequence[str] | None) -> Columns:
    table = read_table(path)
    names = table.header
    if names is None:  # CloudCompare writes names of columns after a comment sign
        named = [head for head in table.heads if {"x", "y", "z"} <= {word.lower() for word in head}]
        names = named[0] if named else names_of(table.values.shape[1] or 3, columns)
    if len(table.lines) == 0:
        return {name: np.zeros(0) for name in names}
    if table.values.shape[1] != len(names) or len(set(names)) != len(names):
        msg = f"its header has {len(names)} names for {table.values.shape[1]} columns, or a name twice"
        raise ValueError(msg)
    return dict(zip(names, table.values.T, strict=True))


READERS: dict[str, Callable[[Path, int | Sequence[str] | None], Columns]] = {
    ".pcd": lambda path, _: read_pcd(path),
    ".ply": lambda path, _: read_ply(path),
    ".las": lambda path, _: read_las(path),
    ".laz": lambda path, _: read_las(path),
    ".bin": read_bin,
    ".npy": _npy,
    **dict.fromkeys(TEXT_SUFFIXES, _text),
}
"""Reads a file as named columns (N,), by its suffix. What a user says of the columns helps where a format names none."""

CLOUD_SUFFIXES = tuple(READERS)
"""What :func:`read_columns` reads."""
