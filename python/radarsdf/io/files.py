# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Checks of files before they are read, and the one way in which files are written."""

from __future__ import annotations

import os
import secrets
import stat
from os import PathLike
from pathlib import Path


def check_regular_file(path: str | PathLike[str]) -> None:
    """Raises unless `path` is a regular file that can be read.

    Pipes and devices are refused: reading them could block forever, or never end.

    Raises
    ------
    ValueError
        If `path` is a pipe, a socket or a device.
    OSError
        If it is a folder, does not exist, or cannot be read.
    """
    if not Path(path).is_dir() and not stat.S_ISREG(Path(path).stat().st_mode):
        msg = f"{path} is not a regular file"
        raise ValueError(msg)
    with open(path, "rb"):  # noqa: PTH123 - raises the error that names the path, for a folder too
        pass


def write_whole(path: str | PathLike[str], data: bytes) -> None:
    """Writes a file whole or not at all: an old file at `path` is replaced once the new one is on the disk.

    A process that is killed while it writes may leave a hidden file in the same folder, named `.NAME.` and 16
    hexadecimal digits.

    Raises
    ------
    OSError
        If the file cannot be written. The old file is then as before.
    """
    target = Path(path)
    # Not tempfile: only the owner may read its files, and the rename keeps their permissions.
    temporary = target.with_name(f".{target.name}.{secrets.token_hex(8)}")
    try:
        with temporary.open("xb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(target)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
