# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Files of one point cloud each: PCD, PLY, KITTI's .bin, NumPy, text, LAS. All of them become named columns."""

from __future__ import annotations

import io
import re
from collections import Counter
from collections.abc import Callable, Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from radarsdf.checks import path_of
from radarsdf.interrupts import whole_import
from radarsdf.io.clouds.fields import Fields, names_of
from radarsdf.io.clouds.las import read_las
from radarsdf.io.clouds.pcd import read_pcd, read_viewpoint
from radarsdf.io.clouds.raw_binary import read_bin
from radarsdf.io.files import are_numbers, check_regular_file
from radarsdf.io.origin import origin_of
from radarsdf.io.records import without_ply_comments
from radarsdf.io.scans import Notes
from radarsdf.io.text import (
    COMMENTS,
    check_header,
    numbers_of,
    read_text,
    separator_of,
    text_rows,
    with_points,
    without_comment,
    words_of,
)

TEXT_SUFFIXES = (".csv", ".txt", ".xyz")
_PANIC = "PanicException"  # of lazrs, which is written in Rust; it is no Exception

Columns = dict[str, NDArray[Any]]


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
        return _NAMED[suffix](path) if suffix in _NAMED else _NAMELESS[suffix](path, columns)
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
    points = fields.judged([columns], Notes(str(path))).read(columns, str(path)).points.astype(np.float64)
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
    text = with_points(read_text(path))
    skipped, first = 0, ""
    for line in text.split("\n"):
        first = line.strip()
        if first and not _is_comment(first):
            break
        skipped, first = skipped + 1, ""
    if not first:
        return {name: np.zeros(0) for name in names_of(3, None)}
    first = without_comment(first.lstrip("/#% "))  # names may be after a comment sign
    separator, words = separator_of(first), words_of(first)
    header = not are_numbers(words)
    if header:
        check_header(words)
    try:
        table = np.loadtxt(
            io.StringIO(text), delimiter=separator, skiprows=skipped + header, ndmin=2, comments=COMMENTS
        )
    except ValueError:  # a row that is none becomes NaN, which is left out, and counted
        _, rows = text_rows(path)
        width = len(words) if header else Counter(len(row) for _, row in rows).most_common(1)[0][0]
        table = numbers_of(rows, width)
        numeric = ~np.isnan(table).all(axis=0)  # others hold labels, say
        if 2 * np.isfinite(table[:, numeric]).all(axis=1).sum() < len(table) or not numeric.any():
            raise
    if header:
        if table.size == 0:
            return {name: np.zeros(0) for name in words}
        if table.shape[1] != len(words) or len(set(words)) != len(words):
            msg = f"its header has {len(words)} names for {table.shape[1]} columns, or a name twice"
            raise ValueError(msg)
        return dict(zip(words, table.T, strict=True))
    return dict(zip(names_of(table.shape[1], columns), table.T, strict=True))


def _is_comment(line: str) -> bool:
    """Whether a line is a comment. Names of columns after a comment sign, as CloudCompare writes them, are a header."""
    if not line.startswith(COMMENTS):
        return False
    return not {"x", "y", "z"} <= set(re.split(r"[\s,;]+", line.lstrip("/#%").strip().lower()))


def _ply(path: Path) -> Columns:
    with whole_import():
        import trimesh  # noqa: PLC0415 - takes long, and few files need it

    # Of its bytes, and without materials: a PLY file may name an image, which is then not looked for.
    file = io.BytesIO(without_ply_comments(path.read_bytes()))
    loaded: Any = trimesh.load(file, file_type="ply", process=False, skip_materials=True)
    vertex = loaded.metadata.get("_ply_raw", {}).get("vertex")
    if vertex is None or not vertex["length"]:
        return {axis: np.zeros(0) for axis in "xyz"}
    data = vertex["data"]
    names = data.keys() if isinstance(data, dict) else data.dtype.names
    columns = {str(name): np.asarray(data[name]).reshape(-1) for name in names}
    if any(len(column) != vertex["length"] for column in columns.values()):
        msg = f"its header says {vertex['length']} points, which it does not hold"
        raise ValueError(msg)
    return columns


_NAMED: dict[str, Callable[[Path], Columns]] = {
    ".pcd": read_pcd,
    ".ply": _ply,
    ".las": read_las,
    ".laz": read_las,
}
"""Readers of formats that name their columns."""

_NAMELESS: dict[str, Callable[[Path, int | Sequence[str] | None], Columns]] = {
    ".bin": read_bin,
    ".npy": _npy,
    **dict.fromkeys(TEXT_SUFFIXES, _text),
}
"""Readers of formats that may not."""

CLOUD_SUFFIXES = (*_NAMED, *_NAMELESS)
"""What :func:`read_columns` reads."""
