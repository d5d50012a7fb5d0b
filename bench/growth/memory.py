# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What this process takes, as Linux counts it."""

from __future__ import annotations

from pathlib import Path


def memory_mb(field: str) -> float:
    """A field of /proc/self/status, such as VmRSS or VmHWM, in MB."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(field)) / 1e3
