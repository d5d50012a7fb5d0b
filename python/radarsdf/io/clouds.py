# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Files of one point cloud each: PCD, PLY, KITTI's .bin, NumPy, text, LAS and LAZ. All of them become named columns."""

from __future__ import annotations

import io
import itertools
import re
from collections.abc import Callable, Sequence
from os import PathLike
from pathlib import Path
from typing import Any, BinaryIO, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import fdtrc

from radarsdf.checks import path_of
from radarsdf.extras import require
from radarsdf.interrupts import whole_import
from radarsdf.io.fields import Fields, names_of
from radarsdf.io.files import check_regular_file, origin_of
from radarsdf.io.scans import Columns, Notes
from radarsdf.io.text import read_table

TEXT_SUFFIXES = (".csv", ".txt", ".xyz")
LAS_INTENSITY = "radar_intensity"  # an extra dimension: LAS's own are whole numbers from 0 to 65535
_PANIC = "PanicException"  # of lazrs, which is written in Rust; it is no Exception
_MAX_COMPRESSION = 200  # LAZ packs lidar points to a tenth
_VLRS_AT, _VLR_BYTES = (
    100,
    54,
)  # place of the number of variable records in a LAS header, and the least size of one
_MAX_HEADER_LINES, _MAX_LINE = 64, 1 << 16  # a header of PCD has eleven lines
_PLY_HEADER_BYTES = 1 << 16
_KITTI_WIDTH, _WIDTHS = 4, range(3, 21)  # columns of .bin files
_JUDGED_FILES, _MAX_POSITION_M = 20, 1e7
_LESS, _CHANCE = 0.8, 1e-4  # of the variance within four columns is left by others, not by chance

GivenColumns: TypeAlias = int | Sequence[str] | None
"""The columns of files without names, as a user gives them: how many numbers a point has, or their names."""


def read_columns(path: Path, columns: GivenColumns = None) -> Columns:
    """The columns of a file of points, (N,) each, by name."""
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
    (M, 3) float64 ndarray
        Frame of the file, m, in which the ``VIEWPOINT`` of a PCD file places the points; the world's, if
        :func:`write_cloud` wrote an origin next to it. Points that are not finite are left out.

    Raises
    ------
    ValueError
        If the file is damaged, of another kind, or holds no points.
    OSError
        If it cannot be read.
    ImportError
        If it takes a library that is not installed; the message says which.
    """
    file = path_of(path, "path")
    columns = read_columns(file)
    fields = Fields.of(list(columns), dict.fromkeys(("intensity", "doppler")), str(path))
    fields = fields.judged(columns, Notes())
    points = fields.scan(columns, str(path), np.eye(4), None, Notes()).points.astype(np.float64)
    if file.suffix.lower() == ".pcd":
        T_world_sensor = read_viewpoint(file)
        points = points @ T_world_sensor[:3, :3].T + T_world_sensor[:3, 3]
    if len(points) == 0:
        msg = f"{path} holds no points"
        raise ValueError(msg)
    origin = origin_of(path)
    return points if origin is None else points + origin


# Files .bin: float32, x, y, z, intensity, as KITTI has them, or as many columns as a user says.


def _bin(path: Path, columns: GivenColumns) -> Columns:
    if columns is None:
        check_kitti([path])
    width = columns if isinstance(columns, int) else len(columns or range(_KITTI_WIDTH))
    if path.stat().st_size % (4 * width):
        msg = f"its size is no whole number of points of {width} float32 each: give columns (--columns)"
        raise ValueError(msg)
    table = np.fromfile(path, "<f4").reshape(-1, width)
    return dict(zip(names_of(width, columns), table.T, strict=True))


def check_kitti(paths: Sequence[Path]) -> None:
    """Raises a ValueError if most ``.bin`` files of a recording do not look like points of four float32."""
    paths = [path for path in paths if path.stat().st_size][:_JUDGED_FILES]
    fitting = [path for path in paths if path.stat().st_size % (4 * _KITTI_WIDTH) == 0]
    remedy = "give columns (--columns), how many float32 a point has, or their names"
    if 2 * len(fitting) < len(paths):
        msg = f"the sizes of the .bin files are no whole numbers of points of four float32 each: {remedy}"
        raise ValueError(msg)
    if not fitting:
        return
    tables = [np.fromfile(path, "<f4").reshape(-1, _KITTI_WIDTH).astype(np.float64) for path in fitting]
    table = np.concatenate(tables)
    if (np.abs(table[np.isfinite(table).all(axis=1), :3]) > _MAX_POSITION_M).any():
        msg = f"numbers in the .bin files are no positions in m, as float32: {remedy}"
        raise ValueError(msg)
    # Logarithms, so that no column has all of the variance; numbers of one column are alike.
    numbers = np.nan_to_num(np.sign(table) * np.log1p(np.abs(table))).ravel()
    within, freedom = _variance(numbers, _KITTI_WIDTH)
    for width in _WIDTHS:
        other, other_freedom = _variance(numbers, width)
        if other_freedom <= 0 or other > _LESS * within:
            continue
        if other == 0 or fdtrc(freedom, other_freedom, within / other) < _CHANCE:
            msg = f"the .bin files look like points of {width} float32, not of four: {remedy}"
            raise ValueError(msg)


def _variance(numbers: NDArray[np.float64], width: int) -> tuple[float, int]:
    """Variance within columns, unbiased, and its degrees of freedom."""
    table = numbers[: len(numbers) // width * width].reshape(-1, width)
    freedom = table.size - width
    return float(table.var(axis=0).sum()) * len(table) / max(freedom, 1), freedom


def _npy(path: Path, columns: GivenColumns) -> Columns:
    # A memory map: a header that claims more than the file holds is refused before anything is allocated.
    array = np.load(path, mmap_mode="r", allow_pickle=False)
    if array.dtype.names is not None and array.ndim == 1:
        return {name: array[name] for name in array.dtype.names}
    if array.ndim != 2 or array.dtype.kind not in "iuf":
        msg = f"it holds an array {array.shape} of {array.dtype}, not one row of numbers a point"
        raise ValueError(msg)
    return dict(zip(names_of(array.shape[1], columns), np.array(array).T, strict=True))


def _text(path: Path, columns: GivenColumns) -> Columns:
    table = read_table(path)
    width = table.values.shape[1]
    # CloudCompare writes names of columns after a comment sign.
    named = (head for head in table.heads if {"x", "y", "z"} <= {word.lower() for word in head})
    names = table.header or next(named, None) or names_of(width or 3, columns)
    if len(table.lines) and (width != len(names) or len(set(names)) != len(names)):
        msg = f"its header has {len(names)} names for {width} columns, or a name twice"
        raise ValueError(msg)
    values = table.values if len(table.lines) else np.zeros((0, len(names)))
    return dict(zip(names, values.T, strict=True))


# PCD: pointclouds.org/documentation/tutorials/pcd_file_format.html


def _pcd(path: Path, _: GivenColumns) -> Columns:
    """The fields with one number a point: of ascii, binary or binary_compressed files to version 0.7."""
    with path.open("rb") as file:
        header = _pcd_header(file)
        body = file.read()
    names, points = header["FIELDS"], int(header["WIDTH"][0]) * int(header["HEIGHT"][0])
    counts = [int(count) for count in header.get("COUNT", ["1"] * len(names))]
    fields = zip(header["TYPE"], header["SIZE"], counts, strict=True)
    dtypes = [np.dtype((f"<{kind.lower()}{size}", (count,))) for kind, size, count in fields]
    readers = {"binary": _pcd_binary, "ascii": _pcd_ascii, "binary_compressed": _pcd_compressed}
    columns = readers[header["DATA"][0]](body, dtypes, points)
    # The name _ means padding, and several fields may have it.
    return {name: columns[i] for i, name in enumerate(names) if counts[i] == 1 and name != "_"}


def read_viewpoint(path: Path) -> NDArray[np.float64]:
    """T_world_sensor (4, 4) of the ``VIEWPOINT`` of a PCD file, tx ty tz qw qx qy qz; the identity without one."""
    with path.open("rb") as file:
        numbers = np.array(_pcd_header(file).get("VIEWPOINT", [0, 0, 0, 1, 0, 0, 0]), np.float64)
    if numbers.shape != (7,) or not np.isfinite(numbers).all():
        msg = f"{path}: its VIEWPOINT is not seven finite numbers: tx ty tz qw qx qy qz"
        raise ValueError(msg)
    T_world_sensor = np.eye(4)
    T_world_sensor[:3, 3] = numbers[:3]
    if numbers[3:].any():  # some programs write zeros where nothing is known
        T_world_sensor[:3, :3] = Rotation.from_quat(numbers[[4, 5, 6, 3]]).as_matrix()
    return T_world_sensor


def _pcd_header(file: BinaryIO) -> dict[str, list[str]]:
    """The lines of a header by their first words. Comments are in any encoding."""
    header: dict[str, list[str]] = {}
    for _ in range(_MAX_HEADER_LINES):
        line = file.readline(_MAX_LINE).lstrip()
        if line and not line.startswith(b"#"):
            key, *words = line.decode("ascii").split()
            header[key] = words
        if "DATA" in header:
            break
    return header


def _pcd_binary(body: bytes, dtypes: list[np.dtype[Any]], points: int) -> list[NDArray[Any]]:
    record = np.dtype([(f"f{i}", dtype) for i, dtype in enumerate(dtypes)])
    cloud = np.frombuffer(body, record, points)
    return [cloud[name][:, 0] for name in record.names or ()]


def _pcd_compressed(body: bytes, dtypes: list[np.dtype[Any]], points: int) -> list[NDArray[Any]]:
    """Compressed by LZF, one field after another."""
    packed = int.from_bytes(body[:4], "little")
    sizes = [dtype.itemsize * points for dtype in dtypes]
    data = unpack_lzf(body[8 : 8 + packed], sum(sizes))
    starts = np.cumsum([0, *sizes[:-1]]).tolist()
    fields = zip(dtypes, starts, strict=True)
    return [np.frombuffer(data, dtype, points, start)[:, 0] for dtype, start in fields]


def _pcd_ascii(body: bytes, dtypes: list[np.dtype[Any]], points: int) -> list[NDArray[Any]]:
    widths = [dtype.shape[0] for dtype in dtypes]
    table = np.array(body.split(), np.float64).reshape(points, sum(widths))
    return [table[:, i] for i in np.cumsum([0, *widths[:-1]])]


def unpack_lzf(data: bytes, size: int) -> bytes:
    """Unpacks `size` bytes of the LZF compression: literals, and references to what was unpacked before."""
    out = bytearray()
    stream = iter(data)
    for control in stream:
        if control < 32:
            out += bytes(itertools.islice(stream, control + 1))
            continue
        length = control >> 5
        if length == 7:  # a longer one: the next byte adds to it
            length += next(stream, 0)
        start = len(out) - ((control & 0x1F) << 8) - next(stream, size) - 1
        if start < 0:
            break
        for at in range(start, start + length + 2):  # one by one: it may overlap with what it writes
            out.append(out[at])
    if len(out) != size:
        msg = f"its compressed data do not unpack to {size} bytes"
        raise ValueError(msg)
    return bytes(out)


def ply_bytes(path: Path) -> io.BytesIO:
    """A PLY file for trimesh, without the comments of its header, which may be in any encoding."""
    head, end, body = path.read_bytes().partition(b"end_header")
    return io.BytesIO(re.sub(rb"(?<=[\r\n])(comment|obj_info)\b[^\r\n]*[\r\n]+", b"", head) + end + body)


def has_faces(path: Path) -> bool:
    """Whether a PLY file is a mesh, by its header."""
    with path.open("rb") as file:
        header = file.read(_PLY_HEADER_BYTES).partition(b"end_header")[0]
    return re.search(rb"element\s+face\s+0*[1-9]", header) is not None


def _ply(path: Path, _: GivenColumns) -> Columns:
    """The columns of the vertices."""
    with whole_import():
        import trimesh  # noqa: PLC0415 - takes long, and few files need it

    # Without materials: a PLY file may name an image, which is then not looked for.
    loaded: Any = trimesh.load(ply_bytes(path), file_type="ply", process=False, skip_materials=True)
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


def _las(path: Path, _: GivenColumns) -> Columns:
    """Columns by their names; those that :func:`write_cloud` wrote have the names as there."""
    laspy = require("laspy", what=f"{path}: LAS and LAZ files are read by")
    size = path.stat().st_size
    with path.open("rb") as raw:
        raw.seek(_VLRS_AT)
        records = int.from_bytes(raw.read(4), "little")
    if records * _VLR_BYTES > size:  # laspy would count to four billion
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
    names = {"intensity": "intensity", "gps_time": "time"}
    names |= {name: str(name) for name in header.point_format.extra_dimension_names}
    names |= {LAS_INTENSITY: "intensity"}
    known = set(header.point_format.dimension_names)
    return columns | {as_name: np.asarray(cloud[name]) for name, as_name in names.items() if name in known}


READERS: dict[str, Callable[[Path, GivenColumns], Columns]] = {
    ".pcd": _pcd,
    ".ply": _ply,
    ".las": _las,
    ".laz": _las,
    ".bin": _bin,
    ".npy": _npy,
    **dict.fromkeys(TEXT_SUFFIXES, _text),
}
"""Reads a file as named columns (N,), by its suffix. What a user says of the columns helps where a format names none."""

CLOUD_SUFFIXES = tuple(READERS)
"""What :func:`read_columns` reads."""
