# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""A lock of a folder, so that one process at a time makes its plan."""

from __future__ import annotations

import errno
import os
import socket
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

LOCK = "plan.lock"
_FLAGS = ("O_CREAT", "O_RDWR", "O_BINARY", "O_NOFOLLOW", "O_NONBLOCK")  # as far as the system has them
_HELD = (errno.EAGAIN, errno.EACCES, errno.EDEADLK)
_MAX_NAME = 100  # of who holds it, characters

if sys.platform == "win32":
    import msvcrt

    def _lock(descriptor: int) -> None:
        # A byte far beyond the text: nobody could read what is locked.
        os.lseek(descriptor, 1 << 30, os.SEEK_SET)
        msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
        os.lseek(descriptor, 0, os.SEEK_SET)

else:

    def _lock(descriptor: int) -> None:
        import fcntl  # noqa: PLC0415 (a system without it can do all but plan tiles)

        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)


@contextmanager
def only_planner(folder: Path) -> Iterator[None]:
    """No other process or thread is in such a block for the same folder.

    The lock is the system's: it ends with the process, however that ends. The file stays, since another process may be
    about to lock it.

    Raises
    ------
    BlockingIOError
        If another one is. The message names it.
    OSError
        If the folder cannot be written.
    """
    path, flags = folder / LOCK, sum(getattr(os, flag, 0) for flag in _FLAGS)
    with os.fdopen(os.open(path, flags, 0o666), "r+b") as file:
        try:
            _lock(file.fileno())
        except OSError as error:
            if error.errno in _HELD:
                msg = f"{folder} is being planned by {_holder(path)}: wait until that is done, or give another folder"
                raise BlockingIOError(msg) from error
            # Not all file systems of clusters have locks.
            words = f"{folder} cannot be locked ({error.strerror}): let no other process plan it meanwhile"
            warnings.warn(words, RuntimeWarning, stacklevel=3)
        file.truncate()
        file.write(f"process {os.getpid()} on {socket.gethostname()}".encode())
        file.flush()
        yield


def _holder(path: Path) -> str:
    """Who wrote the file: it may be empty for a moment."""
    said = path.read_text(errors="replace")[:_MAX_NAME]
    return said if said and said.isprintable() else "another process"
