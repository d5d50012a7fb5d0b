# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The LZF compression, which PCL uses for the PCD files that it calls ``binary_compressed``."""

from __future__ import annotations

from radarsdf.checks import check

_LITERALS = 32  # control bytes below this are followed by so many bytes, and one more, as they are
_LONG = 7  # of the three bits of a length: the next byte adds to it


def unpack_lzf(data: bytes, size: int) -> bytes:
    """Unpack `size` bytes. Raises a ValueError if the data are damaged."""
    out, at = bytearray(), 0
    end = data + bytes(3)  # what a damaged stream lacks
    while at < len(data) and len(out) <= size:
        control, at = end[at], at + 1
        if control < _LITERALS:
            out += data[at : at + control + 1]
            at += control + 1
            continue
        length, distance = control >> 5, (control & 0x1F) << 8
        if length == _LONG:
            length, at = length + end[at], at + 1
        length, distance, at = length + 2, distance + end[at] + 1, at + 1
        check(distance <= len(out), "its compressed data are damaged")
        part = out[len(out) - distance :][:length]  # shorter than what it writes where it overlaps itself
        out += (part * (length // len(part) + 1))[:length]
    check(len(out) == size and at == len(data), f"its compressed data do not unpack to {size} bytes")
    return bytes(out)
