"""The radars of a rig, estimated from the returns of each."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from radarsdf.arrays import Bools, Floats, Ints
from radarsdf.config.fit_config import FitConfig
from radarsdf.products import product
from radarsdf.returns.noise import RigNoise, rig_noise
from radarsdf.returns.planes import Surfels
from radarsdf.returns.rays import Rays
from radarsdf.returns.response import of_views, regression
from radarsdf.returns.sampling import sample
from radarsdf.returns.sensor import Sensor
from radarsdf.rig import Label

Unit = tuple[float, float]
"""Gain and offset of a radar's intensities: gain · intensity of the map + offset."""

_MOST_RETURNS = 60_000  # sample size
_FEWEST_SHARED = 30  # surfels that a radar shares with others, for its offset
# Measured on simulated rigs in dB: the spreads of two radars differ by a factor of 0.70 to 1.15.
_SAME_UNIT = 1.6


@dataclass(frozen=True)
class Radars:
    """K radars whose returns make one map."""

    labels: tuple[Label, ...]  # K
    noise: RigNoise
    units: tuple[Unit | None, ...]
    """(K,) of each, relative to the first that measures intensities. None: it shares no surface with others."""

    @classmethod
    def of(cls, rays: Rays, labels: tuple[Label, ...], config: FitConfig, num_threads: int = 0) -> Radars:
        """Estimate from `rays` of all radars."""
        surfels = Surfels.of(rays, config.leaf_size_m, num_threads)
        noise = rig_noise(surfels, rays, config.returns, num_threads)
        return cls(labels, noise, intensity_units(surfels, rays, num_threads))

    def in_one_unit(self, rays: Rays) -> Rays:
        """Return `rays` with the intensities of all radars in the unit of the first. Without a unit they stay."""
        if rays.intensities is None:
            return rays
        values = rays.intensities.copy()
        for unit, rows in zip(self.units, rays.rows_of_sensors(), strict=True):
            gain, offset = unit or (1.0, 0.0)
            values[rows] = (values[rows] - offset) / gain
        return dataclasses.replace(rays, intensities=values)

    def sensors(self, rays: Rays, poses: ArrayLike) -> dict[Label, Sensor]:
        """Estimate each radar with returns from `rays` in one unit, of scans with poses (F, 4, 4) T_world_sensor, m."""
        found = {}
        each = zip(self.labels, self.noise.of_sensors, self.units, rays.rows_of_sensors(), strict=True)
        for label, noise, unit, rows in each:
            if len(own := rays.select(rows)):
                sensor, (gain, offset) = Sensor.of_rays(own, poses, noise), unit or (1.0, 0.0)
                thresholds = tuple((range_m, gain * low + offset) for range_m, low in sensor.thresholds)
                found[label] = dataclasses.replace(sensor, thresholds=thresholds, unit=(gain, offset))
        return found

    def report(self, rays: Rays) -> dict[str, Any]:
        """Return the number of returns, noise and unit of each radar by its label."""
        found: dict[str, Any] = {}
        each = zip(self.labels, self.noise.of_sensors, self.units, rays.rows_of_sensors(), strict=True)
        for label, noise, unit, rows in each:
            gain, offset = unit or (None, None)
            own = {"returns": len(rays.points[rows]), "noise": dataclasses.asdict(noise)}
            found[str(label)] = own | {"intensity_gain": gain, "intensity_offset": offset}
        return found


def intensity_units(surfels: Surfels, rays: Rays, num_threads: int = 0) -> tuple[Unit | None, ...]:
    """Estimate the intensity unit of each radar from flat surfels that several see.

    Radars see a surfel from other sides and ranges. So differences within surfels are regressed on the response to range,
    elevation and incidence, for each kind of surface, and on the radar (fixed effects of the surfels): materials cancel out.
    """
    units: list[Unit | None] = [None] * rays.num_sensors
    rays = rays.select(np.sort(sample(rays.hashes(), _MOST_RETURNS)))
    planes = surfels.flat_planes_at(rays.points, num_threads)
    usable = np.flatnonzero(rays.with_intensity & (planes >= 0))
    if len(usable) == 0:
        return tuple(units)
    rays, plane = rays.select(usable), planes[usable].astype(np.int64)
    assert rays.intensities is not None
    assert rays.sensor_of_scan is not None
    views = of_views(rays.directions, rays.ranges_m, surfels.normals, plane)
    sensors, values = rays.sensor_of_scan[rays.scans], rays.intensities.astype(np.float64)
    units[int(sensors.min())] = (1.0, 0.0)
    # Surfels with returns at the limits of a radar, which may be clipped: saturated ones have no differences.
    clipped = np.zeros(len(surfels.normals), np.bool_)
    for rows in rays.rows_of_sensors():
        ends = values[rows].min(initial=np.inf), values[rows].max(initial=-np.inf)
        clipped[plane[rows][np.isin(values[rows], ends)]] = True
    while True:
        known = np.array([unit is not None for unit in units])
        by_sensor = np.zeros((len(units), len(surfels.normals)), np.bool_)
        by_sensor[sensors, plane] = ~clipped[plane]
        shared = by_sensor & by_sensor[known].any(axis=0)
        counts = np.where(known, 0, shared.sum(axis=1))
        new = int(np.argmax(counts))
        if counts[new] < _FEWEST_SHARED:
            return tuple(units)
        own = sensors == new
        both = np.flatnonzero(shared[new][plane] & (own | known[sensors]))
        units[new] = gain, offset = _unit(values[both], own[both], plane[both], views[both])
        values[own] = (values[own] - offset) / gain


def _unit(values: Floats, own: Bools, plane: Ints, views: Floats) -> Unit:
    """Estimate gain and offset of a radar's `own` `values` (N,) relative to the others, on the same surfels.

    Speckle is the same for all radars if in dB, so the gain is the ratio of the spreads within surfels; 1 unless clearly not.
    """
    spread, other_spread = (_effects(values[rows], views[rows], plane[rows])[1] for rows in (own, ~own))
    gain = spread / other_spread if min(spread, other_spread) > 0 else 1.0
    gain = gain if abs(np.log(gain)) > np.log(_SAME_UNIT) else 1.0
    values = np.where(own, values / gain, values)
    return gain, gain * float(_effects(values, np.column_stack([views, own]), plane)[0][-1])


def _effects(values: Floats, design: Floats, plane: Ints) -> tuple[Floats, float]:
    """Regress differences of `values` (N,) within surfels on those of `design` (N, K): coefficients (K,), and median residual."""
    counts = np.maximum(np.bincount(plane), 1)
    columns = np.column_stack([design, values])
    within = columns - np.stack([np.bincount(plane, column) / counts for column in columns.T], axis=1)[plane]
    coefficients = regression(within[:, :-1], within[:, -1])
    left = np.abs(within[:, -1] - product(within[:, :-1], coefficients[:, None])[:, 0])
    count = counts[plane]
    left *= np.sqrt(count / np.maximum(count - 1, 1))  # a mean takes a degree of freedom
    return coefficients, float(np.median(left[count > 1])) if (count > 1).any() else 0.0
