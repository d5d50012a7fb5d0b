# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What LAS and LAZ files say of themselves, checked before it is believed: laspy would count to four billion, and lazrs
allocate gigabytes, or end the process where there are none."""

from __future__ import annotations

from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

_MAX_COMPRESSION = 200  # LAZ packs lidar points to a tenth; more is an attack
_HEADER, _VLR = 227, 54  # bytes, of the least header and of the least record between it and the points
_LAYERED = (
    3  # how points are compressed: each chunk has a point, the number of its points, sizes of layers, layers
)
_PARTS = (
    32  # bytes of the LAZ record before the number of parts of a point; type, size and version of each follow
)
_LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}  # of a part, by its type; extra bytes have one each
_EXTRA_BYTES = 14


def check_las_records(path: Path) -> None:
    """Raises a ValueError unless the file can hold as many records before its points as its header says."""
    with path.open("rb") as file:
        count = _number(file.read(_HEADER), 100)
    if count * _VLR > path.stat().st_size:
        msg = f"its header says {count} records, for which the file is too small"
        raise ValueError(msg)


def check_las_points(path: Path, header: Any) -> None:
    """Raises a ValueError unless the file can hold its points, by a header of laspy."""
    unpacked = header.point_count * header.point_format.size
    if unpacked > path.stat().st_size * (_MAX_COMPRESSION if header.are_points_compressed else 1):
        msg = f"its header says {header.point_count} points, for which the file is too small"
        raise ValueError(msg)
    if header.are_points_compressed and header.point_count:
        with path.open("rb") as file:
            _check_chunks(file, path.stat().st_size, header)


def _check_chunks(file: BinaryIO, size: int, header: Any) -> None:
    import lazrs  # noqa: PLC0415 - an extra

    record = bytes(header.vlrs[header.vlrs.index("LasZipVlr")].record_data)
    usual = lazrs.LazVlr.new_for_compression(header.point_format.id, header.point_format.num_extra_bytes)
    if _parts(record) != _parts(bytes(usual.record_data())):
        msg = f"its points are not compressed as those of point format {header.point_format.id} are"
        raise ValueError(msg)
    chunks = _number_of_chunks(file, header.offset_to_point_data, size)
    if chunks * header.point_format.size > size:  # each begins with a point as it is
        msg = f"it says that it has {chunks} chunks of points, for which it is too small"
        raise ValueError(msg)
    vlr = lazrs.LazVlr(record)
    file.seek(header.offset_to_point_data)
    table = lazrs.read_chunk_table(file, vlr)  # where it cannot be read, lazrs would go on at the wrong place
    layered, parts = _parts(record)
    if layered:
        layers = sum(part if kind == _EXTRA_BYTES else _LAYERS[kind] for kind, part in parts)
        counts = [count for count, _ in table] if vlr.uses_variable_size_chunks() else vlr.chunk_size()
        _check_layers(file, size, header, layers, counts)


def _check_layers(file: BinaryIO, size: int, header: Any, layers: int, counts: int | list[int]) -> None:
    """Walks from chunk to chunk, each of which has `counts` points."""
    at, left, number = header.offset_to_point_data + 8, header.point_count, 0
    while left > 0:
        count = counts if isinstance(counts, int) else counts[number] if number < len(counts) else 0
        file.seek(at + header.point_format.size)
        head = np.frombuffer(file.read(4 * (1 + layers)), "<u4").astype(np.int64)
        at += header.point_format.size + 4 * (1 + layers) + int(head[1:].sum())
        if len(head) != 1 + layers or at > size or head[0] != min(count, left) or count == 0:
            msg = f"its chunk {number} of points is damaged or cut off"
            raise ValueError(msg)
        left, number = left - count, number + 1


def _parts(record: bytes) -> tuple[bool, list[list[int]]]:
    """Whether points are in layers, and type and size of each part of a point, by the record of LAZ."""
    number, *numbers = np.frombuffer(record[_PARTS:], "<u2").tolist()
    layered = int.from_bytes(record[:2], "little") == _LAYERED
    return layered, [numbers[k : k + 2] for k in range(0, 3 * number, 3)]


def _number_of_chunks(file: BinaryIO, points_at: int, size: int) -> int:
    """By the head of their table. Its place stands before the points, or at the end of the file."""
    for place in (points_at, size - 8):
        file.seek(max(place, 0))
        table_at = int.from_bytes(file.read(8), "little", signed=True)
        if table_at > points_at:
            file.seek(min(table_at, size))
            return _number(file.read(8), 4)
    return 0


def _number(data: bytes, at: int) -> int:
    return int.from_bytes(data[at : at + 4], "little")
