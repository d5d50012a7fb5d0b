# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Files of the Point Cloud Library, pointclouds.org/documentation/tutorials/pcd_file_format.html."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from radarsdf.io.ply import Columns

_MAX_HEADER_LINES = 64  # a header has eleven
_MAX_LINE = 1 << 16
_LITERALS = 32  # control bytes of LZF below this are followed by so many bytes, and one more, as they are


def read_pcd(path: Path) -> Columns:
    """The fields with one number a point: of ascii, binary or binary_compressed files to version 0.7.

    ``VIEWPOINT`` is not applied: :func:`read_viewpoint` has it.
    """
    with path.open("rb") as file:
        header = _header(file)
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
    readers = {"binary": _binary, "ascii": _ascii, "binary_compressed": _compressed}
    columns = readers[header["DATA"][0]](body, dtypes, points)
    # The name _ means padding, and several fields may have it.
    return {name: columns[i] for i, name in enumerate(names) if counts[i] == 1 and name != "_"}


def read_viewpoint(path: Path) -> NDArray[np.float64]:
    """T_world_sensor (4, 4) of the ``VIEWPOINT`` of a file, which is tx ty tz qw qx qy qz; the identity without one."""
    with path.open("rb") as file:
        numbers = np.array(_header(file).get("VIEWPOINT", [0, 0, 0, 1, 0, 0, 0]), np.float64)
    if numbers.shape != (7,) or not np.isfinite(numbers).all():
        msg = "its VIEWPOINT is not seven finite numbers: tx ty tz qw qx qy qz"
        raise ValueError(msg)
    T_world_sensor = np.eye(4)
    T_world_sensor[:3, 3] = numbers[:3]
    if numbers[3:].any():  # some programs write zeros where nothing is known
        T_world_sensor[:3, :3] = Rotation.from_quat(numbers[[4, 5, 6, 3]]).as_matrix()
    return T_world_sensor


def _header(file: BinaryIO) -> dict[str, list[str]]:
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


def _binary(body: bytes, dtypes: list[np.dtype[Any]], points: int) -> list[NDArray[Any]]:
    record = np.dtype([(f"f{i}", dtype) for i, dtype in enumerate(dtypes)])
    cloud = np.frombuffer(body, record, points)
    return [cloud[name][:, 0] for name in record.names or ()]


def _compressed(body: bytes, dtypes: list[np.dtype[Any]], points: int) -> list[NDArray[Any]]:
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


def _ascii(body: bytes, dtypes: list[np.dtype[Any]], points: int) -> list[NDArray[Any]]:
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
    out = bytearray()
    at = 0
    while at < len(data) and len(out) <= size:
        control = data[at]
        at += 1
        if control < _LITERALS:
            out += data[at : at + control + 1]
            at += control + 1
            continue
        head = data[at : at + 2]
        length = 2 + (control >> 5)
        if length == 2 + 7:  # a longer one: the next byte says by how much
            length += head[0] if head else 0
            head = head[1:]
            at += 1
        at += 1
        start = len(out) - ((control & 0x1F) << 8) - (head[0] if head else size) - 1
        if start < 0:
            msg = "its compressed data are damaged"
            raise ValueError(msg)
        # It may overlap with what it writes: the same bytes again and again.
        part = bytes(out[start : start + length])
        out += (part * (length // len(part) + 1))[:length]
    if len(out) != size:
        msg = f"its compressed data do not unpack to {size} bytes"
        raise ValueError(msg)
    return bytes(out)
