# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Unpacking with a bound: some kilobytes can unpack to gigabytes. Also in bags, which rosbags unpacks without one."""

from __future__ import annotations

import bz2
import functools
import importlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any

# Measurements are mostly noise and compress by a factor of 2 to 5.
_MAX_COMPRESSION = 100
_ALWAYS_UNPACKED = 1 << 28  # bytes; smaller ones are unpacked at any compression
_STEP = 1 << 24  # bytes
_ZSTD = b"\x28\xb5\x2f\xfd"  # which files packed by Zstandard begin with

_bounded: ContextVar[bool] = ContextVar("bounded", default=False)


def check_unpacked(unpacked: int, packed: int, what: str) -> None:
    """Raises a ValueError where so many bytes unpack to so many that they are no measurements."""
    if unpacked > max(_ALWAYS_UNPACKED, _MAX_COMPRESSION * packed):
        msg = f"{what} would unpack to {unpacked} bytes or more: measurements do not compress that much"
        raise ValueError(msg)


def unpack(packed: bytes, decompressor: Callable[[], Any], what: str) -> bytes:
    """Unpacks with decompressors such as `bz2.BZ2Decompressor`, one for each stream in the bytes."""
    parts: list[bytes] = []
    rest, total = packed, 0
    while rest:
        stream = decompressor()
        while not stream.eof:
            parts.append(stream.decompress(rest, _STEP))
            rest, total = b"", total + len(parts[-1])
            check_unpacked(total, len(packed), what)
            if stream.needs_input and not stream.eof:
                msg = f"{what} is cut off"
                raise ValueError(msg)
        rest = stream.unused_data or b""
    return b"".join(parts)


@contextmanager
def bounded() -> Iterator[None]:
    """Within it, rosbags unpacks chunks of MCAP files with a bound, and opens those of any profile and encoding.

    Elsewhere it does as it always did.
    """
    _teach_rosbags()
    token = _bounded.set(True)
    try:
        yield
    finally:
        _bounded.reset(token)


def bound_ros1(reader: Any) -> None:
    """Makes an open reader of a ROS 1 bag unpack its chunks with a bound."""
    own = {bz2.decompress: bz2.BZ2Decompressor}
    frame: Any = importlib.import_module("lz4.frame")
    own[frame.decompress] = frame.LZ4FrameDecompressor
    for position, chunk in reader.chunks.items():
        if chunk.decompressor in own:
            unpacked = functools.partial(unpack, decompressor=own[chunk.decompressor], what="a chunk")
            reader.chunks[position] = chunk._replace(decompressor=unpacked)


def unpack_zstd(packed: bytes) -> bytes:
    """The bytes of a message that is packed by Zstandard."""
    return unpack(packed, _zstd().ZstdDecompressor, "a message")


def check_zstd_files(folder: Path) -> None:
    """Raises a ValueError where a file of a folder that is packed by Zstandard would unpack to too much, by unpacking it.

    Such files are those of a ROS 2 bag, which rosbags unpacks into a temporary folder.
    """
    for path in folder.iterdir():
        if not path.is_file():
            continue
        with path.open("rb") as start:
            if start.read(len(_ZSTD)) != _ZSTD:
                continue
        total = 0
        with _zstd().open(path, "rb") as file:
            while part := file.read(_STEP):
                total += len(part)
                check_unpacked(total, path.stat().st_size, path.name)


def _zstd() -> Any:
    """The module that rosbags uses, which depends on the version of Python."""
    return importlib.import_module("rosbags.rosbag2.reader").zstd


@functools.cache
def _teach_rosbags() -> None:
    storage: Any = importlib.import_module("rosbags.rosbag2.storage_mcap")
    frame: Any = importlib.import_module("lz4.frame")
    for name, decompressor in (("lz4", frame.LZ4FrameDecompressor), ("zstd", _zstd().ZstdDecompressor)):
        storage.DECOMPRESSORS[name] = functools.partial(
            _unpack_chunk, decompressor=decompressor, unbounded=storage.DECOMPRESSORS[name]
        )
    schema = storage.Schema

    def read_string(file: Any) -> str:
        start, raw = file.tell(), storage.read_bytes(file)
        if not _bounded.get():
            return str(raw.decode())
        text = str(raw.decode(errors="replace"))
        # What begins a record is the profile of the file, of which rosbags knows one, or a key.
        return text if start or text == "offered_qos_profiles" else "ros2"

    def any_schema(number: int, name: str, encoding: str, data: str) -> Any:
        return schema(number, name, "ros2msg" if _bounded.get() else encoding, data)

    storage.read_string, storage.Schema = read_string, any_schema


def _unpack_chunk(
    packed: bytes, size: int, decompressor: Callable[[], Any], unbounded: Callable[[bytes, int], bytes]
) -> bytes:
    return unpack(packed, decompressor, "a chunk") if _bounded.get() else unbounded(packed, size)
