# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Errors of the intensities of a growing map at the returns of every fifth scan, which it never had, beside those of fits."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import Any

import numpy as np
import radarsdf
from radarsdf import FitConfig, LiveMap
from radarsdf.evaluation import holdout

from bench.live.accuracy import drive_of

_HELD_OUT_EVERY = 5


def rows(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """A row for each scene. Mean absolute errors where both maps answer."""
    for name in options.cases or ["hugin", "oculii"]:
        drive = drive_of(name, options)
        scans, config = drive.scans, drive.config
        assert scans.intensities is not None
        train, test = holdout(len(scans), _HELD_OUT_EVERY)
        live = LiveMap(config)
        for i in train:
            live.integrate(scans.points[i], scans.poses[i], scans.intensities[i])
        closed = FitConfig(
            num_threads=options.threads, returns=config.returns, networks={"reflectance": "closed-form"}
        )
        maps = {"live": live.map()}
        for what, settings in (("fit", config), ("fit, closed form", closed)):
            maps[what] = radarsdf.fit(
                [scans.points[i] for i in train],
                scans.poses[train],
                [scans.intensities[i] for i in train],
                config=settings,
                origin=live.origin,
                progress=False,
            )
        errors = {what: _errors(found, scans, test, config) for what, found in maps.items()}
        everywhere = np.all([np.isfinite(own) for own in errors.values()], axis=0)
        found = {what: float(own[everywhere].mean()) for what, own in errors.items()}
        yield (
            {"scene": drive.name, "returns": int(everywhere.sum())}
            | {f"{what}, dB": round(value, 3) for what, value in found.items()}
            | {"live less fit": round(found["live"] - found["fit"], 3)}
        )


def _errors(found: radarsdf.Map, scans: Any, test: Any, config: FitConfig) -> np.ndarray:
    """Absolute errors at the returns of some scans that are within range, dB; NaN where the map does not answer."""
    errors = []
    for i in test:
        range_m = np.linalg.norm(scans.points[i], axis=1)
        used = (range_m >= config.returns.min_range_m) & (range_m <= (config.returns.max_range_m or np.inf))
        at = scans.poses[i]
        world = np.einsum("ij,nj->ni", at[:3, :3], scans.points[i][used].astype(np.float64)) + at[:3, 3]
        told = found.intensity(world, np.broadcast_to(at[:3, 3], world.shape))
        errors.append(np.abs(told - scans.intensities[i][used]))
    return np.concatenate(errors)
