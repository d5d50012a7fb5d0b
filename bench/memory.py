# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What this process takes, as Linux counts it. Nothing but the standard library: the peers' Pythons come here, too."""

from __future__ import annotations

from pathlib import Path


def memory_bytes(field: str) -> int:
    """VmRSS (now) or VmHWM (the most so far), or -1 where nobody says. Not ru_maxrss: a child starts with its parent's."""
    status = Path("/proc/self/status")
    if not status.exists():
        return -1
    (line,) = (line for line in status.read_text().splitlines() if line.startswith(f"{field}:"))
    return 1024 * int(line.split()[1])
