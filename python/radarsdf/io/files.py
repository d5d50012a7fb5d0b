# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Checks of files before they are read, and the one way in which files are written."""

from __future__ import annotations

import errno
import os
import secrets
import stat
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from os import PathLike
from pathlib import Path
from typing import BinaryIO

from radarsdf.checks import path_of

_MAX_NAME_BYTES = 255  # of nearly all file systems
_MAX_PART_OF_NAME = (
    50  # characters, of at most four bytes: the temporary name must not be longer than the limit
)


def check_regular_file(path: str | PathLike[str]) -> None:
    """Raises unless `path` is a regular file that can be read.

    Pipes and devices are refused: reading them could block forever, or never end.
    """
    if not Path(path).is_dir() and not stat.S_ISREG(Path(path).stat().st_mode):
        msg = f"{path} is not a regular file"
        raise ValueError(msg)
    with open(path, "rb"):  # noqa: PTH123 - raises the error that names the path, for a folder too
        pass


@contextmanager
def in_utf8(path: str | PathLike[str]) -> Iterator[Path]:
    """A path in UTF-8 to a file or folder, for libraries that take no others: the names of Linux are any bytes.

    Yields
    ------
    Path
        `path` itself if it can be, or else a link to it with the same suffix, which is removed.
    """
    try:
        os.fspath(path).encode()
    except UnicodeEncodeError:
        with tempfile.TemporaryDirectory(prefix="radarsdf_") as folder:
            link = Path(folder) / f"link{Path(path).suffix.encode(errors='ignore').decode()}"
            link.symlink_to(os.path.abspath(path))  # noqa: PTH100 - a link in the path stays as it is
            yield link
    else:
        yield Path(path)


def are_numbers(words: list[str]) -> bool:
    """Whether words of a text file are numbers, and so no header."""
    try:
        [float(word) for word in words]
    except ValueError:
        return False
    return True


def check_outputs(
    outputs: Iterable[str | PathLike[str] | None], inputs: Iterable[str | PathLike[str] | None] = ()
) -> None:
    """Raises unless each output can be written, and is neither an input nor another output. To be called before the work.

    A path that is None is ignored. Links are followed.
    """
    taken = {os.path.realpath(path): path for path in inputs if path is not None}
    for path in outputs:
        if path is None:
            continue
        target = os.path.realpath(path)
        if target in taken:
            msg = f"{path} is the same file as {taken[target]}, which would be lost: give another name"
            raise ValueError(msg)
        taken[target] = path
        _check_target(Path(target), path)
        descriptor, temporary = _open_beside(Path(target))
        os.close(descriptor)
        temporary.unlink()


def write_whole(path: str | PathLike[str], data: bytes) -> None:
    """Writes a file whole or not at all; see :func:`whole_file`."""
    with whole_file(path) as file:
        file.write(data)


@contextmanager
def whole_file(path: str | PathLike[str]) -> Iterator[BinaryIO]:
    """A file that is written whole or not at all: an old one at `path` is replaced once the new one is on the disk.

    A link is followed, and the old file's permissions stay. A process that is killed while it writes may leave a hidden
    file in the same folder, named `.NAME.` and 16 hexadecimal digits.

    Yields
    ------
    file
        Open for writing, and empty. If the block raises, it is removed, and the old file is as before.
    """
    target = Path(os.path.realpath(path_of(path, "path")))
    mode = _check_target(target, path)
    descriptor, temporary = _open_beside(target)
    try:
        with os.fdopen(descriptor, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        if mode is not None:
            temporary.chmod(mode)
        temporary.replace(target)
    except OSError as error:
        _remove(temporary)
        if error.errno is None:  # not of the system: its message is all there is
            raise
        if error.filename not in (None, str(temporary)):  # of a file that the block reads
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error  # a full disk names no file
    except BaseException:
        _remove(temporary)
        raise


def _check_target(target: Path, named: str | PathLike[str]) -> int | None:
    """Permissions of the file that would be replaced; None if there is none."""
    try:
        mode = target.stat().st_mode
    except FileNotFoundError:
        return None
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(named))
    if not stat.S_ISREG(mode):
        msg = f"{named} is not a regular file"
        raise ValueError(msg)
    return stat.S_IMODE(mode)


def _open_beside(target: Path) -> tuple[int, Path]:
    """A new file in the same folder, since only within a file system does a rename replace at once."""
    if len(os.fsencode(target.name)) > _MAX_NAME_BYTES:
        raise OSError(errno.ENAMETOOLONG, os.strerror(errno.ENAMETOOLONG), str(target))
    temporary = target.with_name(f".{target.name[:_MAX_PART_OF_NAME]}.{secrets.token_hex(8)}")
    # Not tempfile: only the owner may read its files, and the rename would keep that.
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)
    try:
        return os.open(temporary, flags, 0o666), temporary
    except FileNotFoundError as error:
        why = (
            "nothing can be written here" if target.parent.is_dir() else f"there is no folder {target.parent}"
        )
        raise FileNotFoundError(error.errno, why, str(target)) from error
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(target)) from error


def _remove(temporary: Path) -> None:
    with suppress(OSError):  # its folder may be gone, or the disk; the first error says so
        temporary.unlink()
