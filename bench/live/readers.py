# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Readers in other threads while scans come, move and go: whether all see whole states, and how long scans take by the clock."""

from __future__ import annotations

import argparse
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import radarsdf
from radarsdf import FitConfig, LiveMap

from bench.rows import quantile
from bench.timing import timed

_ROUNDS = 3  # of the drive
_PAUSE_S = 0.01  # of a reader: without one, it would only be measured how Python's lock is shared


def rows(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """A row without readers, and one with them."""
    frames = 12 if options.quick else 60
    for name in options.cases or ["oculii"]:
        scans = radarsdf.simulate.SCENES[name](seed=options.seed, frames=frames)
        for with_readers in (False, True):
            yield {"scene": name} | _row(scans, with_readers, options)


def _row(scans: Any, with_readers: bool, options: argparse.Namespace) -> dict[str, Any]:
    # Regions come from the disk and go there while others read.
    with TemporaryDirectory() as folder:
        config = FitConfig(num_threads=options.threads)
        live = LiveMap(config, origin=(0, 0, 0), folder=Path(folder) / "map", max_bytes=25_000_000)
        file = Path(folder) / "state.npz"
        reads: list[Callable[[], Any]] = [
            lambda: _whole(live.mesh()),
            lambda: live.map().sdf(scans.ground_truth[:100]),
            lambda: live.save(file),
            lambda: _consistent(live),
        ]
        done, counts, errors = threading.Event(), Counter[int](), list[BaseException]()

        def read(number: int) -> None:
            while not done.is_set():
                try:
                    reads[number]()
                    counts[number] += 1
                    time.sleep(_PAUSE_S)
                except BaseException as error:  # noqa: BLE001 - all of them are counted
                    errors.append(error)
                    return

        live.integrate(scans.points[0], scans.poses[0], scans.intensities[0], scan_id=-1)
        threads = [threading.Thread(target=read, args=(k,)) for k in range(len(reads) if with_readers else 0)]
        for thread in threads:
            thread.start()
        wall_ms = _written(live, scans, np.random.default_rng(options.seed))
        done.set()
        for thread in threads:
            thread.join()
        other = LiveMap(config, origin=(0, 0, 0))
        for scan_id in live.scan_ids:
            assert isinstance(scan_id, int)
            i = max(0, scan_id) % len(scans)
            other.integrate(scans.points[i], live.pose(scan_id), scans.intensities[i], scan_id=scan_id)
        equal = live.map().sdf(scans.ground_truth).tobytes() == other.map().sdf(scans.ground_truth).tobytes()
        return {
            "readers": len(threads),
            "changes": len(wall_ms),
            "p50 by the clock, ms": quantile(wall_ms, 0.5),
            "p99 by the clock": quantile(wall_ms, 0.99),
            "meshes, maps, saved, sizes": ", ".join(str(counts[k]) for k in range(len(reads))),
            "errors": "; ".join(map(repr, errors)) or "none",
            "bits of a map of these scans": "equal" if equal else "NOT EQUAL",
        }


def _written(live: LiveMap, scans: Any, rng: np.random.Generator) -> list[float]:
    """Scans come; a third of them move, another third go again. Gives the times of all these changes, ms."""
    times = []

    def changed(act: Callable[[], Any]) -> None:
        with timed() as taken:
            act()
        times.append(1e3 * taken.wall_s)

    for k in range(_ROUNDS * len(scans)):
        i = k % len(scans)
        changed(lambda: live.integrate(scans.points[i], scans.poses[i], scans.intensities[i], scan_id=k))  # noqa: B023
        if k % 3 == 1:
            moved = scans.poses[i].copy()
            moved[:3, 3] += rng.normal(0, 0.1, 3)
            changed(lambda: live.move(k, moved))  # noqa: B023
        elif k % 3 == 2:
            changed(lambda: live.remove(k))  # noqa: B023
    return times


def _whole(mesh: Any) -> None:
    if len(mesh.faces) and not (np.isfinite(mesh.vertices).all() and mesh.faces.max() < len(mesh.vertices)):
        msg = "a mesh that is no whole"
        raise AssertionError(msg)


def _consistent(live: LiveMap) -> None:
    if not 0 < live.num_bytes < 10**10 or len(live.scan_ids) == 0 or len(live) == 0:
        msg = f"a map that is no whole: {live!r}"
        raise AssertionError(msg)
