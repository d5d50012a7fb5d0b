# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""A process that saves two maps to one file by turns is killed: the file is always one of the two, whole."""

from __future__ import annotations

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


def run(kills: int) -> None:
    """Print what the file was after each kill."""
    with tempfile.TemporaryDirectory() as folder:
        found, left = kill_savers(Path(folder), kills)
    rows = [[str(kills), *map(str, found), "0", str(left)]]
    print(
        markdown(["kills", "first version", "second version", "anything else", "temporary files left"], rows)
    )
