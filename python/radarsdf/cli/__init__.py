"""The command line: ``radarsdf COMMAND``.

`options` describes the commands and their options; each command is a function of the other modules, which :class:`Results`
prints for. They import PyTorch, NumPy and trimesh only when a command runs, so help is immediate.
"""

import io
import os
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from radarsdf.cli.options import ENTRIES, TILE_STEPS, Parser, UsageError, overview, refuse_if, steps
from radarsdf.interrupts import terminable

if TYPE_CHECKING:
    from radarsdf.map.threshold import Threshold

# Errors with a message for the user. Every other error is a bug and keeps its traceback.
_ERRORS = (ValueError, OSError, ImportError, FloatingPointError, MemoryError)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command, by default of ``sys.argv``, and return the exit status. An error is printed as one line on standard error.

    The status is 0 on success, 1 after an error or if a check found one, 2 for wrong usage, 130 after Ctrl-C or SIGTERM.
    """
    # A character that the terminal cannot encode must not discard the results so far.
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")
    try:
        with terminable():
            return _run(sys.argv[1:] if arguments is None else list(arguments))
    except UsageError as error:
        warn(f"error: {error}")
        return 2
    except SystemExit:  # raised by --help
        return 0
    except KeyboardInterrupt as stop:  # 130, as in shells: 128 and the number of the signal
        warn(f"error: {str(stop) or 'interrupted'}")
        return 130
    except BrokenPipeError:  # the reader is gone; nothing is left for Python to flush at exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except _ERRORS as error:
        warn(f"error: {message_of(error)}")
        return 1


def _run(words: list[str]) -> int:
    if words in ([], ["--help"], ["-h"]):
        print(overview())
        return 0
    command, *words = words
    if command == "--version":
        import radarsdf

        print("radarsdf", radarsdf.__version__)
        return 0
    unknown = command not in ENTRIES or " " in command
    refuse_if(unknown, f"unknown command {command!r:.50}; radarsdf --help lists all")
    if command == "tiles":
        if not words or words[0] in ("-h", "--help"):
            print(steps())
            return 0
        command = f"tiles {words.pop(0) if words[0] in TILE_STEPS else 'run'}"
    given = Parser(command).parse_args(words)

    results = Results(**{key: vars(given).get(key, False) for key in ("quiet", "json")})
    # Each module imports only what it needs, which may take long.
    module, _, function = ENTRIES[command][0].partition(".")
    status = getattr(import_module(f"radarsdf.cli.{module}"), function)(given, results)
    results.end()
    return int(status or 0)


def message_of(error: Exception) -> str:
    """Format an error as one line: of pydantic's, the first wrong setting; of the system's, the file and the reason."""
    if type(error).__name__ == "ValidationError":  # imported only with the settings
        from radarsdf.settings import first_wrong

        return first_wrong(error)  # type: ignore[arg-type]
    if isinstance(error, OSError) and error.strerror is not None:
        return error.strerror if error.filename is None else f"{error.filename}: {error.strerror}"
    # NumPy's message describes an internal array; our own messages are kept.
    if isinstance(error, MemoryError) and (not str(error) or str(error).startswith("Unable to allocate")):
        return "there is not enough memory"
    return " ".join(str(error).split()) or type(error).__name__


class Results:
    """Prints the results of a command; with ``--json``, nothing before :meth:`end`."""

    def __init__(self, quiet: bool = False, json: bool = False) -> None:
        self.progress = False if quiet else None  # argument of the library's functions
        self.json = json
        self._values: dict[str, Any] = {}
        self._ended = False

    def say(self, line: str) -> None:
        """Print a line for people that is no result: with ``--json``, on standard error."""
        (warn if self.json else self.add)(line)

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

    def add_file(self, what: str, path: Path, key: str = "out", **values: Any) -> None:
        self.add(f"{what} written to {path}", **{key: path}, **values)

    def end(self) -> None:
        """Print the JSON object, if there is one. Non-finite numbers become null."""
        if self.json and not self._ended:
            self._ended = True
            print(as_json(self._values), flush=True)

    @contextmanager
    def until_stopped(self) -> Iterator[None]:
        """End the results, and serve in a ``with`` block until Ctrl-C, which is the normal end and not a failure."""
        self.end()
        try:
            yield
        except KeyboardInterrupt:
            self.say("stopped")


def as_json(values: Any) -> str:
    """Format as JSON, arrays as lists; non-finite numbers become null."""
    from pydantic_core import to_json

    return to_json(values, indent=2, inf_nan_mode="null", fallback=lambda array: array.tolist()).decode()


def warn(text: str) -> None:
    """Print a line on standard error, if there is one."""
    if sys.stderr is not None:
        print(text, file=sys.stderr)
