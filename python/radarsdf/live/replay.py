# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Replays recorded scans to a live map as a driver would: in real time, dropping those for which the map is not ready."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from radarsdf.live.tracking import Lost

if TYPE_CHECKING:
    from radarsdf.io.scans import Scans
    from radarsdf.live.live_map import LiveMap


@dataclass
class Replay:
    """Results of a replay."""

    rows: list[int] = field(default_factory=list)  # of the scans that were integrated
    poses: list[NDArray[np.float64]] = field(default_factory=list)  # (4, 4) of each of these
    seconds: list[float] = field(default_factory=list)  # wall time that each of these took
    dropped: list[int] = field(default_factory=list)  # rows of the scans for which the map was not ready
    lost: list[int] = field(default_factory=list)  # rows of the scans without poses that could not be tracked

    @property
    def hertz(self) -> float:
        """Scans a second, by their mean time."""
        return len(self.seconds) / max(sum(self.seconds), 1e-9)


def replay(
    live: LiveMap,
    scans: Scans,
    *,
    with_poses: bool = True,
    rate: float = 1.0,
    on_scan: Callable[[Replay], None] | None = None,
) -> Replay:
    """Integrates scans at `rate` times the recorded speed; 0: as fast as possible.

    A scan waits until the next one arrives, and is then dropped. `on_scan` is called after each; its time does not count as
    that of a scan, but scans do not wait for it.
    """
    done, count = Replay(), len(scans.points)
    times_s = scans.times_s if scans.times_s is not None else 0.1 * np.arange(count)
    due_s = (times_s - times_s[0]) / rate if rate > 0 else np.full(count, -np.inf)
    begin = time.perf_counter()
    for i in range(count):
        now = time.perf_counter() - begin
        if rate > 0 and i + 1 < count and due_s[i + 1] <= now:
            done.dropped.append(i)
            continue
        if due_s[i] > now:
            time.sleep(due_s[i] - now)
        started = time.perf_counter()
        try:
            found = live.integrate(
                scans.points[i],
                scans.poses[i] if with_poses else None,
                None if scans.intensities is None else scans.intensities[i],
                doppler_mps=None if scans.doppler_mps is None else scans.doppler_mps[i],
                time_s=float(times_s[i]),
                scan_id=i,
            )
        except Lost:
            done.lost.append(i)
            continue
        done.seconds.append(time.perf_counter() - started)
        done.rows.append(i)
        done.poses.append(found.pose)
        for k in (k for k, row in enumerate(done.rows) if row in found.moved):
            done.poses[k] = live.pose(done.rows[k])
        if on_scan is not None:
            on_scan(done)
    return done
