# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Random damage to the bytes of a file of any format."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np

_Item = TypeVar("_Item")
_NUMBER = re.compile(rb"-?\d+\.?\d*(?:[eE][-+]?\d+)?")
_WORDS = [
    b"0", b"-1", b"1", b"nan", b"-inf", b"1e308", b"1e999", b"1e-320", b"2147483648", b"4294967296", b"9" * 19, b"9" * 40,
    b"9" * 5000, b"", b" ", b"\x00", b"\xff\xfe", b"0x10", b"1_000", "٣".encode(), b"None", b"true", b"[" * 3000,
]  # fmt: skip
_INTEGERS = [0, 1, 0xFF, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**64 - 1, 2**40, 2**62]


def boundaries(data: bytes) -> list[int]:
    """Lengths at which to cut a file: in the first bytes, at line ends, zip headers, ends of zeros and at the end."""
    ends = set(range(min(len(data), 64)))
    for match in list(re.finditer(rb"\n|PK..|\x00[^\x00]", data, re.DOTALL))[:200]:
        ends |= {match.start(), match.start() + 1, match.end()}
    return sorted(end for end in ends | {len(data) - 1, len(data) - 8} if 0 <= end < len(data))


def mutate(rng: np.random.Generator, data: bytes, others: list[bytes]) -> bytes:
    """`data` with one to three random changes, some with parts of `others`."""
    for _ in range(rng.integers(1, 4)):
        data = _one_of(rng, _CHANGES)(rng, data, others)
    return data


def _one_of(rng: np.random.Generator, items: Sequence[_Item]) -> _Item:
    return items[int(rng.integers(len(items)))]


def _position(rng: np.random.Generator, data: bytes) -> int:
    """A random position, in half of the cases near the beginning or the end, where headers are."""
    size = max(len(data), 1)
    if rng.random() < 0.5:
        return int(rng.integers(size))
    near = min(int(rng.integers(600)), size - 1)
    return near if rng.random() < 0.7 else size - 1 - near


def _flip(rng: np.random.Generator, data: bytes, _: list[bytes]) -> bytes:
    changed = bytearray(data or b"\0")
    for _i in range(rng.integers(1, 9)):
        changed[_position(rng, data)] ^= 1 << int(rng.integers(8))
    return bytes(changed)


def _truncate(rng: np.random.Generator, data: bytes, _: list[bytes]) -> bytes:
    return data[: _position(rng, data)]


def _overwrite(rng: np.random.Generator, data: bytes, _: list[bytes]) -> bytes:
    at = _position(rng, data)
    noise: bytes = rng.bytes(int(rng.integers(1, 9)))
    return data[:at] + noise + data[at + 8 :]


def _integer(rng: np.random.Generator, data: bytes, _: list[bytes]) -> bytes:
    at, size = _position(rng, data), int(rng.choice([2, 4, 8]))
    value: int = _one_of(rng, _INTEGERS) % 2 ** (8 * size)
    return data[:at] + value.to_bytes(size, "little") + data[at + size :]


def _cut_out(rng: np.random.Generator, data: bytes, _: list[bytes]) -> bytes:
    at = _position(rng, data)
    return data[:at] + data[at + int(rng.integers(1, 200)) :]


def _repeat(rng: np.random.Generator, data: bytes, _: list[bytes]) -> bytes:
    at, size = _position(rng, data), int(rng.integers(1, 200))
    return data[:at] + data[at : at + size] * int(rng.integers(2, 5)) + data[at + size :]


def _splice(rng: np.random.Generator, data: bytes, others: list[bytes]) -> bytes:
    other = _one_of(rng, others)
    return data[: _position(rng, data)] + other[_position(rng, other) :]


def _number(rng: np.random.Generator, data: bytes, _: list[bytes]) -> bytes:
    """A number in the text of the file is replaced."""
    matches = list(_NUMBER.finditer(data[:20_000]))
    if not matches:
        return data
    match = _one_of(rng, matches)
    return data[: match.start()] + _one_of(rng, _WORDS) + data[match.end() :]


_CHANGES: list[Callable[[np.random.Generator, bytes, list[bytes]], bytes]] = [
    _flip,
    _truncate,
    _overwrite,
    _integer,
    _cut_out,
    _repeat,
    _splice,
    _number,
]
