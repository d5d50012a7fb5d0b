# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Intensities in closed form: a regression on what the radar equation says, and means in cells of what it leaves."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from radarsdf._core import CellBlocks, CellMeans, cell_keys, cell_rows, fit_cell_means, sum_moments
from radarsdf.returns.cells import MAX_CELLS_FROM_ORIGIN
from radarsdf.returns.rays import Rays
from radarsdf.returns.surfels import LEAVES_PER_SURFEL, Surfels

Float32 = NDArray[np.float32]

# Kinds of cells: edge in leaf cells, step of the direction's components, step of the incidence in rad. Materials differ
# in how the echo falls with the incidence, so cells by incidence are what helps most on simulated scenes, cells by
# direction on real drives. Chosen on `hugin`, `oculii` and `wall` of seeds 1 and 2 and on three drives.
_KINDS = np.array([
    [40, 0, 0], [10, 0, 0], [2, 0, 0],
    [40, 0, 0.07], [16, 0, 0.1], [6, 0, 0.1],
    [12, 0.2, 0], [5, 0.2, 0], [2.5, 0.12, 0],
])  # fmt: skip
_TILINGS = 4  # two have 1 to 2 % more error, eight 0 to 1 % less
_SHRINKAGE = 5.0  # 3 to 10 differ by less than 1 %
_ROUNDS = 2  # four are no better
# Of more returns, those that are close and seen alike are one: means of so many would take too long for a quick fit.
_MOST_RETURNS = 50_000
_GROUPS = np.array([[2.5, 0.25, 0.12]])  # a kind of cells, as above
_CORRELATION = 0.1  # of the returns in a group: n of them count n / (1 + 0.1 (n - 1)) times

_LOBES_RAD = np.radians([3, 6, 12, 25, 50])  # standard deviations of specular lobes
_MIN_COSINE = 0.02
_MOST_REGRESSED = 12_000  # returns, evenly spread: enough for fourteen numbers
_REWEIGHTINGS = 3
_REFERENCE_RANGE_M = 10.0
_ANGLES_RAD = np.linspace(0, np.pi / 2, 2001)  # at which the response to the incidence is tabulated
_BASE = 5  # coefficients that do not belong to the incidence
NUM_COEFFICIENTS = _BASE + 4 + len(_LOBES_RAD)


@dataclass(frozen=True)
class Reflectance:
    """A quantity of the returns of a fit, as a function of place, direction, range and incidence.

    It is their intensity in [0, 1], or what a network leaves of it.
    """

    leaf_size_m: float
    """Edge of a leaf cell, m."""
    coefficients: NDArray[np.float64]
    """(14,) of the regression."""
    plane_keys: NDArray[np.uint64]
    """(P,) Morton keys of the surfels' cells with a plane, ascending."""
    normals: Float32
    """(P, 3) unit normals of these planes, local frame."""
    mean_keys: NDArray[np.uint64]
    """(M,) keys of the cells with means."""
    means: Float32
    """(M,) means in them of what the regression leaves."""
    network_share: float = 0.0
    """The answer of the intensity network counts so many times; the quantity is what that leaves."""

    @cached_property
    def _planes(self) -> CellBlocks:
        return CellBlocks(self.plane_keys)

    @cached_property
    def _cells(self) -> CellMeans:
        """Finds the means. Made by the first query: a fit has no need of it."""
        return CellMeans(_in_metres(_KINDS, self.leaf_size_m), _TILINGS, self.mean_keys, self.means)

    def check(self) -> None:
        """Raises a ValueError if keys are not in order, or shapes do not match."""
        if self.coefficients.shape != (NUM_COEFFICIENTS,) or self.normals.shape != (len(self.plane_keys), 3):
            msg = "the reflectance has arrays of wrong shapes"
            raise ValueError(msg)
        _ = self._planes, self._cells  # which check the keys

    @classmethod
    def of(
        cls,
        rays: Rays,
        unit: Float32,
        surfels: Surfels,
        leaf_size_m: float,
        num_threads: int = 0,
        network_share: float = 0.0,
        cell_of_ray: NDArray[np.int32] | None = None,
    ) -> Reflectance:
        """The reflectance of `rays`.

        Parameters
        ----------
        rays : Rays
            All returns, with ghosts: a sensor sees these again.
        unit : (N,) float32
            Their intensities, scaled to [0, 1]; less `network_share` times what the network answers.
        surfels : Surfels
            Surfels of the same returns, or of more.
        leaf_size_m : float
            Edge of a leaf cell, m.
        num_threads : int
            0: as many as OpenMP uses. The result has the same bits with any number.
        cell_of_ray : (N,) int32, optional
            Row of each return's cell in those of `surfels`. Default: `surfels` are of the same returns.
        """
        flat = np.flatnonzero(surfels.is_flat())
        plane = surfels.flat_plane_of(surfels.cells.cell_of_ray if cell_of_ray is None else cell_of_ray)
        points = np.ascontiguousarray(rays.points)
        directions = np.ascontiguousarray(rays.directions)
        incidence = _incidence(surfels.normals.astype(np.float32), plane, directions)

        some = slice(None, None, -(-len(rays) // _MOST_REGRESSED))
        design = _design(directions[some], rays.ranges_m[some], incidence[some])
        coefficients = _regression(design, unit[some].astype(np.float64))
        left = unit - _response(coefficients, directions, rays.ranges_m, incidence)
        rows, groups = _grouped(points, directions, incidence, left, leaf_size_m, num_threads)
        kinds = _in_metres(_KINDS, leaf_size_m)
        keys, means, explained = fit_cell_means(kinds, _TILINGS, *groups, _SHRINKAGE, _ROUNDS, num_threads)
        # The cells have means, and the error that counts is the absolute one, whose centre is the median.
        coefficients[0] += np.median(left[some] - explained[rows[some]])
        plane_keys = surfels.cells.keys[surfels.cell_of_plane[flat]]
        return cls(
            leaf_size_m,
            coefficients,
            plane_keys,
            surfels.normals[flat].astype(np.float32),
            keys,
            means,
            network_share,
        )

    def at(self, points: Float32, directions: Float32, ranges_m: Float32, num_threads: int = 0) -> Float32:
        """The quantity (N,) at points (N, 3), local frame, m, seen along directions (N, 3), unit vectors."""
        size_m = LEAVES_PER_SURFEL * self.leaf_size_m
        limit_m = MAX_CELLS_FROM_ORIGIN * self.leaf_size_m  # farther points have no key, and no cell
        near = np.ascontiguousarray(np.clip(np.nan_to_num(points), -limit_m, limit_m))
        directions = np.ascontiguousarray(directions)
        rows = self._planes.rows(cell_keys(near, size_m, num_threads), num_threads)
        incidence = _incidence(self.normals, rows, directions)
        response = _response(self.coefficients, directions, ranges_m, incidence)
        response += self._cells.sums(near, directions, incidence, num_threads)
        return response


def _in_metres(kinds: NDArray[np.float64], leaf_size_m: float) -> NDArray[np.float64]:
    return np.ascontiguousarray(kinds * [leaf_size_m, 1, 1], np.float64)


def _incidence(normals: Float32, plane: NDArray[np.int32], directions: Float32) -> Float32:
    """Angles (N,) between the direction and the normal of the plane of each return, rad; NaN without a plane, -1."""
    if len(normals) == 0:
        return np.full(len(plane), np.nan, np.float32)
    cosine = np.abs(np.einsum("ni,ni->n", normals[plane], directions))
    angle: Float32 = np.arccos(np.minimum(cosine, np.float32(1)))
    angle[plane < 0] = np.nan
    return angle


def _of_incidence(angle_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    """Columns (N, 9): 1, the cosine, its square and logarithm, and the lobes."""
    cosine = np.maximum(np.cos(angle_rad), _MIN_COSINE)
    lobes = [np.exp(-0.5 * (angle_rad / width) ** 2) for width in _LOBES_RAD]
    return np.stack([np.ones_like(cosine), cosine, cosine**2, np.log10(cosine), *lobes], axis=-1)


def _of_ray(directions: Float32, ranges_m: Float32) -> list[Float32]:
    """Columns (N,): 1, the logarithm of the range and its square, the elevation's sine and its square."""
    log_range = np.log10(np.maximum(ranges_m, np.float32(1e-6)) / np.float32(_REFERENCE_RANGE_M))
    up = directions[:, 2]
    return [np.ones_like(up), log_range, log_range**2, up, up**2]


def _design(directions: Float32, ranges_m: Float32, incidence_rad: Float32) -> NDArray[np.float64]:
    known = ~np.isnan(incidence_rad)
    of_incidence = _of_incidence(np.where(known, incidence_rad, 0).astype(np.float64)) * known[:, None]
    return np.concatenate(
        [np.stack(_of_ray(directions, ranges_m), axis=1), of_incidence], axis=1, dtype=np.float64
    )


def _response(
    coefficients: NDArray[np.float64], directions: Float32, ranges_m: Float32, incidence_rad: Float32
) -> Float32:
    """What the regression says, (N,)."""
    table = (_of_incidence(_ANGLES_RAD) @ coefficients[_BASE:]).astype(np.float32)
    # The nearest angle of the table: to interpolate would take more time than all else.
    nearest = np.nan_to_num(incidence_rad * np.float32((len(table) - 1) / _ANGLES_RAD[-1])) + np.float32(0.5)
    response: Float32 = table[nearest.astype(np.int32)]
    response[np.isnan(incidence_rad)] = 0
    for coefficient, column in zip(coefficients[:_BASE], _of_ray(directions, ranges_m), strict=True):
        response += np.float32(coefficient) * column
    return response


def _regression(design: NDArray[np.float64], values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Coefficients with the least absolute error, nearly: least squares, in which what is far off counts less."""
    weights = np.ones(len(values))
    ridge = np.eye(design.shape[1]) * (1e-3 * np.sqrt(len(values)) + 1e-6 * float((design**2).sum()))
    for _ in range(_REWEIGHTINGS):
        weighted = design * weights[:, None]
        coefficients: NDArray[np.float64] = np.linalg.solve(design.T @ weighted + ridge, weighted.T @ values)
        error = np.abs(values - design @ coefficients)
        weights = 1 / np.maximum(1, error / max(float(np.median(error)), 1e-9))
    return coefficients


_Groups = tuple[Float32, Float32, Float32, Float32, Float32]


def _grouped(
    points: Float32,
    directions: Float32,
    incidence_rad: Float32,
    values: Float32,
    leaf_size_m: float,
    num_threads: int,
) -> tuple[NDArray[np.int32], _Groups]:
    """Row of each return's group, and points, directions, incidences, values and weights of the groups.

    A group is one return, unless there are many.
    """
    if len(points) <= _MOST_RETURNS:
        alone = np.arange(len(points), dtype=np.int32)
        return alone, (points, directions, incidence_rad, values, np.ones(len(points), np.float32))
    rows, count = cell_rows(_in_metres(_GROUPS, leaf_size_m), points, directions, incidence_rad)
    moments = sum_moments(points, directions, rows, count, num_threads)
    returns = moments[:, 0]

    def mean(sums: NDArray[Any]) -> Float32:
        return np.ascontiguousarray((sums.T / returns).T, np.float32)

    return rows, (
        mean(moments[:, 1:4]),
        mean(moments[:, 10:]),
        mean(np.bincount(rows, incidence_rad, count)),
        mean(np.bincount(rows, values, count)),
        (returns / (1 + _CORRELATION * (returns - 1))).astype(np.float32),
    )
