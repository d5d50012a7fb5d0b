"""Removal and correction of scans in random order: bits and time."""

import argparse
import itertools
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np
import radarsdf
from radarsdf import FitConfig, LiveMap

from bench.measure import timed
from bench.runner import Row, quantile

_SCANS = 1000


def removal(options: argparse.Namespace) -> Iterator[Row]:
    """Yield a row per scene and operation."""
    count = 40 if options.quick else _SCANS
    for name in options.cases:
        yield from _rows(name, count, options)


def _rows(name: str, count: int, options: argparse.Namespace) -> Iterator[Row]:
    scans = radarsdf.simulate.SCENES[name](seed=options.seed, frames=count)
    rng = np.random.default_rng(options.seed)
    chosen = rng.permutation(count)[: count // 10].tolist()
    moved = scans.poses.copy()
    moved[:, :3, 3] += rng.normal(0, 0.1, (count, 3))
    poses = scans.poses.copy()
    poses[chosen] = moved[chosen]

    def grown(numbers: Iterable[int], poses: Any) -> tuple[LiveMap, list[float]]:
        live = LiveMap(FitConfig(num_threads=options.threads[0]), origin=np.zeros(3))
        return live, _times(
            numbers,
            lambda i: live.integrate(scans.points[i], poses[i], scans.intensities[i], scan_id=i),
        )

    live, integrate_ms = grown(range(count), scans.poses)
    move_ms = _times(chosen, lambda i: live.move(i, moved[i]))
    other, _ = grown(rng.permutation(count).tolist(), poses)
    yield _row(name, "move", move_ms, integrate_ms, state(live) == state(other))
    rng.shuffle(chosen)
    remove_ms = _times(chosen, live.remove)
    other, _ = grown(sorted(set(range(count)) - set(chosen)), poses)
    yield _row(name, "remove", remove_ms, integrate_ms, state(live) == state(other))


def _row(name: str, what: str, ms: list[float], integrate_ms: list[float], equal: bool) -> Row:
    return {
        "scene": name,
        "operation": what,
        "times": len(ms),
        "p50, ms": quantile(ms, 0.5),
        "worst, ms": quantile(ms, 1),
        "times that of integrate": round(float(np.median(ms) / np.median(integrate_ms)), 2),
        "bits of a map that never saw them": "equal" if equal else "NOT EQUAL",
    }


def _times(items: Iterable[int], act: Callable[[int], Any]) -> list[float]:
    found = []
    for i in items:
        with timed() as taken:
            act(i)
        found.append(1e3 * taken.cpu_s)
    return found


def state(live: LiveMap) -> list[bytes]:
    """Bytes of all sums."""
    keys = live._state.sums.block_keys()
    return [array.tobytes() for array in itertools.chain(*live._state.sums.columns(keys))]
