# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""A process that saves two maps to one file by turns is killed, and disks are full: the file is always one of the two."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import radarsdf

from bench.paper.report import markdown

from . import samples

_SAVER = """
import sys
import radarsdf
maps = [radarsdf.load(path) for path in sys.argv[1:3]]
print("ready", flush=True)
while True:
    for radar_map in maps:
        radar_map.save(sys.argv[3])
"""


def kill_savers(folder: Path, kills: int, seed: int = 0) -> tuple[list[int], int]:
    """How often the file held each of the versions after a kill, and how many temporary files were left behind.

    Raises
    ------
    AssertionError
        If the file is anything else, or does not load.
    """
    rng = np.random.default_rng(seed)
    versions = []
    for i, data in enumerate(samples.maps()):
        (folder / f"version{i}.safetensors").write_bytes(data)
        versions.append(_content(folder / f"version{i}.safetensors"))
    saved = folder / "saved"
    saved.mkdir()
    target = saved / "map.safetensors"
    target.write_bytes(samples.maps()[0])
    found, left = [0] * len(versions), 0
    sources = [str(folder / f"version{i}.safetensors") for i in range(len(versions))]
    for _ in range(kills):
        saver = subprocess.Popen(
            [sys.executable, "-c", _SAVER, *sources, str(target)], stdout=subprocess.PIPE, text=True
        )
        assert saver.stdout is not None
        assert saver.stdout.readline() == "ready\n"
        time.sleep(rng.uniform(0, 0.05))
        saver.kill()
        assert saver.wait() == -signal.SIGKILL
        saver.stdout.close()
        found[versions.index(_content(target))] += 1
        # What a killed process has no chance to remove; it is hidden, and named after the file.
        for temporary in saved.glob(f".{target.name}.*"):
            temporary.unlink()
            left += 1
        assert [path.name for path in saved.iterdir()] == [target.name]
    return found, left


def _content(path: Path) -> bytes:
    """All numbers of a map. Not the bytes of its file: in what order safetensors writes metadata is left to chance."""
    field = radarsdf.load(path).field
    numbers = [field.cells.table.leaf_keys(), *(tensor.numpy() for tensor in field.state_dict().values())]
    return b"".join(array.tobytes() for array in numbers)


def fill_disk(folder: Path) -> list[int]:
    """Saves a map onto disks of ever more pages, on each of which an older one lies; the sizes for which there was no room.

    Raises
    ------
    AssertionError
        If after an error the old map is not whole, or anything else is there; or after none, the new one.
    PermissionError
        If this process may not mount a disk.
    """
    old, new = samples.maps()
    (folder / "new").write_bytes(new)
    radar_map = radarsdf.load(folder / "new")
    disk, refused = folder / "disk", []
    disk.mkdir()
    target, page = disk / "map.safetensors", os.sysconf("SC_PAGESIZE")
    for pages in range(-(-len(old) // page), -(-(len(old) + len(new)) // page) + 3):
        options = ["mount", "-t", "tmpfs", "-o", f"size={pages * page}", "tmpfs", str(disk)]
        if subprocess.run(options, check=False, capture_output=True).returncode:
            raise PermissionError(*options)
        try:
            target.write_bytes(old)
            try:
                radar_map.save(target)
            except OSError as error:
                if error.errno != errno.ENOSPC:
                    raise
                assert target.read_bytes() == old
                refused.append(pages)
            else:
                assert _content(target) == _content(folder / "new")
            assert [path.name for path in disk.iterdir()] == [target.name]
        finally:
            subprocess.run(["umount", str(disk)], check=True)
    return refused


def run(kills: int) -> None:
    """Print what the file was after each kill, and on full disks."""
    with tempfile.TemporaryDirectory() as folder:
        found, left = kill_savers(Path(folder), kills)
    rows = [[str(kills), *map(str, found), "0", str(left)]]
    print(
        markdown(["kills", "first version", "second version", "anything else", "temporary files left"], rows)
    )
    with tempfile.TemporaryDirectory() as folder:
        try:
            refused = fill_disk(Path(folder))
        except (PermissionError, FileNotFoundError) as error:
            print(f"no full disk: {error}")
            return
    print(f"disks of {refused[0]} to {refused[-1]} pages were full: the old map stayed, and nothing else")
