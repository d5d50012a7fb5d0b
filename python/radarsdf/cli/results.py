"""Output of commands: lines and tables for people, or one JSON object for programs."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # pages of help or settings need no PyTorch
    from radarsdf.map.threshold import Threshold


class Results:
    """Prints the results of a command; with ``--json``, nothing before :meth:`end`."""

    def __init__(self, quiet: bool = False, json: bool = False) -> None:
        self.progress = False if quiet else None  # argument of the library's functions
        self.json = json
        self._values: dict[str, Any] = {}
        self._ended = False

    def add(self, line: str | None = None, **values: Any) -> None:
        """Print a line for people, and keep its values for programs by name; lengths in m, times in s."""
        if line is not None and not self.json:
            print(line, flush=True)
        self._values |= values

    def table(self, rows: Iterable[Sequence[str]]) -> None:
        rows = list(rows)
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        for row in rows:
            cells = (cell.ljust(width) for cell, width in zip(row, widths, strict=True))
            self.add("  ".join(cells).rstrip())

    def add_mesh(self, path: Path, vertices: int, triangles: int, threshold: Threshold) -> None:
        line = f"{vertices} vertices and {triangles} triangles"
        self.add_file(line, path, vertices=vertices, triangles=triangles)
        self.add(str(threshold), **vars(threshold))

    def add_file(self, what: str, path: Path, **values: Any) -> None:
        self.add(f"{what} written to {path}", out=path, **values)

    def end(self) -> None:
        """Print the JSON object, if there is one. Non-finite numbers become null."""
        if self.json and not self._ended:
            self._ended = True
            print(json.dumps(plain(self._values), indent=2, allow_nan=False), flush=True)


def plain(value: Any) -> Any:
    """Convert to what JSON can store; non-finite numbers become null."""
    if hasattr(value, "tolist"):  # an array or a number of NumPy
        value = value.tolist()
    if isinstance(value, dict):
        return {str(name): plain(part) for name, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(part) for part in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value


def warn(text: str) -> None:
    """Print a line on standard error, if there is one."""
    if sys.stderr is not None:
        print(text, file=sys.stderr)


def until_stopped(wait: Callable[[], None]) -> None:
    """Wait until Ctrl-C, which is the normal end and not a failure."""
    try:
        wait()
    except KeyboardInterrupt:
        print("stopped")
