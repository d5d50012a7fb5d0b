# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Memory of this process on Linux. Only the standard library is imported: the Python of a peer may have no radarsdf."""

from __future__ import annotations

from pathlib import Path


def memory_bytes(field: str) -> int:
    """Resident memory of this process, bytes: now (`VmRSS`) or its peak (`VmHWM`). -1 where Linux does not tell.

    ``ru_maxrss`` is not used: a child process inherits that of its parent.
    """
    status = Path("/proc/self/status")
    if not status.exists():
        return -1
    (line,) = (line for line in status.read_text().splitlines() if line.startswith(f"{field}:"))
    return 1024 * int(line.split()[1])
