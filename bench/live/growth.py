# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Time of a mesh after one more scan, on maps of one place and of several, far apart: it should be that of the place."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import Any

import radarsdf
from radarsdf import FitConfig, LiveMap

from bench.rows import quantile
from bench.timing import timed

_PLACES, _FRAMES, _LAST = (1, 6), 100, 4  # so many scans of the last place come one by one
_APART_M = 200.0
# Of the sensor. Estimated, it would change while the map grows, and all with it.
_NOISE = {"range_noise_m": 0.073, "azimuth_noise_rad": 0.0059, "elevation_noise_rad": 0.0093}


def rows(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """A row for each number of places."""
    frames = 12 if options.quick else _FRAMES
    drives = [radarsdf.simulate.hugin(seed=options.seed + k, frames=frames) for k in range(max(_PLACES))]
    for places in _PLACES:
        live = LiveMap(FitConfig(num_threads=options.threads, returns=_NOISE), origin=(0, 0, 0))
        times = []
        # The place of the last scans is the same in all maps.
        for k in reversed(range(places)):
            for i in range(frames):
                pose = drives[k].poses[i].copy()
                pose[0, 3] += _APART_M * k
                live.integrate(drives[k].points[i], pose, drives[k].intensities[i])
                if k == 0 and i >= frames - _LAST - 1:
                    with timed() as taken:
                        mesh = live.mesh()
                    times.append(1e3 * taken.cpu_s)
        yield {
            "scans": len(live),
            "triangles": len(mesh.faces),
            "whole mesh, ms": round(times[0]),
            "after one more scan, ms": quantile(times[1:], 0.5),
        }
