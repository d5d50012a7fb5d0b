# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The command line: ``radarsdf COMMAND``.

Each command is a module of this package with two functions: ``add_arguments(parser)`` declares the arguments and
``run(options)`` does the work, and may return the exit status. The module is imported only if its command is on the
command line, and it imports PyTorch, NumPy and trimesh only in ``run``. So help and usage errors are printed at once.
"""

from __future__ import annotations

import argparse
import signal
import sys
from collections.abc import Sequence
from importlib import import_module
from typing import Any

from radarsdf.cli.saying import complain, say

COMMANDS = {
    "demo": "simulate a drive, fit it, write scans, map, mesh and picture, print the errors",
    "check": "say what is wrong with scans and poses, before a fit",
    "fit": "fit a map to scans",
    "mesh": "extract the surface of a map as a triangle mesh",
    "eval": "print the errors of a mesh or a map",
    "config": "print every setting of a fit with its meaning, as a file for --config",
    "info": "print versions, compiler, instruction set and threads, for bug reports",
}
"""Name of each command, which is also the name of its module, and its help in one line."""

_ERRORS = (ValueError, OSError, ImportError, FloatingPointError, MemoryError)
"""Errors with a message for the user. Every other error is a bug and keeps its traceback."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command.

    An error is printed as one line on standard error.

    Parameters
    ----------
    arguments
        The words after ``radarsdf``. None: those of this process.

    Returns
    -------
    int
        The exit status: 0 if the command succeeded, 1 if it failed or a check found an error, 130 if Ctrl-C stopped it.

    Raises
    ------
    SystemExit
        After ``--help``, with status 0, and after a usage error, with status 2.
    """
    words = sys.argv[1:] if arguments is None else arguments
    if hasattr(
        sys.stdout, "reconfigure"
    ):  # a character that a terminal lacks must not cost the work before it
        sys.stdout.reconfigure(errors="replace")
    try:
        options = _parser(words).parse_args(words)
    except SystemExit:
        try:
            say(end="")  # what help printed may still be on its way
        except OSError as error:
            return _failed("", str(error), 1)
        raise
    try:
        status: int | None = _module(options.command).run(options)
    except _ERRORS as error:
        return _failed(options.command, str(error) or type(error).__name__, 1)
    except KeyboardInterrupt as interruption:
        return _interrupted(options.command, interruption)
    return status or 0


def _parser(words: Sequence[str]) -> argparse.ArgumentParser:
    """The parser of all commands. Only the command on the command line has its arguments."""
    parser = argparse.ArgumentParser(
        prog="radarsdf",
        description="From 3D radar scans with known poses to a surface and a reflectance map, on a CPU.",
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    chosen = next((word for word in words if not word.startswith("-")), None)
    for name, text in COMMANDS.items():
        command = commands.add_parser(name, help=text, description=text)
        if name == chosen:
            _module(name).add_arguments(command)
    return parser


def _module(command: str) -> Any:
    return import_module(f"{__name__}.{command}")


def _interrupted(command: str, interruption: KeyboardInterrupt) -> int:
    """What Ctrl-C does to any command. The status is that of shells: 128 and the number of the signal."""
    return _failed(command, str(interruption) or "interrupted", 128 + signal.SIGINT)


def _failed(command: str, message: str, status: int) -> int:
    complain(f"{f'radarsdf {command}'.strip()}: {message}")
    return status
