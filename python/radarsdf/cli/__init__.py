# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The command line: ``radarsdf COMMAND``.

Each command is a module of this package with two functions: ``add_arguments(parser)`` declares the arguments and
``run(options)`` does the work, and may return the exit status. The module is imported only if its command is on the
command line, and it imports PyTorch, NumPy and trimesh only in ``run``. So help and usage errors are printed at once.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
from collections.abc import Sequence
from importlib import import_module
from typing import Any

from radarsdf.cli.saying import complain, say

COMMANDS = {
    "demo": "simulate a drive, fit it, write scans, map, mesh and picture, print the errors",
    "check": "say what is wrong with scans and poses, before a fit",
    "poses": "mend the poses of scans by their returns, or find them from the radar alone",
    "fit": "fit a map to scans",
    "live": "give a recording to a map that grows, as a driver would, and say how it keeps up",
    "tiles": "fit a map that does not fit into memory, in tiles, here or on a cluster",
    "mesh": "extract the surface of a map as a triangle mesh",
    "grid": "write what is occupied, free and unknown, for planners: OctoMap, ROS's map_server, costs for wheels",
    "compare": "say what appeared, is gone, moved or was repainted between two maps, or a map and new scans",
    "view": "show a map in the browser, with a sensor that can be dragged",
    "render": "predict the scan that the radar would get from other poses",
    "report": "write a page about a map: pictures, errors, plots, settings",
    "eval": "print the errors of a mesh or a map",
    "convert": "write scans as one file or one point cloud, or a mesh in another format",
    "config": "print every setting of a fit with its meaning, as a file for --config",
    "info": "print versions, compiler, instruction set and threads, for bug reports, and what a map holds",
    "completion": "print what bash, zsh or fish need to complete commands and options",
}
"""Name of each command, which is also the name of its module, and its help in one line."""

_ERRORS = (ValueError, OSError, ImportError, FloatingPointError, MemoryError)
"""Errors with a message for the user. Every other error is a bug and keeps its traceback."""


_REASONS: dict[type[OSError], str] = {
    FileNotFoundError: "there is no such file or folder",
    IsADirectoryError: "it is a folder, not a file",
    NotADirectoryError: "a part of this path is a file, not a folder",
    PermissionError: "you may not read or write it",
}
"""Errors of the system that most users meet, in words."""


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
        After ``--help``, without words and after ``--version``, with status 0, and after a usage error, with status 2.
    """
    words = sys.argv[1:] if arguments is None else arguments
    if hasattr(
        sys.stdout, "reconfigure"
    ):  # a character that a terminal lacks must not cost the work before it
        sys.stdout.reconfigure(errors="replace")
    try:
        options = _parser(words).parse_args(words or ["--help"])
    except SystemExit:
        try:
            say(end="")  # what help printed may still be on its way
        except OSError as error:
            return _failed("", _words_of(error), 1)
        raise
    try:
        status: int | None = _module(options.command).run(options)
    except _ERRORS as error:
        return _failed(options.command, _words_of(error), 1)
    except KeyboardInterrupt as interruption:
        return _interrupted(options.command, interruption)
    return status or 0


class _Parser(argparse.ArgumentParser):
    """Takes words also behind options, where argparse has done with a word that may be left out, such as POSES."""

    _within = False

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        if self._within or self._subparsers is not None:
            return super().parse_known_args(args, namespace)
        self._within = True  # which parse_known_intermixed_args calls again
        try:
            return self.parse_known_intermixed_args(args, namespace)
        finally:
            self._within = False


class _Version(argparse.Action):
    """Looks the version up only where it is asked for: that takes as long as all of a help text."""

    def __init__(self, option_strings: Sequence[str], dest: str, **options: Any) -> None:
        super().__init__(option_strings, dest, nargs=0, **options)

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        import radarsdf

        say(f"radarsdf {radarsdf.__version__}")
        parser.exit()


def whole_parser() -> argparse.ArgumentParser:
    """The parser with the arguments of all commands."""
    return _parser((), every=True)


def _parser(words: Sequence[str], every: bool = False) -> argparse.ArgumentParser:
    """The parser of all commands. Only the command on the command line has its arguments, unless `every` one has."""
    parser = _Parser(
        prog="radarsdf",
        description="From 3D radar scans to a surface and a reflectance map, on a CPU.",
        epilog="radarsdf COMMAND --help says more. To begin: radarsdf demo, or radarsdf check SCANS.",
    )
    parser.add_argument("--version", action=_Version, help="print the version and end")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    chosen = next((word for word in words if not word.startswith("-")), None)
    for name, text in COMMANDS.items():
        command = commands.add_parser(name, help=text, description=text)
        if every or name == chosen:
            _add_arguments(command, name, words)
    return parser


def _add_arguments(parser: argparse.ArgumentParser, name: str, words: Sequence[str]) -> None:
    """The arguments of a command; of one that has steps, those of the step that follows it on the command line."""
    module = _module(name)
    steps: dict[str, str] = getattr(module, "STEPS", {})
    following = words[words.index(name) + 1 :][:1] if name in words else []
    if not following or following[0] not in steps:
        module.add_arguments(parser)
        return
    parsers = parser.add_subparsers(dest="step", required=True, metavar="STEP")
    for step, text in steps.items():
        module.add_step_arguments(parsers.add_parser(step, help=text, description=text), step)


def _module(command: str) -> Any:
    return import_module(f"{__name__}.{command}")


def _words_of(error: Exception) -> str:
    """What to say of an error: of those of the system, the file and what is wrong with it."""
    if isinstance(error, OSError) and error.errno is not None and error.strerror is not None:
        plain = error.strerror == os.strerror(error.errno)  # not yet said in better words
        reason = _REASONS.get(type(error), error.strerror) if plain else error.strerror
        return f"{error.filename}: {reason}" if error.filename is not None else reason
    # NumPy says which array it could not have; our own words are kept.
    if isinstance(error, MemoryError) and (not str(error) or str(error).startswith("Unable to allocate")):
        return "there is not enough memory"
    return str(error) or type(error).__name__


def _interrupted(command: str, interruption: KeyboardInterrupt) -> int:
    """What Ctrl-C does to any command. The status is that of shells: 128 and the number of the signal."""
    return _failed(command, str(interruption) or "interrupted", 128 + signal.SIGINT)


def _failed(command: str, message: str, status: int) -> int:
    complain(f"{f'radarsdf {command}'.strip()}: {message}")
    return status
