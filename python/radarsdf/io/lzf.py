"""LZF decompression, for the PCD files that PCL calls ``binary_compressed``."""

from __future__ import annotations

from radarsdf.checks import check

_LITERALS = 32  # a control byte below this precedes that many literal bytes, plus one
_LONG = 7  # largest length of three bits: the next byte is added to it


def unpack_lzf(data: bytes, size: int) -> bytes:
    """Unpack `size` bytes. Raises a ValueError if the data are damaged."""
    out, at = bytearray(), 0
    end = data + bytes(3)  # padding, for truncated streams
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
        part = out[len(out) - distance :][:length]  # repeated below if the copy overlaps its own output
        out += (part * (length // len(part) + 1))[:length]
    check(len(out) == size and at == len(data), f"its compressed data do not unpack to {size} bytes")
    return bytes(out)
