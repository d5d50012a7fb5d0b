# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Files of the Point Cloud Library, pointclouds.org/documentation/tutorials/pcd_file_format.html."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

_TYPES = {f"{kind}{size}" for kind, sizes in {"F": "48", "I": "1248", "U": "1248"}.items() for size in sizes}
_MAX_HEADER_LINES = 64  # a header has eleven
_MAX_LINE = 1 << 16


def read_pcd(path: Path) -> dict[str, NDArray[Any]]:
    """Reads a point cloud, ASCII or binary.

    Parameters
    ----------
    path : Path
        A PCD file, version 0.7 or earlier. Its ``VIEWPOINT`` is ignored.

    Returns
    -------
    dict
        By name, an array (N,) for each field with one number per point. Its dtype is that of the file, or float64 if
        the file is ASCII.

    Raises
    ------
    ValueError
        If the file is not a PCD file, is cut off, or is compressed.
    OSError
        If the file cannot be read.
    """
    try:
        return _read(path)
    except (ValueError, KeyError, IndexError, OverflowError) as error:
        msg = f"{path} is not a whole PCD file: {error}"
        raise ValueError(msg) from error


def _read(path: Path) -> dict[str, NDArray[Any]]:
    with path.open("rb") as file:
        header: dict[str, list[str]] = {}
        for _ in range(_MAX_HEADER_LINES):
            words = file.readline(_MAX_LINE).decode("ascii").split()
            if words and not words[0].startswith("#"):
                header[words[0]] = words[1:]
            if "DATA" in header:
                break
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
    else:
        msg = f"DATA {' '.join(header['DATA'])} cannot be read: convert it by pcl_convert_pcd_ascii_binary"
        raise ValueError(msg)
    # The name _ means padding, and several fields may have it.
    return {name: columns[i] for i, name in enumerate(names) if counts[i] == 1 and name != "_"}


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


def _ascii(body: bytes, counts: list[int], points: int) -> list[NDArray[Any]]:
    rows = [line.split() for line in body.decode("ascii").splitlines() if line.strip()]
    if len(rows) != points or any(len(row) != sum(counts) for row in rows):
        msg = f"the file does not hold {points} rows of {sum(counts)} values, as its header says"
        raise ValueError(msg)
    table = np.array(rows, np.float64).reshape(points, sum(counts))
    first = np.cumsum([0, *counts[:-1]])
    return [table[:, i] for i in first]
