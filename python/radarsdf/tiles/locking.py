# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""A lock of a folder, so that one process at a time makes its plan."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from radarsdf.io.files import take_lock

LOCK = "plan.lock"


@contextmanager
def only_planner(folder: Path) -> Iterator[None]:
    """No other process or thread is in such a block for the same folder. Raises as :func:`radarsdf.io.files.take_lock`."""
    descriptor = take_lock(folder / LOCK, "planned")
    try:
        yield
    finally:
        os.close(descriptor)
