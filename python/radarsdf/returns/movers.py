# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Returns of what moves, by their Doppler. They belong to no surface that stays."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from radarsdf.checks import check_values_of_scans, one_for_each_scan, real_array
from radarsdf.config.fit_config import FitConfig
from radarsdf.config.groups import ReturnsConfig
from radarsdf.io.scans import Scans
from radarsdf.returns.doppler import MIN_DOPPLER_RETURNS, sensor_velocities, without_filler
from radarsdf.returns.rays import Rays, check_scans, prepare

_MIN_SHARE_WITH_VELOCITY = 0.5  # of the scans that have enough returns
_MAX_MOVING = 0.4  # share of the returns; if more disagree, it is the Doppler that is not understood


@dataclass(frozen=True)
class Movers:
    """Which returns of F scans move."""

    masks: list[NDArray[np.bool_]]
    """F arrays (N_i,). All False where a scan tells no velocity of the sensor, or a return has no Doppler."""
    why_none: str | None
    """Why none are named although there is Doppler, in words. None: they were looked for in all scans that tell."""

    @classmethod
    def of(cls, points: Sequence[ArrayLike], doppler_mps: Sequence[ArrayLike]) -> Movers:
        """Finds the returns whose Doppler disagrees with a world that stands still.

        Parameters
        ----------
        points : sequence of F arrays
            (N_i, 3) each, sensor frame, m.
        doppler_mps : sequence of F arrays
            (N_i,) each, speed along the ray, m/s, of either sign, folded or not. NaN where it was not measured.

        Raises
        ------
        TypeError, ValueError
            If `doppler_mps` are not numbers, their shapes do not fit to `points`, or a fit refuses these.
        """
        scans, _, _ = check_scans(points)
        speeds, filler = without_filler(scans, checked_doppler(scans, doppler_mps))
        none = [np.zeros(len(scan), bool) for scan in scans]
        tried = [i for i, scan in enumerate(scans) if len(scan) >= MIN_DOPPLER_RETURNS]
        found = sensor_velocities([scans[i] for i in tried], [speeds[i] for i in tried])
        telling = [(i, velocity) for i, velocity in zip(tried, found, strict=True) if velocity.found]
        if len(telling) < max(1, _MIN_SHARE_WITH_VELOCITY * len(tried)):
            return cls(
                none, filler or f"only {len(telling)} of {len(scans)} scans agree on a velocity of the sensor"
            )
        masks = list(none)
        for i, velocity in telling:
            masks[i] = ~velocity.static & np.isfinite(speeds[i]) & scans[i].any(axis=1)
        share = sum(int(masks[i].sum()) for i, _ in telling) / sum(len(masks[i]) for i, _ in telling)
        if share > _MAX_MOVING:
            return cls(none, f"{share:.0%} of the returns disagree with the sensor's own motion")
        return cls(masks, None)

    @property
    def count(self) -> int:
        """Number of returns that move."""
        return sum(int(mask.sum()) for mask in self.masks)

    def without(self, arrays: Sequence[ArrayLike]) -> list[NDArray[Any]]:
        """F arrays (N_i, ...) without the rows of what moves."""
        return [np.asarray(array)[~mask] for array, mask in zip(arrays, self.masks, strict=True)]


@dataclass(frozen=True)
class Standing:
    """The returns of F scans without those that move, as far as Doppler tells them."""

    points: Iterable[ArrayLike]
    """F arrays (N_i, 3), sensor frame, m."""
    intensities: Iterable[ArrayLike] | None
    """F arrays (N_i,), sensor units."""
    movers: int
    """Number of returns that were left out."""
    why_none: str | None
    """As of :class:`Movers`."""

    @classmethod
    def of(
        cls,
        points: Iterable[ArrayLike],
        intensities: Iterable[ArrayLike] | None,
        doppler_mps: Sequence[ArrayLike] | None,
        config: ReturnsConfig,
    ) -> Standing:
        """All returns, if there is no Doppler or ``config.drop_movers`` says so; else see :meth:`Movers.of`."""
        if doppler_mps is None or not config.drop_movers:
            return cls(points, intensities, 0, None)
        points = list(one_for_each_scan(points, "points"))
        intensities = None if intensities is None else list(one_for_each_scan(intensities, "intensities"))
        if intensities is not None:
            check_scans(points, intensities)
        movers = Movers.of(points, doppler_mps)
        values = None if intensities is None else movers.without(intensities)
        return cls(movers.without(points), values, movers.count, movers.why_none)


def checked_doppler(scans: list[NDArray[Any]], doppler_mps: Sequence[ArrayLike]) -> list[NDArray[Any]]:
    """F arrays (N_i,) of numbers. Raises TypeError or ValueError where they are none, or do not fit to the scans."""
    speeds = [
        real_array(values, f"doppler_mps of scan {i}")
        for i, values in enumerate(one_for_each_scan(doppler_mps, "doppler_mps"))
    ]
    check_values_of_scans(speeds, scans, "doppler_mps")
    return speeds


def rays_as_measured(scans: Scans, config: FitConfig) -> Rays:
    """The returns that a fit with this configuration accepts, of a range and of what does not move, each seen from where its scan was taken.

    An intensity that cannot belong to the others of these scans is NaN.
    """
    standing = Standing.of(scans.points, scans.intensities, scans.doppler_mps, config.returns)
    return prepare(
        standing.points,
        scans.poses,
        standing.intensities,
        min_range_m=config.returns.min_range_m,
        max_range_m=config.returns.max_range_m,
    )
