# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Processes killed while they save two maps to one file in turn: the file is always one of the two."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from radarsdf.map.radar_map import load_file

from .. import samples

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
