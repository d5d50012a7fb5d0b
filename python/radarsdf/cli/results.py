"""Output of commands: lines and tables for people, or one JSON object for programs."""

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

    def add_mesh(self, path: Path, vertices: int, triangles: int, threshold: "Threshold") -> None:
        line = f"{vertices} vertices and {triangles} triangles"
        self.add_file(line, path, vertices=vertices, triangles=triangles)
        self.add(str(threshold), **vars(threshold))

    def add_file(self, what: str, path: Path, **values: Any) -> None:
        self.add(f"{what} written to {path}", out=path, **values)

    def end(self) -> None:
        """Print the JSON object, if there is one. Non-finite numbers become null."""
        if self.json and not self._ended:
            self._ended = True
            print(as_json(self._values), flush=True)


def as_json(values: Any) -> str:
    """Format as JSON, arrays as lists; non-finite numbers become null."""
    from pydantic_core import to_json

    return to_json(values, indent=2, inf_nan_mode="null", fallback=lambda array: array.tolist()).decode()


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
