# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""One scan of a map that grows: checked, and turned into rays."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from radarsdf.checks import MAX_TIME_S, check_values_of_scan, number, real_array
from radarsdf.config.fit_config import FitConfig
from radarsdf.config.groups import ReturnsConfig
from radarsdf.live.scan_log import LoggedScan, ScanId, compact
from radarsdf.returns.intensities import Plausible
from radarsdf.returns.moving import Movers
from radarsdf.returns.rays import Rays, check_scans, prepare


@dataclass(frozen=True)
class Integrated:
    """What became of a scan."""

    scan_id: ScanId
    """That it can be moved and taken out by."""
    pose: NDArray[np.float64]
    """(4, 4) T_world_sensor, m: where it was put."""
    blocks: NDArray[np.uint64]
    """(B,) keys of the blocks of 8 × 8 × 8 leaf cells whose returns changed, ascending."""
    movers: int
    """Number of its returns that were left out, because they move."""
    moved: tuple[ScanId, ...] = ()
    """Scans without poses that came before and were placed again, since only now it is clear how the sensor moves. Where they
    are, :meth:`LiveMap.pose` says."""


def checked_scan(
    points: ArrayLike,
    intensities: ArrayLike | None,
    doppler_mps: ArrayLike | None,
    config: ReturnsConfig,
) -> LoggedScan:
    """A scan (N, 3) with what was measured of its returns (N,). Raises a ValueError if it is none. Its pose is not known yet."""
    scans, values, _ = check_scans([points], None if intensities is None else [intensities])
    scan = scans[0].copy()
    speeds, standing = None, None
    if doppler_mps is not None:
        speeds = compact(real_array(doppler_mps, "doppler_mps"))
        check_values_of_scan(speeds, scan, "doppler_mps", 0)
        if config.drop_movers:
            moving = Movers.of([scan], [speeds]).masks[0]
            standing = ~moving if moving.any() else None
    return LoggedScan(
        np.eye(4),
        compact(scan),
        None if values is None else values[0].copy(),
        speeds,
        standing,
    )


def finite_time(time_s: float) -> float:
    """When a scan was taken, s. Raises a ValueError if it is no time."""
    found = number(time_s, "time_s")
    if not abs(found) <= MAX_TIME_S:
        msg = f"time_s must be finite and within {MAX_TIME_S:g} s, not {found:g}"
        raise ValueError(msg)
    return found


def rays_of(scan: LoggedScan, config: FitConfig, origin: NDArray[np.float64] | None) -> Rays:
    """The rays of the returns that stand still. They depend on the scan, its pose and the settings alone."""
    chosen = slice(None) if scan.standing is None else scan.standing
    return prepare(
        [scan.points[chosen]],
        scan.pose[None],
        None if scan.intensities is None else [scan.intensities[chosen]],
        origin=origin,
        whole=False,
        **config.preparation,
    )


def joined(scans: Sequence[LoggedScan], config: FitConfig, origin: NDArray[np.float64] | None) -> Rays:
    """The rays of all scans, scan by scan."""
    parts = [
        dataclasses.replace(rays, scans=rays.scans + np.int32(i))
        for i, rays in enumerate(rays_of(scan, config, origin) for scan in scans)
    ]
    columns: dict[str, NDArray[Any]] = {
        name: np.concatenate([getattr(rays, name) for rays in parts])
        for name in ("points", "directions", "ranges_m", "scans", "up_of_scan")
    }
    intensities = None
    if parts[0].intensities is not None:
        intensities = np.concatenate([rays.intensities for rays in parts if rays.intensities is not None])
        intensities = Plausible.of(intensities).kept(intensities)
    num_given = sum(rays.num_given for rays in parts)
    return dataclasses.replace(parts[0], **columns, intensities=intensities, num_given=num_given)
