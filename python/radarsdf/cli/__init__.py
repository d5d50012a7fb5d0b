"""The command line: ``radarsdf COMMAND``.

`options` describes the commands and their options, and `results` prints what they find; each command is a function of the other
modules. They import PyTorch, NumPy and trimesh only when a command runs, so help is immediate.
"""

import io
import os
import sys
from collections.abc import Sequence
from importlib import import_module

from radarsdf.cli.options import ENTRIES, TILE_STEPS, Parser, UsageError, overview, refuse_if, steps
from radarsdf.cli.results import Results, warn
from radarsdf.interrupts import terminable

# Errors with a message for the user. Every other error is a bug and keeps its traceback.
_ERRORS = (ValueError, OSError, ImportError, FloatingPointError, MemoryError)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command, by default of ``sys.argv``, and return the exit status. An error is printed as one line on standard error.

    The status is 0 on success, 1 if the command failed or a check found an error, 2 if the command line is wrong, 130 if
    Ctrl-C or SIGTERM stopped it.
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
