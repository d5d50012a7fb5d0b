# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Memory of this process on Linux. Only the standard library is imported: the Python of a peer may have no radarsdf."""

from __future__ import annotations

import ctypes
import sys
from pathlib import Path

_M_MMAP_THRESHOLD = -3  # of malloc.h


def memory_bytes(field: str) -> int:
    """Resident memory of this process, bytes: now (`VmRSS`) or its peak (`VmHWM`). -1 where Linux does not tell.

    ``ru_maxrss`` is not used: a child process inherits that of its parent.
    """
    status = Path("/proc/self/status")
    if not status.exists():
        return -1
    (line,) = (line for line in status.read_text().splitlines() if line.startswith(f"{field}:"))
    return 1024 * int(line.split()[1])


def return_freed_memory() -> None:
    """From now on, the C library returns large freed blocks to the system.

    Otherwise freed memory would be used again, and would hide a part of the peak. A variable would come too late for a process
    that is forked.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None).mallopt(_M_MMAP_THRESHOLD, 1_000_000)
