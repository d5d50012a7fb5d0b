# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""A lock of a folder, so that one process or object at a time uses it."""

from __future__ import annotations

import errno
import os
import socket
import sys
import warnings
from pathlib import Path

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


def take_lock(path: Path, use: str) -> int:
    """The descriptor of a file that nobody else has locked. Closing it lets others lock it.

    The lock is the system's: it ends with the process, however that ends. The file stays, since another process may be
    about to lock it. `use`: what the folder is locked for, as a participle.

    Raises
    ------
    BlockingIOError
        If it is locked. The message names by whom.
    OSError
        If the folder cannot be written.
    """
    descriptor = os.open(path, sum(getattr(os, flag, 0) for flag in _FLAGS), 0o666)
    try:
        try:
            _lock(descriptor)
        except OSError as error:
            if error.errno in _HELD:
                msg = f"{path.parent} is being {use} by {_holder(path)}: wait until that is done, or give another folder"
                raise BlockingIOError(msg) from error
            # Not all file systems of clusters have locks.
            words = f"{path.parent} cannot be locked ({error.strerror}): let nobody else use it meanwhile"
            warnings.warn(words, RuntimeWarning, stacklevel=3)
        os.ftruncate(descriptor, 0)
        os.write(descriptor, f"process {os.getpid()} on {socket.gethostname()}".encode())
    except BaseException:
        os.close(descriptor)
        raise
    return descriptor


def _holder(path: Path) -> str:
    """Who wrote the file: it may be empty for a moment."""
    said = path.read_text(errors="replace")[:_MAX_NAME]
    return said if said and said.isprintable() else "another process"
