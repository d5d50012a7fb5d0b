# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""A map's file while its writer is killed or the disk is full: the old map or the new one."""

from __future__ import annotations

import errno
import resource
import sys

import pytest
import radarsdf

from .. import samples
from ..warm_python import warm_python
from .savers import kill_savers

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="signals and limits of POSIX")


def test_a_killed_saver_leaves_one_of_the_versions(tmp_path):
    found, _ = kill_savers(tmp_path, kills=3, python=warm_python())
    assert sum(found) == 3


@pytest.mark.parametrize("share", [0.0, 0.5, 0.999])
def test_a_file_that_does_not_fit_leaves_the_old_one_and_nothing_else(tmp_path, share):
    old, new = samples.maps()
    path = tmp_path / "map.safetensors"
    path.write_bytes(new)
    radar_map = radarsdf.load(path)
    path.write_bytes(old)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (int(share * len(new)), limits[1]))
    try:
        with pytest.raises(OSError, match=r".") as caught:
            radar_map.save(path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert caught.value.errno in (errno.EFBIG, errno.ENOSPC)
    assert path.read_bytes() == old
    assert [p.name for p in tmp_path.iterdir()] == ["map.safetensors"]
