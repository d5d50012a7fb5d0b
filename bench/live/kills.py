# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""A process that grows a map and saves it is killed at random, and goes on from its last state each time."""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import radarsdf
from radarsdf import FitConfig, LiveMap
from radarsdf.io import Scans, read, write_scans

_KILLS, _SAVED_EVERY, _FRAMES = 100, 5, 120
_LATEST_S = 1.0  # after the first scan


def rows(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """One row: how often it was killed, and whether the map is that of its scans in the end."""
    kills = 3 if options.quick else _KILLS
    rng = np.random.default_rng(options.seed)
    lost = worst = 0
    scans = radarsdf.simulate.oculii(frames=_FRAMES)
    with tempfile.TemporaryDirectory() as folder:
        file, drive = Path(folder) / "live.npz", Path(folder) / "drive.npz"
        write_scans(drive, Scans(scans.points, scans.poses))  # once, not by each process
        for _ in range(kills):
            saved = _until_killed(file, drive, float(rng.uniform(0, _LATEST_S)))
            after = len(LiveMap.load(file)) if file.exists() else 0
            lost += after < saved
            worst = max(worst, after)
        live = LiveMap.load(file)
    other = LiveMap(live.config, origin=live.origin)
    for i in range(len(live)):
        other.integrate(scans.points[i % _FRAMES], scans.poses[i % _FRAMES])
    equal = live.map().sdf(scans.ground_truth).tobytes() == other.map().sdf(scans.ground_truth).tobytes()
    yield {
        "kills": kills,
        "scans in the map": worst,
        "states lost": lost,
        "bits of a map of these scans": "equal" if equal else "NOT EQUAL",
    }


def _until_killed(file: Path, drive: Path, seconds: float) -> int:
    """The number of scans that the process said were saved."""
    words = [sys.executable, "-m", "bench.live.kills", str(file), str(drive)]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        process.stdout.readline()
        time.sleep(seconds)
        process.kill()
        said = process.stdout.read().split()
    return int(said[-1]) if said else 0


def _grow(file: Path, drive: Path) -> None:
    scans = read(drive)
    assert scans.poses is not None
    live = LiveMap.load(file) if file.exists() else LiveMap(FitConfig(num_threads=1))
    print("begun", flush=True)
    while True:
        i = len(live) % _FRAMES
        live.integrate(scans.points[i], scans.poses[i])
        if len(live) % _SAVED_EVERY == 0:
            live.save(file)
            print(len(live), flush=True)


if __name__ == "__main__":
    _grow(Path(sys.argv[1]), Path(sys.argv[2]))
