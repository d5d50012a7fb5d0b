# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Outputs are checked before the work, and written whole."""

import os
import stat
import sys

import pytest
from radarsdf.io.files import check_outputs, write_whole

posix = pytest.mark.skipif(sys.platform == "win32", reason="links, pipes and permissions of POSIX")


@posix
def test_a_link_is_followed_and_the_permissions_stay(tmp_path):
    file, link = tmp_path / "map", tmp_path / "latest"
    file.write_bytes(b"old")
    file.chmod(0o600)
    link.symlink_to(file)
    write_whole(link, b"new")
    assert link.is_symlink()
    assert file.read_bytes() == b"new"
    assert stat.S_IMODE(file.stat().st_mode) == 0o600


@posix
def test_a_pipe_is_refused_and_stays(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for function in (lambda path: write_whole(path, b""), lambda path: check_outputs([path])):
        with pytest.raises(ValueError, match="not a regular file"):
            function(tmp_path / "pipe")
    assert stat.S_ISFIFO((tmp_path / "pipe").stat().st_mode)
    with pytest.raises(ValueError, match="not a regular file"):
        check_outputs([os.devnull])


def test_outputs_that_cannot_be_written(tmp_path):
    (tmp_path / "folder").mkdir()
    with pytest.raises(FileNotFoundError):
        check_outputs([tmp_path / "absent" / "map"])
    with pytest.raises(IsADirectoryError):
        check_outputs([tmp_path / "folder"])
    with pytest.raises(OSError, match="too long"):
        check_outputs([tmp_path / ("n" * 256)])


def test_the_same_file_twice_is_refused(tmp_path):
    scans = tmp_path / "scans.npz"
    scans.write_bytes(b"scans")
    with pytest.raises(ValueError, match="same file"):
        check_outputs([tmp_path / "." / "scans.npz"], [scans])
    with pytest.raises(ValueError, match="same file"):
        check_outputs([tmp_path / "map", tmp_path / "map"])
    if sys.platform != "win32":
        (tmp_path / "link").symlink_to(scans)
        with pytest.raises(ValueError, match="same file"):
            check_outputs([tmp_path / "link"], [scans])
    assert scans.read_bytes() == b"scans"
