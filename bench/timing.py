# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What a block of a bench takes. Only the standard library is imported: the Python of a peer may have no radarsdf."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass


@dataclass
class Taken:
    """Time that a block took; not a number before its end."""

    wall_s: float = float("nan")
    """By the clock, s."""
    cpu_s: float = float("nan")
    """Of the processor, by all threads of this process, s."""


@contextmanager
def timed() -> Iterator[Taken]:
    """The time that the block takes."""
    taken = Taken()
    wall_s, cpu_s = time.perf_counter(), time.process_time()
    yield taken
    taken.wall_s, taken.cpu_s = time.perf_counter() - wall_s, time.process_time() - cpu_s
