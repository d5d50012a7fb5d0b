# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""One process at a time plans a folder, and one that is gone keeps nobody out."""

from __future__ import annotations

import errno
import subprocess
import sys

import pytest
import radarsdf
from radarsdf.tiles import locking
from radarsdf.tiles.fit_tiles import plan_tiles
from radarsdf.tiles.plan import Plan

from .conftest import CONFIG, TILE_M, scans_of

# Plans, and waits for a line before the last scan.
PLANNING = f"""
import os, sys
import radarsdf
from radarsdf.tiles.fit_tiles import plan_tiles
from tests.tiles.conftest import CONFIG, scans_of
drive = scans_of(radarsdf.simulate.wall(seed=5, frames=3))
def slowly():
    for number, scan in enumerate(drive):
        if number == 2:
            print(os.getpid(), flush=True)
            sys.stdin.readline()
        yield scan
plan_tiles(slowly(), sys.argv[1], tile_size={TILE_M}, halo=6.4, config=CONFIG)
"""


@pytest.fixture
def planner(tmp_path):
    """Another process that is about to plan tmp_path / "city", and its number."""
    command = [sys.executable, "-c", PLANNING, str(tmp_path / "city")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        yield process, int(process.stdout.readline())
        process.kill()


def plan(folder):
    drive = scans_of(radarsdf.simulate.wall(seed=5, frames=3))
    return plan_tiles(drive, folder, tile_size=TILE_M, halo=6.4, config=CONFIG)


def test_a_second_plan_waits_for_the_first(planner, tmp_path):
    process, number = planner
    with pytest.raises(OSError, match=rf"city is being planned by process {number} on \S+: wait until"):
        plan(tmp_path / "city")
    process.communicate("go on\n")
    assert process.returncode == 0
    made = Plan.load(tmp_path / "city")
    assert plan(tmp_path / "city") == made == plan(tmp_path / "other")
    for tile in made.tiles:
        rays = [
            (tmp_path / name / "tiles" / tile.name / "rays.bin").read_bytes() for name in ("city", "other")
        ]
        assert rays[0] == rays[1]


def test_a_planner_that_was_killed_keeps_nobody_out(planner, tmp_path):
    process, _ = planner
    process.kill()
    process.wait()
    assert plan(tmp_path / "city") == plan(tmp_path / "other")


def test_a_file_system_without_locks_is_said(tmp_path, monkeypatch):
    def without(_):
        raise OSError(errno.ENOSYS, "Function not implemented")

    monkeypatch.setattr("radarsdf.io.files._lock", without)
    with pytest.warns(RuntimeWarning, match=r"cannot be locked \(Function not implemented\)"):
        assert plan(tmp_path / "city").tiles


def test_who_holds_the_lock_is_not_taken_on_trust(tmp_path):
    with locking.only_planner(tmp_path):
        (tmp_path / locking.LOCK).write_text("\x1b[2J all is well")
        with pytest.raises(OSError, match="planned by another process"), locking.only_planner(tmp_path):
            pass
    with locking.only_planner(tmp_path):
        pass


@pytest.mark.skipif(sys.platform == "win32", reason="links of POSIX")
def test_no_link_is_followed(tmp_path):
    victim = tmp_path / "victim"
    victim.write_text("all of it")
    (tmp_path / "city").mkdir()
    (tmp_path / "city" / locking.LOCK).symlink_to(victim)
    with pytest.raises(OSError, match="link"):
        plan(tmp_path / "city")
    assert victim.read_text() == "all of it"
