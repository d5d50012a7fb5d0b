# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What a check has found: its name, how bad it is, the numbers that show it, and how to mend it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Severity = Literal["error", "warning", "note"]
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")
"""From the worst to the mildest."""


@dataclass(frozen=True)
class Finding:
    """One thing that is worth knowing before a fit."""

    name: str
    """A short name in lower case that does not change between versions, such as ``poses_inverted``."""
    severity: Severity
    """``error``: a map of these data would be nonsense. ``warning``: it would suffer. ``note``: for information."""
    evidence: str
    """One sentence with the numbers that show it."""
    mend: str
    """One sentence that says what to do."""

    def __str__(self) -> str:
        return f"{self.severity}: {self.name}: {self.evidence} {self.mend}".rstrip()
