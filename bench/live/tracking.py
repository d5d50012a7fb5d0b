# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Time in which `odometry` places a scan of 2,000 returns on those before it."""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Iterator
from typing import Any
from unittest import mock

import numpy as np
import radarsdf
from radarsdf import FitConfig
from radarsdf.poses import drive
from radarsdf.poses.motion import ExpectedStep
from radarsdf.poses.rigid import Floats
from radarsdf.poses.tracking import Tracked, Tracker
from radarsdf.simulate import measured_motion
from radarsdf.simulate.worlds import HUGIN_A3, OCULII_EAGLE

from bench.rows import quantile
from bench.timing import timed

_RETURNS = 2000  # of a scan
_SCANS = 120  # of a drive
_QUICK_SCANS = 12  # of its beginning: of so few along all of it, no two would see the same
_SENSORS = {"hugin": HUGIN_A3, "oculii": OCULII_EAGLE}


def rows(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """A row for each scene, without Doppler and with it."""
    for name in options.cases or _SENSORS:
        scans = radarsdf.simulate.SCENES[name](seed=options.seed, frames=_SCANS)
        more = _RETURNS / float(np.median([len(scan) for scan in scans.points]))
        sensor = _SENSORS[name]
        sensor = dataclasses.replace(sensor, beams=round(more * sensor.beams))
        poses = scans.poses[: _QUICK_SCANS if options.quick else _SCANS]
        scans = radarsdf.simulate.simulate(scans.scene, sensor, poses, name=name, seed=options.seed)
        motion = measured_motion(scans, seed=options.seed)
        for given, doppler in (("returns", None), ("returns and Doppler", motion.doppler_mps)):
            took: list[tuple[float, float]] = []

            class Timed(Tracker):
                """Keeps what each scan takes, by the processor and by the clock, ms."""

                def follow(self, scan: Floats, expected: ExpectedStep | None, took: Any = took) -> Tracked:
                    with timed() as taken:
                        found = super().follow(scan, expected)
                    took.append((taken.cpu_s, taken.wall_s))
                    return found

            with mock.patch.object(drive, "Tracker", Timed):
                radarsdf.odometry(
                    scans.points,
                    doppler_mps=doppler,
                    times_s=motion.times_s,
                    config=FitConfig(num_threads=options.threads),
                )
            cpu_ms, wall_ms = 1e3 * np.array(took).T
            yield {
                "scene": name,
                "returns a scan": int(np.median([len(scan) for scan in scans.points])),
                "tracked by": given,
                "p50, ms": quantile(cpu_ms, 0.5),
                "p99": quantile(cpu_ms, 0.99),
                "worst": quantile(cpu_ms, 1),
                "p50 by the clock": quantile(wall_ms, 0.5),
                "p99 by the clock": quantile(wall_ms, 0.99),
                "worst by the clock": quantile(wall_ms, 1),
            }
