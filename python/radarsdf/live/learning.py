# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What a map that grows learns from its scans, by the steps of a fit."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from radarsdf.config.fit_config import FitConfig
from radarsdf.fitting.fit import fit
from radarsdf.fitting.steps import FitInput, fit_rays
from radarsdf.live.scan_log import LoggedScan, ScanLog
from radarsdf.live.scans import joined
from radarsdf.map.radar_map import RadarMap
from radarsdf.returns.evidence import Looks
from radarsdf.returns.intensities import IntensityScale
from radarsdf.returns.noise import SensorNoise, sensor_noise
from radarsdf.returns.planes import Surfels
from radarsdf.returns.sums import ScanSums

_NO_SCANS = "there are no scans to learn from: integrate some first"
_RETURNS_ASKED = 100_000  # for the noise: as many as those on flat surfels that are wanted, and more


def quick_of(config: FitConfig) -> FitConfig:
    """The quick settings with the same cells, returns, bridges, seed and limits."""
    return FitConfig.quick(
        leaf_size_m=config.leaf_size_m,
        seed=config.seed,
        num_threads=config.num_threads,
        max_memory_bytes=config.max_memory_bytes,
        returns=config.returns,
        encoding={"bridge_cells": config.encoding.bridge_cells},
    )


def known_now(
    scans: Sequence[LoggedScan],
    sums: ScanSums,
    looks: Looks,
    config: FitConfig,
    origin: NDArray[np.float64] | None,
) -> RadarMap:
    """The fit of scans whose sums and looks were kept up."""
    if not scans:
        raise ValueError(_NO_SCANS)
    rays = joined(scans, config, origin)
    poses = np.stack([scan.pose for scan in scans])
    movers = sum(int((~scan.standing).sum()) for scan in scans if scan.standing is not None)
    given = FitInput(rays, IntensityScale.of(rays.intensities), poses, movers, sums=sums, looks=looks)
    return fit_rays(lambda: given, config, progress=False)


def finished(
    scans: Sequence[LoggedScan],
    config: FitConfig,
    origin: NDArray[np.float64] | None,
    progress: bool | None,
) -> RadarMap:
    """The fit of all scans, as if they had been given at once."""
    if not scans:
        raise ValueError(_NO_SCANS)
    intensities = [scan.intensities for scan in scans if scan.intensities is not None]
    speeds = [scan.doppler_mps for scan in scans if scan.doppler_mps is not None]
    return fit(
        [scan.points for scan in scans],
        np.stack([scan.pose for scan in scans]),
        intensities or None,
        doppler_mps=speeds if len(speeds) == len(scans) else None,
        config=config,
        progress=progress,
        origin=origin,
    )


def noise_of(
    log: ScanLog,
    sums: ScanSums,
    config: FitConfig,
    origin: NDArray[np.float64] | None,
    num_threads: int,
) -> SensorNoise | None:
    """The noise of the sensor, from the returns of some scans on the planes of all. None: there are no scans."""
    surfels = Surfels.of_sums(sums, num_threads)
    returns = int(sums.counts.sum())
    scans = list(log.scans(every=max(1, returns // _RETURNS_ASKED)))
    if not scans:
        return None
    return sensor_noise(surfels, joined(scans, config, origin), config.returns, num_threads)
