# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The one way in which commands print."""

from __future__ import annotations

import os
import sys
from contextlib import suppress
from typing import TYPE_CHECKING, TextIO

if TYPE_CHECKING:
    from radarsdf.view.serving import Page


def say(text: str = "", end: str = "\n") -> None:
    """Print to standard output at once, if there is one.

    Parameters
    ----------
    text, end
        As of print.

    Raises
    ------
    OSError
        If standard output cannot be written: its disk is full, or no one reads the pipe. The message names it.
    """
    try:
        _print(sys.stdout, text, end)
    except OSError as error:
        if error.errno is None:  # not of the system: its message is all there is
            raise
        raise OSError(error.errno, error.strerror, "standard output") from error


def complain(text: str) -> None:
    """Print to standard error at once, if there is one that can be written: the exit status says it too."""
    with suppress(OSError):
        _print(sys.stderr, text, "\n")


def until_stopped(page: Page) -> None:
    """Wait until Ctrl-C, and say that it ended."""
    try:
        page.wait()
    except KeyboardInterrupt:  # the way to end it, and no failure
        say("stopped")


def _print(stream: TextIO | None, text: str, end: str) -> None:
    if stream is None:  # closed; print would take None for standard output
        return
    try:
        print(text, end=end, file=stream, flush=True)
    except OSError:
        _discard_the_rest(stream)
        raise


def _discard_the_rest(stream: TextIO) -> None:
    """Empty the buffer into nothing: the interpreter would try to write it once more when it ends."""
    try:
        descriptor = stream.fileno()
    except (OSError, ValueError):
        return
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, descriptor)
    os.close(nowhere)
    stream.flush()
