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

from radarsdf.io.clouds.lzf import unpack_lzf

_TYPES = {f"{kind}{size}" for kind, sizes in {"F": "48", "I": "1248", "U": "1248"}.items() for size in sizes}
_MAX_HEADER_LINES = 64  # a header has eleven
_MAX_LINE = 1 << 16
_MAX_COMPRESSION = 100  # LZF reaches at most 88: three bytes for 264


def read_pcd(path: Path) -> dict[str, NDArray[Any]]:
    """The fields with one number a point, (N,) each by name: of ascii, binary or binary_compressed files to version 0.7.

    ``VIEWPOINT`` is not applied: :func:`read_viewpoint` has it.
    """
    with path.open("rb") as file:
        header = _header(file)
        if missing := [
            key for key in ("FIELDS", "SIZE", "TYPE", "WIDTH", "HEIGHT", "DATA") if not header.get(key)
        ]:
            msg = f"its header lacks {', '.join(missing)}"
            raise ValueError(msg)
        body = file.read()
    names = header["FIELDS"]
    types = [kind + size for kind, size in zip(header["TYPE"], header["SIZE"], strict=True)]
    counts = [int(count) for count in header.get("COUNT", ["1"] * len(names))]
    points = int(header["WIDTH"][0]) * int(header["HEIGHT"][0])
    if not len(names) == len(types) == len(counts) or not _TYPES.issuperset(types):
        msg = "FIELDS, SIZE, TYPE and COUNT do not fit together"
        raise ValueError(msg)
    if points < 0 or min(counts) < 1:
        msg = "the number of points is negative, or a COUNT is zero or negative"
        raise ValueError(msg)
    if header["DATA"] == ["binary"]:
        columns = _binary(body, types, counts, points)
    elif header["DATA"] == ["ascii"]:
        columns = _ascii(body, counts, points)
    elif header["DATA"] == ["binary_compressed"]:
        columns = _compressed(body, types, counts, points)
    else:
        msg = f"DATA {' '.join(header['DATA'])} is not known: it is ascii, binary or binary_compressed"
        raise ValueError(msg)
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


def _binary(body: bytes, types: list[str], counts: list[int], points: int) -> list[NDArray[Any]]:
    fields = [
        (f"f{i}", f"<{kind.lower()}", (count,))
        for i, (kind, count) in enumerate(zip(types, counts, strict=True))
    ]
    record = np.dtype(fields)
    if len(body) < points * record.itemsize:  # a wrong header must not allocate much memory
        msg = f"{points} points need {points * record.itemsize} bytes, but only {len(body)} are there"
        raise ValueError(msg)
    cloud = np.frombuffer(body, record, points)
    return [cloud[f"f{i}"][:, 0] for i in range(len(types))]


def _compressed(body: bytes, types: list[str], counts: list[int], points: int) -> list[NDArray[Any]]:
    """Compressed by LZF, one field after another."""
    packed, unpacked = (int(size) for size in np.frombuffer(body[:8], "<u4"))
    sizes = [int(kind[1]) * count * points for kind, count in zip(types, counts, strict=True)]
    if unpacked != sum(sizes) or len(body) < 8 + packed or unpacked > _MAX_COMPRESSION * packed:
        msg = f"its {packed} compressed bytes do not fit to {points} points of {sum(sizes)} bytes"
        raise ValueError(msg)
    data = unpack_lzf(body[8 : 8 + packed], unpacked)
    starts = np.cumsum([0, *sizes[:-1]])
    return [
        np.frombuffer(data, f"<{kind.lower()}", points * count, int(start)).reshape(points, count)[:, 0]
        for kind, count, start in zip(types, counts, starts, strict=True)
    ]


def _ascii(body: bytes, counts: list[int], points: int) -> list[NDArray[Any]]:
    text = body.decode("ascii")
    wrong = f"the file does not hold {points} rows of {sum(counts)} values, as its header says"
    table = np.zeros((0, sum(counts)))
    if text and not text.isspace():  # of no rows, NumPy warns
        try:
            table = np.loadtxt(io.StringIO(text), np.float64, comments=None, ndmin=2)
        except ValueError as error:
            raise ValueError(wrong) from error
    if table.shape != (points, sum(counts)):
        raise ValueError(wrong)
    first = np.cumsum([0, *counts[:-1]])
    return [table[:, i] for i in first]
