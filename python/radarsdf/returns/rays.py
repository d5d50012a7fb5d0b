# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Checks radar scans and turns them into rays in one local frame, as a fit needs them."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Iterable, Iterator, Sized
from dataclasses import dataclass
from itertools import zip_longest
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from radarsdf.checks import (
    MAX_POSITION_M,
    check_equal_numbers,
    check_scan_shape,
    check_scan_shapes,
    check_values_of_scan,
    one_for_each_scan,
    pose_matrices,
    real_array,
    usable_poses,
)
from radarsdf.checks import positions as check_positions
from radarsdf.lattice import WorldLattice
from radarsdf.products import turned
from radarsdf.returns.intensities import Plausible

_LOG = logging.getLogger("radarsdf.returns")
_PADDING = 8  # rows that repeat the one before. Sensors with coarse cells repeat some
_MISSING: Any = object()  # where there are fewer scans of one kind


@dataclass(frozen=True)
class Rays:
    """All returns of a fit, in the local frame: world axes, with `origin` subtracted.

    float32 resolves 0.06 mm at 500 m, but only 0.5 m at UTM coordinates. That is why there is a local frame.
    """

    origin: NDArray[np.float64]
    """(3,) origin of the local frame in world coordinates, m: by default the mean sensor position."""
    points: NDArray[np.float32]
    """(N, 3) returns, m."""
    directions: NDArray[np.float32]
    """(N, 3) unit vectors from the sensor to the return."""
    ranges_m: NDArray[np.float32]
    """(N,) distance of the return from the sensor."""
    intensities: NDArray[np.float32] | None
    """(N,) sensor units; NaN where it cannot belong to the others. None if there are no intensities."""
    scans: NDArray[np.int32]
    """(N,) scan of each return."""
    up_of_scan: NDArray[np.float64]
    """(F, 3) z axis of the sensor in each scan, local frame."""
    num_given: int
    """Number of returns that the scans hold, with those out of range."""

    def __len__(self) -> int:
        return len(self.points)

    @property
    def with_intensity(self) -> NDArray[np.bool_]:
        """Mask (N,) of the returns whose intensity is known and can belong to the others."""
        if self.intensities is None:
            return np.zeros(len(self), np.bool_)
        return ~np.isnan(self.intensities)

    def select(self, part: slice | NDArray[np.bool_] | NDArray[np.int64]) -> Rays:
        """The rays of a slice, a mask (N,) bool, or row numbers (M,), in that order."""
        rows = part
        if isinstance(part, np.ndarray) and part.dtype == np.bool_:
            rows = np.flatnonzero(part)

        def chosen(array: NDArray[Any]) -> NDArray[Any]:
            # `take` with row numbers needs a third of the time of an index or a mask.
            return array[rows] if isinstance(rows, slice) else array.take(rows, axis=0)

        return dataclasses.replace(
            self,
            points=chosen(self.points),
            directions=np.ascontiguousarray(chosen(self.directions)),
            ranges_m=np.ascontiguousarray(chosen(self.ranges_m)),
            intensities=None if self.intensities is None else chosen(self.intensities),
            scans=np.ascontiguousarray(chosen(self.scans)),
        )

    def in_c_order(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """`points`, `directions` and `ranges_m` as the core takes them."""
        points, directions, ranges_m = map(
            np.ascontiguousarray, (self.points, self.directions, self.ranges_m)
        )
        return points, directions, ranges_m

    def in_world(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Returns, and for each the sensor position it was seen from: (N, 3) and (N, 3) float64, world, m."""
        points = self.points.astype(np.float64) + self.origin
        return points, points - self.directions.astype(np.float64) * self.ranges_m[:, None]


def measured(scan: NDArray[Any]) -> NDArray[np.bool_]:
    """Mask (N,) of the rows of a scan (N, 3) that are returns: finite, not at the sensor itself, and no padding."""
    returns: NDArray[np.bool_] = (np.abs(scan) <= MAX_POSITION_M).all(axis=1) & scan.any(axis=1)
    # Drivers fill a cloud of fixed size with one point: a row that is repeated at once, many times, among others.
    again = scan[1:, 0] == scan[:-1, 0]
    if np.count_nonzero(again) >= _PADDING:
        again &= (scan[1:] == scan[:-1]).all(axis=1)
        points, counts = np.unique(scan[1:][again], axis=0, return_counts=True)
        if np.count_nonzero(counts >= _PADDING) == 1:
            others = returns & (scan != points[np.argmax(counts)]).any(axis=1)
            returns = others if others.any() else returns
    return returns


@dataclass
class LeftOut:
    """What of the scans cannot be used."""

    given: int = 0
    """Number of rows."""
    rows: int = 0
    """Number of rows that are no returns: see :func:`measured`."""
    empty: list[int] = dataclasses.field(default_factory=list)
    """Scans without returns."""
    poses: list[int] = dataclasses.field(default_factory=list)
    """Scans whose pose is not a rigid transform."""

    @property
    def notes(self) -> list[str]:
        """A sentence if anything is left out."""
        parts = []
        if self.rows:
            parts.append(f"{self.rows} of {self.given} returns (not finite, at the sensor, or padding)")
        for scans, what in (
            (self.empty, "without returns"),
            (self.poses, "whose pose is not a rigid transform"),
        ):
            if scans:
                parts.append(f"{len(scans)} scans {what} (the first is scan {scans[0]})")
        return [f"Left out: {', '.join(parts)}."] if parts else []


def check_scans(
    points: Iterable[ArrayLike], intensities: Iterable[ArrayLike] | None = None
) -> tuple[list[NDArray[np.float64]], list[NDArray[np.float32]] | None, LeftOut]:
    """Scans (N_i, 3) and intensities (N_i,) as arrays, if :func:`prepare` takes them; else its ValueError.

    Rows that are no returns become 0 0 0, and intensities that are not finite NaN: arrays of a scan keep their length.
    """
    left_out = LeftOut()
    checked = list(_checked(points, intensities, left_out))
    values = None if intensities is None else [value for _, value in checked if value is not None]
    return [scan for scan, _ in checked], values, left_out


def _checked(
    points: Iterable[ArrayLike], intensities: Iterable[ArrayLike] | None, left_out: LeftOut
) -> Iterator[tuple[NDArray[np.float64], NDArray[np.float32] | None]]:
    """:func:`check_scans`, one scan after another: only one is in float64 at a time."""
    num_scans = num_values = 0
    both = zip_longest(
        points,
        () if intensities is None else one_for_each_scan(intensities, "intensities"),
        fillvalue=_MISSING,
    )
    for i, (given, given_values) in enumerate(both):
        num_scans += given is not _MISSING
        num_values += given_values is not _MISSING
        if intensities is not None and num_scans != num_values:
            continue  # they are only counted
        scan = real_array(given, f"scan {i}")
        check_scan_shape(scan, i)
        values = None
        if intensities is not None:
            values = real_array(given_values, f"intensities of scan {i}", np.float32)
            check_values_of_scan(values, scan, "intensities", i)
            if not np.isfinite(values).all():
                values = np.where(np.isfinite(values), values, np.float32(np.nan))
        returns = measured(scan)
        num_rows = len(scan) - int(np.count_nonzero(returns))
        if num_rows:
            scan = np.where(returns[:, None], scan, 0.0)
        left_out.given += len(scan)
        left_out.rows += num_rows
        if num_rows == len(scan):
            left_out.empty.append(i)
        yield scan, values
    if num_scans == 0:
        check_scan_shapes([])
    if intensities is not None:
        check_equal_numbers(num_values, num_scans, "intensities")


def _lengths(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Lengths (N,) of vectors (N, 3). The same bits as np.linalg.norm in a fifth of the time."""
    x, y, z = vectors.T
    lengths: NDArray[np.float64] = np.sqrt(x * x + y * y + z * z)
    return lengths


def middle_scan(scan: int, scans: int, accumulate_scans: int) -> int:
    """The scan from whose position the returns of a `scan` count as seen, of so many `scans`."""
    first = scan - scan % accumulate_scans
    return (first + min(first + accumulate_scans, scans) - 1) // 2


def within_ranges(
    scan: NDArray[np.float64], min_range_m: float, max_range_m: float | None
) -> NDArray[np.bool_]:
    """Mask (N,) of the returns of a scan (N, 3) within the ranges."""
    ranges = _lengths(scan)
    keep = (ranges > 0) & (ranges >= min_range_m)  # a return at the sensor itself has no direction
    return keep if max_range_m is None else keep & (ranges <= max_range_m)


def prepare(
    points: Iterable[ArrayLike],
    poses: ArrayLike,
    intensities: Iterable[ArrayLike] | None = None,
    *,
    min_range_m: float = 0.0,
    max_range_m: float | None = None,
    accumulate_scans: int = 1,
    origin: ArrayLike | None = None,
    lattice: WorldLattice | None = None,
    whole: bool = True,
) -> Rays:
    """Checks scans and turns them into rays in the local frame.

    Parameters
    ----------
    points : iterable of F arrays
        (N_i, 3) each, sensor frame, m. Each is needed only once, while it is its turn.
    poses : array_like
        (F, 4, 4) T_world_sensor, m.
    intensities : iterable of F arrays, optional
        (N_i,) each, sensor units. Those that are not finite become NaN.
    min_range_m, max_range_m, accumulate_scans
        See :class:`~radarsdf.config.groups.ReturnsConfig`.
    origin : array_like, optional
        (3,) origin of the local frame, world, m. By default the mean sensor position, moved to the next corner of a block
        of the `lattice` if there is one, so that different scans share their cells.
    whole : bool
        False: these are a part of the scans, of which none need be within the ranges. Of whole scans, intensities that are
        outliers become NaN.

    Returns
    -------
    Rays
        The returns that are kept, scan by scan. Rows that are no returns (not finite, 0 0 0, padding), and scans whose pose
        is not rigid, are left out, and counted in a warning of the logger ``radarsdf.returns``.

    Raises
    ------
    ValueError
        If lengths or shapes do not match, half of the poses or more are not rigid, all intensities are equal or are too
        far apart for float32, or no return is within the ranges.
    """
    # Of an iterator, the number of scans is known only in the end.
    points = one_for_each_scan(points, "points")
    num_scans = len(points) if isinstance(points, Sized) else len(np.atleast_1d(real_array(poses, "poses")))
    if num_scans == 0:
        check_scan_shapes([])
    T_world_sensor, rigid = usable_poses(poses, num_scans)
    positions = T_world_sensor[:, :3, 3]
    if origin is not None:
        local_origin = check_positions(real_array(origin, "origin")[None], "origin")[0]
    else:
        local_origin = positions.mean(axis=0)
        if lattice is not None:
            local_origin = lattice.position(lattice.nearest_block(local_origin))
    kept: list[list[Any]] = [[], [], [], []]
    number_of_scan, left_out = 0, LeftOut(poses=np.flatnonzero(~rigid).tolist())
    for i, (scan, of_scan) in enumerate(_checked(points, intensities, left_out)):
        number_of_scan = i + 1
        if number_of_scan > num_scans:
            continue  # it is only counted
        seen_from = positions[middle_scan(i, num_scans, accumulate_scans)]
        keep = within_ranges(scan, min_range_m, max_range_m) & rigid[i]
        values = None if of_scan is None else of_scan[keep]
        local = turned(scan if keep.all() else scan[keep], T_world_sensor[i, :3, :3])
        local += positions[i] - local_origin
        polar = _directions_and_ranges(local - (seen_from - local_origin))
        for column, part in zip(kept, (local.astype(np.float32), *polar, values), strict=True):
            if part is not None:
                column.append(part)
    pose_matrices(poses, number_of_scan)
    counts = [len(part) for part in kept[0]]
    if sum(counts) == 0 and whole:
        msg = f"none of {left_out.given} returns lies between {min_range_m} m and {np.inf if max_range_m is None else max_range_m} m"
        raise ValueError("; ".join([msg, *left_out.notes]))
    for note in left_out.notes if whole else ():
        _LOG.warning(note)
    intensity = None if intensities is None else _joined(kept[3])
    if intensity is not None and whole:
        intensity = Plausible.of(intensity).kept(intensity)
        if np.isnan(intensity).all():
            msg = "no intensity is finite: leave them out if the sensor does not measure them"
            raise ValueError(msg)
        check_range(float(np.nanmin(intensity)), float(np.nanmax(intensity)))
    return Rays(
        origin=local_origin,
        points=_joined(kept[0]),
        directions=_joined(kept[1]),
        ranges_m=_joined(kept[2]),
        intensities=intensity,
        scans=np.repeat(np.arange(num_scans, dtype=np.int32), counts),
        up_of_scan=T_world_sensor[:, :3, 2].copy(),
        num_given=left_out.given,
    )


def check_range(low: float, high: float) -> None:
    """Raises a ValueError if intensities from `low` to `high`, sensor units, are all equal or too far apart for float32."""
    if low == high:
        msg = f"all intensities are {low}: leave them out if the sensor does not measure them"
        raise ValueError(msg)
    if high - low > float(np.finfo(np.float32).max):
        msg = f"intensities from {low} to {high} are too far apart for float32"
        raise ValueError(msg)


def rays_from(
    points: NDArray[Any],
    sensors: NDArray[np.float64],
    *,
    origin: NDArray[np.float64],
    intensities: NDArray[np.float32] | None,
    scans: NDArray[np.int32],
    up_of_scan: NDArray[np.float64],
) -> Rays:
    """Rays from `sensors` to `points`, (N, 3) each, local frame, m. The rest is as of :class:`Rays`."""
    directions, ranges_m = _directions_and_ranges(points - sensors)
    return Rays(
        origin=origin,
        points=points.astype(np.float32, copy=False),
        directions=directions,
        ranges_m=ranges_m,
        intensities=intensities,
        scans=scans,
        up_of_scan=up_of_scan,
        num_given=len(points),
    )


def _directions_and_ranges(rays: NDArray[np.float64]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Unit vectors (N, 3) and lengths (N,) of rays (N, 3), m."""
    ranges = np.maximum(_lengths(rays), 1e-6)
    return (rays / ranges[:, None]).astype(np.float32), ranges.astype(np.float32)


def _joined(parts: list[NDArray[np.float32]]) -> NDArray[np.float32]:
    """One array of all, which are forgotten: only one column of the rays needs memory twice."""
    whole = np.concatenate(parts)
    parts.clear()
    return whole
