# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The results of a command: lines for people, or with ``--json`` one object for programs."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from radarsdf.cli.saying import say


class Results:
    """Prints what a command has found. With ``--json`` nothing is printed before :meth:`end`.

    Parameters
    ----------
    options : argparse.Namespace
        Of a command with :func:`radarsdf.cli.options.add_json`.
    """

    def __init__(self, options: argparse.Namespace) -> None:
        self._json: bool = options.json
        self._values: dict[str, Any] = {}

    def add(self, line: str | None = None, **values: Any) -> None:
        """Print a line, if it is for people. Keep the same numbers for programs, by name; a length is in m, a time in s."""
        if line is not None and not self._json:
            say(line)
        self._values |= values

    def add_threshold(self, metadata: Mapping[str, Any]) -> None:
        """Say from which confidence on a mesh with this ``metadata`` was kept, and what that costs."""
        from radarsdf.map.threshold import Threshold

        threshold = Threshold.of_mesh(metadata)
        self.add(str(threshold), **threshold.metadata)

    def end(self) -> None:
        """Print the object, if it is for programs. A number that is not finite is null."""
        if self._json:
            say(json.dumps(_plain(self._values), indent=2, allow_nan=False))


def counted(count: int, what: str) -> str:
    """Such as "1 scan" or "2 scans"."""
    return f"{count} {what}{'s' * (count != 1)}"


def _plain(value: Any) -> Any:
    """The same in types that JSON has."""
    if hasattr(value, "tolist"):  # an array or a number of NumPy
        value = value.tolist()
    if isinstance(value, dict):
        return {str(name): _plain(part) for name, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(part) for part in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value
