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
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from radarsdf.checks import path_of
from radarsdf.extras import require
from radarsdf.interrupts import whole_import
from radarsdf.io.clouds.bin import read_bin
from radarsdf.io.clouds.fields import Fields, names_of
from radarsdf.io.files import check_regular_file, origin_of
from radarsdf.io.scans import Columns, Notes
from radarsdf.io.text import read_table

TEXT_SUFFIXES = (".csv", ".txt", ".xyz")
_PANIC = "PanicException"  # of lazrs, which is written in Rust; it is no Exception
LAS_INTENSITY = "radar_intensity"  # an extra dimension: LAS's own are whole numbers from 0 to 65535
_MAX_HEADER_LINES = 64  # a header has eleven
_MAX_LINE = 1 << 16
_LITERALS = 32  # control bytes of LZF below this are followed by so many bytes, and one more, as they are
_FACES = re.compile(rb"element\s+face\s+0*[1-9]")
_PLY_HEADER_BYTES = 1 << 16
_LAZ_LAYERS = {6: 9, 7: 10, 8: 11, 9: 10, 10: 12}  # of a chunk, by point format; extra bytes have one each
_VARIABLE = 2**32 - 1  # in place of the number of points in each chunk
_MAX_COMPRESSION = 200  # LAZ packs lidar points to a tenth
_HEADER_BYTES, _COUNT_AT, _RECORD_BYTES = (
    227,
    100,
    54,
)  # of the least LAS header, and the least record behind it


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


# PCD: pointclouds.org/documentation/tutorials/pcd_file_format.html


def read_pcd(path: Path) -> Columns:
    """The fields with one number a point: of ascii, binary or binary_compressed files to version 0.7.

    ``VIEWPOINT`` is not applied: :func:`read_viewpoint` has it.
    """
    with path.open("rb") as file:
        header = _pcd_header(file)
        body = file.read()
    if missing := {"FIELDS", "SIZE", "TYPE", "WIDTH", "HEIGHT", "DATA"} - {
        key for key in header if header[key]
    }:
        msg = f"its header lacks {', '.join(sorted(missing))}"
        raise ValueError(msg)
    names, points = header["FIELDS"], int(header["WIDTH"][0]) * int(header["HEIGHT"][0])
    counts = [int(count) for count in header.get("COUNT", ["1"] * len(names))]
    fields = zip(names, header["TYPE"], header["SIZE"], counts, strict=True)
    dtypes = [np.dtype((f"<{kind.lower()}{size}", (count,))) for _, kind, size, count in fields]
    readers = {"binary": _pcd_binary, "ascii": _pcd_ascii, "binary_compressed": _pcd_compressed}
    columns = readers[header["DATA"][0]](body, dtypes, points)
    # The name _ means padding, and several fields may have it.
    return {name: columns[i] for i, name in enumerate(names) if counts[i] == 1 and name != "_"}


def read_viewpoint(path: Path) -> NDArray[np.float64]:
    """T_world_sensor (4, 4) of the ``VIEWPOINT`` of a file, which is tx ty tz qw qx qy qz; the identity without one."""
    with path.open("rb") as file:
        numbers = np.array(_pcd_header(file).get("VIEWPOINT", [0, 0, 0, 1, 0, 0, 0]), np.float64)
    if numbers.shape != (7,) or not np.isfinite(numbers).all():
        msg = "its VIEWPOINT is not seven finite numbers: tx ty tz qw qx qy qz"
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
    packed, unpacked = (int(size) for size in np.frombuffer(body[:8], "<u4"))
    sizes = [dtype.itemsize * points for dtype in dtypes]
    if unpacked != sum(sizes):
        msg = f"its {unpacked} unpacked bytes are not {points} points of {sum(sizes)} bytes"
        raise ValueError(msg)
    data = unpack_lzf(body[8 : 8 + packed], unpacked)
    starts = np.cumsum([0, *sizes[:-1]]).tolist()
    return [
        np.frombuffer(data, dtype, points, start)[:, 0] for dtype, start in zip(dtypes, starts, strict=True)
    ]


def _pcd_ascii(body: bytes, dtypes: list[np.dtype[Any]], points: int) -> list[NDArray[Any]]:
    widths = [dtype.shape[0] for dtype in dtypes]
    text = body.decode("ascii")
    table = np.zeros((0, sum(widths)))
    if text and not text.isspace():  # of no rows, NumPy warns
        table = np.loadtxt(io.StringIO(text), np.float64, comments=None, ndmin=2)
    if table.shape != (points, sum(widths)):
        msg = f"the file does not hold {points} rows of {sum(widths)} values, as its header says"
        raise ValueError(msg)
    return [table[:, i] for i in np.cumsum([0, *widths[:-1]])]


def unpack_lzf(data: bytes, size: int) -> bytes:
    """Unpacks `size` bytes of the LZF compression."""
    msg = f"its compressed data do not unpack to {size} bytes"
    out = bytearray()
    stream = iter(data)
    # What a damaged stream lacks at its end reads as 0; the size then differs.
    for control in stream:
        if control < _LITERALS:
            out += bytes(itertools.islice(stream, control + 1))
        else:
            length = 2 + (control >> 5)
            if length == 2 + 7:  # a longer one: the next byte adds to it
                length += next(stream, 0)
            start = len(out) - ((control & 0x1F) << 8) - next(stream, size) - 1
            if start < 0:
                raise ValueError(msg)
            # It may overlap with what it writes: the same bytes again and again.
            part = bytes(out[start : start + length])
            out += (part * (length // len(part) + 1))[:length]
        if len(out) > size:
            break
    if len(out) != size:
        raise ValueError(msg)
    return bytes(out)


def ply_bytes(path: Path) -> io.BytesIO:
    """A PLY file for trimesh, without the comments of its header, which may be in any encoding."""
    head, end, body = path.read_bytes().partition(b"end_header")
    return io.BytesIO(re.sub(rb"(?<=[\r\n])(comment|obj_info)\b[^\r\n]*[\r\n]+", b"", head) + end + body)


def has_faces(path: Path) -> bool:
    """Whether a PLY file is a mesh, by its header."""
    with path.open("rb") as file:
        return _FACES.search(file.read(_PLY_HEADER_BYTES).partition(b"end_header")[0]) is not None


def read_ply(path: Path) -> Columns:
    """The columns of the vertices of a PLY file."""
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
        if header.are_points_compressed:
            _check_chunks(path, header)
        cloud = file.read_points(header.point_count)
    # Scaled and shifted, in double precision: the integers in the file are no metres.
    columns = {axis: np.asarray(getattr(cloud, axis), np.float64) for axis in "xyz"}
    if "intensity" in header.point_format.dimension_names:
        columns["intensity"] = np.asarray(cloud.intensity)
    if "gps_time" in header.point_format.dimension_names:
        columns["time"] = np.asarray(cloud.gps_time)
    for name in header.point_format.extra_dimension_names:
        columns["intensity" if name == LAS_INTENSITY else str(name)] = np.asarray(cloud[name])
    return columns


def _check_chunks(path: Path, header: Any) -> None:
    """Raises a ValueError for chunks that the file cannot hold: lazrs allocates what they claim, or ends the process."""
    import lazrs  # noqa: PLC0415 - an extra

    point, file_bytes, at = header.point_format, path.stat().st_size, header.offset_to_point_data
    record = bytes(header.vlrs.get("LasZipVlr")[0].record_data)
    usual = bytes(lazrs.LazVlr.new_for_compression(point.id, point.num_extra_bytes).record_data())
    # Compressor, then type, size and version of each part of a point.
    parts, usual_parts = (np.frombuffer(data[34:], "<u2").reshape(-1, 3)[:, :2] for data in (record, usual))
    possible = record[:2] == usual[:2] and np.array_equal(parts, usual_parts)
    with path.open("rb") as file:
        for place in (at, file_bytes - 8):  # of the place of the chunk table: before the points or at the end
            file.seek(place)
            table_at = int.from_bytes(file.read(8), "little", signed=True)
            if table_at > at:
                possible &= table_at + 8 <= file_bytes
                file.seek(min(table_at, file_bytes))
                chunks = int.from_bytes(file.read(8)[4:], "little")
                # Each begins with a point as it is.
                possible &= chunks * point.size <= file_bytes and chunks <= max(header.point_count, 1)
                break
        chunk_size, left = int.from_bytes(record[12:16], "little"), header.point_count
        layers = _LAZ_LAYERS.get(point.id, 0) + point.num_extra_bytes
        at += 8
        # In a chunk, the first point, the number of points, and the sizes of its layers are before these.
        while possible and left > 0 and point.id in _LAZ_LAYERS:
            file.seek(at + point.size)
            count, *sizes = np.frombuffer(file.read(4 * (1 + layers)), "<u4").tolist() or [0]
            at += point.size + 4 * (1 + layers) + sum(sizes)
            expected = count if chunk_size == _VARIABLE else min(chunk_size, left)
            possible = len(sizes) == layers and at <= file_bytes and 0 < count == expected
            left -= count
    if not possible:
        msg = "its chunks of compressed points are damaged, or it is too small for them"
        raise ValueError(msg)


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
