# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Killed processes and full disks while two maps are saved to one file in turn: the file is always one of the two."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from radarsdf.map.radar_map import load_file

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


def kill_savers(folder: Path, kills: int, python: Sequence[str] = (sys.executable,)) -> tuple[list[int], int]:
    """Kill processes that save two maps to one file in turn; `python` are the first words of their command.

    Returns
    -------
    found : list of int
        How often the file was each of the two maps.
    left : int
        Number of temporary files that were left.

    Raises
    ------
    AssertionError
        If the file is anything else, or does not load.
    """
    rng = np.random.default_rng(0)
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
            [*python, "-c", _SAVER, *sources, str(target)], stdout=subprocess.PIPE, text=True
        )
        assert saver.stdout is not None
        assert saver.stdout.readline() == "ready\n"
        time.sleep(rng.uniform(0, 0.05))
        saver.kill()
        saver.stdout.read()  # until nobody has it open
        assert saver.wait() == -signal.SIGKILL
        saver.stdout.close()
        found[versions.index(_content(target))] += 1
        # The temporary file of a killed process is hidden, and named after the file.
        for temporary in saved.glob(f".{target.name}.*"):
            temporary.unlink()
            left += 1
        assert [path.name for path in saved.iterdir()] == [target.name]
    return found, left


def _content(path: Path) -> bytes:
    """All numbers of a map. The bytes of its file are not compared: safetensors writes metadata in random order."""
    field = load_file(path).field
    numbers = [field.table.leaf_keys(), *(tensor.numpy() for tensor in field.state_dict().values())]
    return b"".join(array.tobytes() for array in numbers)


def fill_disk(folder: Path) -> list[int]:
    """Save a map on disks of increasing size, on each of which there is an older map.

    Returns
    -------
    list of int
        Sizes of the disks that were too small, in pages.

    Raises
    ------
    AssertionError
        If the file is not the old map after an error, or not the new one without, or if there is another file.
    PermissionError
        If this process may not mount a disk.
    """
    old, new = samples.maps()
    (folder / "new").write_bytes(new)
    radar_map = load_file(folder / "new")
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
    """Print the results of the kills and of the full disks."""
    with tempfile.TemporaryDirectory() as folder:
        found, left = kill_savers(Path(folder), kills)
    rows = [[str(kills), *map(str, found), "0", str(left)]]
    print(markdown(["kills", "first map", "second map", "anything else", "temporary files left"], rows))
    with tempfile.TemporaryDirectory() as folder:
        try:
            refused = fill_disk(Path(folder))
        except (PermissionError, FileNotFoundError) as error:
            print(f"full disks were not tested: {error}")
            return
    print(
        f"disks of {refused[0]} to {refused[-1]} pages were too small: the old map remained, and no other file"
    )
