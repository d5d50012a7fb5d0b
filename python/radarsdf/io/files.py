"""Atomic writes of files, locks of folders, and the limit of float32 coordinates."""

import errno
import os
import re
import secrets
import socket
import stat
import sys
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

import numpy as np

from radarsdf.arrays import Floats
from radarsdf.checks import AnyPath, check, path_of, restating

_MAX_NAME_BYTES = 255  # limit of nearly all file systems
_MAX_STEM = 50  # characters of at most four bytes: keeps the temporary name within the limit
_MAX_FLOAT32_M = 16_384.0  # further from the origin, float32 resolves less than 1 mm
_LOCK_FLAGS = ("O_CREAT", "O_RDWR", "O_BINARY", "O_NOFOLLOW", "O_NONBLOCK")  # flags that the system supports
_LOCKED = (errno.EAGAIN, errno.EACCES, errno.EDEADLK)


def check_regular_file(path: AnyPath) -> None:
    """Raise unless `path` can be opened and is no pipe or device: reading those could block or never end."""
    check(Path(path).is_dir() or stat.S_ISREG(Path(path).stat().st_mode), f"{path} is not a regular file")
    with open(path, "rb"):  # noqa: PTH123 - raises the error that names the path, for a folder too
        pass


def checked_suffix(path: AnyPath | None, suffixes: Sequence[str], what: str) -> str:
    """Return the suffix of a path, if any, in lower case. Raises a ValueError unless it is one of these, those of files of `what`."""
    suffix = "" if path is None else path_of(path, "path").suffix.lower()
    check(path is None or suffix in suffixes, f"{path}: files of {what} end in {', '.join(suffixes)}")
    return suffix


def reading(path: AnyPath, what: str, *errors: type[Exception]) -> AbstractContextManager[None]:
    """Turn a ValueError, or one of `errors`, raised in the block into a ValueError that `path` is not `what`."""
    return restating(f"{path} is not {what}", ValueError, *errors)


def check_outputs(outputs: Iterable[AnyPath | None], inputs: Iterable[AnyPath | None] = ()) -> None:
    """Raise, before the work, unless each output can be written, and is neither an input nor another output."""
    taken = {os.path.realpath(path): path for path in inputs if path is not None}
    for path in outputs:
        if path is None:
            continue
        target = os.path.realpath(path)
        check(target not in taken, f"{path} is the same file as {taken.get(target)}: give another name")
        taken[target] = path
        _mode_to_keep(Path(target), path)
        descriptor, temporary = _open_temporary(Path(target))
        temporary.unlink(missing_ok=True)
        os.close(descriptor)


def write_whole(path: AnyPath, data: bytes) -> None:
    with whole_file(path) as file:
        file.write(data)


@contextmanager
def whole_file(path: AnyPath) -> Iterator[BinaryIO]:
    """Open a file for writing, also by its `name`, that replaces the one at `path` only once it is on the disk.

    If the block raises, the old file is unchanged. Links are followed, and the old file's permissions are kept. A killed
    process may leave a hidden file named `.NAME.` and 16 hexadecimal digits in the same folder, which the next call removes.
    """
    target = Path(os.path.realpath(path_of(path, "path")))
    mode = _mode_to_keep(target, path)
    _remove_abandoned(target)
    descriptor, temporary = _open_temporary(target)
    try:
        with open(temporary, "w+b", opener=lambda *_: descriptor) as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
            if mode is not None:
                temporary.chmod(mode)
            if sys.platform != "win32":  # while it is locked
                temporary.replace(target)
        if sys.platform == "win32":
            temporary.replace(target)
    except BaseException as error:
        with suppress(OSError):  # its folder or the disk may be gone, as the first error says
            temporary.unlink()
        # A full disk names no file. Errors without a number are not the system's; those with another file are the block's.
        if isinstance(error, OSError) and error.errno and error.filename in (None, str(temporary)):
            raise OSError(error.errno, error.strerror, str(path)) from error
        raise


def _mode_to_keep(target: Path, named: AnyPath) -> int | None:
    if not target.exists():
        return None
    mode = target.stat().st_mode
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(named))
    check(stat.S_ISREG(mode), f"{named} is not a regular file")
    return stat.S_IMODE(mode)


def _remove_abandoned(target: Path) -> None:
    """Remove temporary files for `target` of killed processes, which no longer lock them."""
    ours = re.compile(rf"\.{re.escape(target.name[:_MAX_STEM])}\.[0-9a-f]{{16}}")
    with suppress(OSError):  # a leftover file is harmless
        for path in target.parent.iterdir():
            if ours.fullmatch(path.name):
                with suppress(OSError), path.open("rb+") as file:
                    _lock(file.fileno())
                    path.unlink()


def _open_temporary(target: Path) -> tuple[int, Path]:
    """Create and lock a file in the folder of `target`: a rename is atomic only within a file system."""
    if len(os.fsencode(target.name)) > _MAX_NAME_BYTES:
        raise OSError(errno.ENAMETOOLONG, os.strerror(errno.ENAMETOOLONG), str(target))
    temporary = target.with_name(f".{target.name[:_MAX_STEM]}.{secrets.token_hex(8)}")
    # Not tempfile: its files are readable by the owner only, and the rename would keep that.
    flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)
    try:
        descriptor = os.open(temporary, flags, 0o666)
    except OSError as error:
        missing = isinstance(error, FileNotFoundError) and not target.parent.is_dir()
        why = f"there is no folder {target.parent}" if missing else error.strerror
        raise OSError(error.errno, why, str(target)) from error
    with suppress(OSError):  # some file systems have no locks: nothing is removed there
        _lock(descriptor)
    if temporary.exists():
        return descriptor, temporary
    os.close(descriptor)  # another process took it for abandoned before it was locked
    return _open_temporary(target)


def take_lock(path: Path, use: str) -> int:
    """Lock a file and return its descriptor; closing it, or the end of the process, unlocks it.

    The file stays, since another process may be about to lock it. `use` is a participle that says what the folder is locked
    for. Raises a BlockingIOError that names the holder if the file is locked, an OSError if it cannot be written.
    """
    descriptor = os.open(path, sum(getattr(os, flag, 0) for flag in _LOCK_FLAGS), 0o666)
    try:
        _lock(descriptor)
    except OSError as error:
        if error.errno in _LOCKED:
            os.close(descriptor)
            text = path.read_text(errors="replace")[:100]
            holder = text if text and text.isprintable() else "another process"  # empty for a moment
            msg = f"{path.parent} is being {use} by {holder}: wait until that is done, or give another folder"
            raise BlockingIOError(msg) from error
        # Some file systems of clusters have no locks.
        words = f"{path.parent} cannot be locked ({error.strerror}): make sure that no other process uses it meanwhile"
        warnings.warn(words, RuntimeWarning, stacklevel=3)
    os.ftruncate(descriptor, 0)
    os.write(descriptor, f"process {os.getpid()} on {socket.gethostname()}".encode())
    return descriptor


def _lock(descriptor: int) -> None:
    if sys.platform == "win32":
        import msvcrt  # noqa: PLC0415

        os.lseek(descriptor, 1 << 30, os.SEEK_SET)  # beyond the text, since nobody can read what is locked
        msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
        os.lseek(descriptor, 0, os.SEEK_SET)
    else:
        import fcntl  # noqa: PLC0415

        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)


def check_fits_float32(path: AnyPath, points: Floats) -> None:
    """Raise a ValueError if float32 would round points (N, 3), m, by more than a millimetre."""
    near = np.abs(points).max(initial=0.0) <= _MAX_FLOAT32_M
    check(near, f"{path}: float32 is too coarse {_MAX_FLOAT32_M:g} m from the origin: write .ply")
