"""Samples of returns that do not depend on their order."""

from __future__ import annotations

import numpy as np

from radarsdf.arrays import Array, Ints, Keys


def hashes(*columns: Array) -> Keys:
    """Return pseudo-random keys (N,) of rows with values (N,) of four bytes each; equal rows have equal keys."""
    found = np.zeros(len(columns[0]), np.uint64)
    for column in columns:
        found ^= np.ascontiguousarray(column).view(np.uint32)
        found *= np.uint64(0x9E3779B97F4A7C15)  # 2^64 over the golden ratio, odd
        found ^= found >> np.uint64(32)
    return found


def sample(keys: Keys, most: int) -> Ints:
    """Return the rows of the `most` smallest keys (N,), or of all."""
    return np.arange(len(keys)) if len(keys) <= most else np.argpartition(keys, most)[:most]
