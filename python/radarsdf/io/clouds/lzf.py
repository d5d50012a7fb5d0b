# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The LZF compression of PCD files, only its unpacking."""

from __future__ import annotations

_LITERALS = 32  # control bytes below this are followed by so many bytes, and one more, as they are


def unpack_lzf(data: bytes, size: int) -> bytes:
    """Unpacks `size` bytes."""
    out = bytearray()
    at, end = 0, len(data)
    try:
        while at < end and len(out) <= size:
            control = data[at]
            at += 1
            if control < _LITERALS:
                out += data[at : at + control + 1]
                at += control + 1
                continue
            length = control >> 5
            if length == 7:  # a longer one: the next byte says by how much
                length += data[at]
                at += 1
            start = len(out) - ((control & 0x1F) << 8) - data[at] - 1
            at += 1
            length += 2
            if start < 0:
                msg = "a reference points before the beginning"
                raise ValueError(msg)
            if start + length <= len(out):
                out += out[start : start + length]
            else:  # it overlaps with what it writes: the same bytes again and again
                part = bytes(out[start:])
                out += (part * (length // len(part) + 1))[:length]
    except IndexError as error:
        msg = "the compressed data are cut off"
        raise ValueError(msg) from error
    if len(out) != size:
        msg = f"the compressed data do not unpack to {size} bytes"
        raise ValueError(msg)
    return bytes(out)
