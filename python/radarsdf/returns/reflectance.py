"""Closed-form intensities: a regression on the terms of the radar equation, plus cell means of its residuals."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from radarsdf._core import CellBlocks, CellMeans, cell_keys, cell_rows, fit_cell_means
from radarsdf.arrays import Array, Bools, Floats, Floats32, Ints32, Keys
from radarsdf.checks import check
from radarsdf.returns.planes import LEAVES_PER_SURFEL, Surfels
from radarsdf.returns.rays import Rays
from radarsdf.returns.response import NUM_COEFFICIENTS, NUM_KINDS, TABLE_SHAPE, Response, kinds_of
from radarsdf.returns.sums import MAX_CELLS_FROM_ORIGIN

# Kinds of cells: edge in leaf cells, bin width of the direction's components, bin width of the incidence in rad. Materials
# differ in how the echo decreases with incidence, so cells by incidence help most on simulated scenes, cells by direction
# on real drives. Tuned on `hugin`, `oculii` and `wall` with seeds 1 and 2, on few scans of them, and on three drives.
_KINDS = np.array([
    [40, 0, 0], [6, 0, 0], [2, 0, 0],
    [80, 0, 0.07], [16, 0, 0.1], [6, 0, 0.1],
    [20, 0.2, 0], [5, 0.2, 0],
])  # fmt: skip
_TILINGS = 4  # two have 1 to 2 % more error, eight 0 to 1 % less
_SHRINKAGE = 4.0  # 3 to 10 differ by less than 1 %
_ROUNDS = 2  # four are no better
# More returns are grouped by place and view: a third of the time of cell means, and 0.2 to 0.8 % more error. A network,
# evaluated for each group, takes longer than means and has smaller residuals, so its groups are larger. Kinds of cells, as above.
_MOST_RETURNS = 50_000
_GROUPS, _GROUPS_ASKED = np.array([[1.5, 0.2, 0.1]]), np.array([[2.5, 0.25, 0.12]])
_CORRELATION = 0.1  # intra-group correlation: the effective number of n returns is n / (1 + 0.1 (n - 1))
_LEAST_MEAN = 0.005  # smallest stored mean, share of the intensity range. A third are smaller and useless

# With a network, the prediction averages the network's and `_NETWORK_TIMES` the network's plus its closed-form residual.
# Half of the residual, since the rest is noise of the returns that the network was trained on; and half of the network's
# prediction, since it is no better than the closed form on real drives.
_NETWORK_TIMES = 0.5
_CLOSED_TIMES = 0.5

Ask = Callable[[Floats32, Floats32, Floats32], Floats32]


@dataclass(frozen=True)
class Reflectance:
    """Closed-form intensity as a function of place, direction, range and incidence.

    It predicts the intensity in [0, 1], or the residual of a network.
    """

    leaf_size_m: float  # edge of a leaf cell, m
    coefficients: Floats  # (3, 14), see :class:`~radarsdf.returns.response.Response`
    table: Floats32  # (48, 96) residuals of the first of them by range and elevation
    plane_keys: Keys  # (P,) Morton keys of the surfels' cells with a plane, ascending
    normals: Floats32  # (P, 3) unit normals of these planes, local frame
    mean_keys: Keys  # (M,) keys of the cells with means
    means: NDArray[np.float16]  # (M,) means of the regression's residuals in them
    network_share: float = 0.0  # factor on the intensity network's prediction, to which this is added

    @cached_property
    def _response(self) -> Response:
        return Response(self.coefficients, self.table)

    @cached_property
    def _planes(self) -> CellBlocks:
        return CellBlocks(self.plane_keys)

    @cached_property
    def _cells(self) -> CellMeans:
        """Lookup of the means, built by the first query: a fit does not need it."""
        means = self.means.astype(np.float32)
        return CellMeans(_in_metres(_KINDS, self.leaf_size_m), _TILINGS, self.mean_keys, means)

    def check(self) -> None:
        shapes = self.coefficients.shape, self.table.shape, self.normals.shape
        fits = shapes == ((NUM_KINDS, NUM_COEFFICIENTS), TABLE_SHAPE, (len(self.plane_keys), 3))
        check(fits, "the reflectance has arrays of wrong shapes")
        _ = self._planes, self._cells  # their constructors check the keys

    @classmethod
    def of(
        cls,
        rays: Rays,
        unit: Floats32,
        surfels: Surfels,
        leaf_size_m: float,
        ask: Ask | None = None,
        num_threads: int = 0,
    ) -> Reflectance:
        """Fit the reflectance of `rays`, ghosts included: a sensor sees them again.

        `unit` (N,): their intensities, scaled to [0, 1]. `surfels`: of these returns or a superset. `ask`: predicts intensities
        (M,) of points (M, 3) along directions (M, 3) from ranges (M,) by a network. None without a network.
        """
        flat = np.flatnonzero(surfels.is_flat())
        normals = surfels.normals.astype(np.float32)
        points, directions, ranges_m = rays.in_c_order()
        plane = surfels.flat_planes_at(points, num_threads)
        incidence, kinds = _incidence(normals, plane, directions), kinds_of(normals, plane)
        kind = _in_metres(_GROUPS if ask is None else _GROUPS_ASKED, leaf_size_m)
        groups = _Groups.of(points, directions, incidence, kind)
        times, share = 1.0, 0.0
        if ask is not None:
            unit_vectors = groups.directions / np.linalg.norm(groups.directions, axis=1, keepdims=True)
            answers = ask(groups.points, unit_vectors, groups.means(ranges_m))
            unit = unit - np.float32(_NETWORK_TIMES) * groups.of_returns(answers)
            times, share = _CLOSED_TIMES, 1 - _CLOSED_TIMES * (1 - _NETWORK_TIMES)
        response = Response.of(unit, directions, ranges_m, incidence, kinds)
        left = unit - response.at(directions, ranges_m, incidence, kinds)
        incidence = groups.means(incidence)
        del plane, kinds  # per-return arrays: frees memory
        columns = (groups.points, groups.directions, incidence, groups.means(left), groups.weights)
        options = (_SHRINKAGE, _ROUNDS, _LEAST_MEAN, num_threads)
        keys, means, explained = fit_cell_means(_in_metres(_KINDS, leaf_size_m), _TILINGS, *columns, *options)
        # Cells store means, but the absolute error is to be minimised, so the offset is the median residual.
        coefficients = response.coefficients.copy()
        coefficients[:, 0] += np.median(left - groups.of_returns(explained))
        return cls(
            leaf_size_m,
            times * coefficients,
            np.float32(times) * response.table,
            surfels.keys[surfels.cell_of_plane[flat]],
            normals[flat],
            keys,
            (np.float32(times) * means).astype(np.float16),
            share,
        )

    def measured(self, directions: Floats32, ranges_m: Floats32) -> Bools:
        """See :meth:`~radarsdf.returns.response.Response.measured`."""
        return self._response.measured(directions, ranges_m)

    def at(
        self, points: Floats32, directions: Floats32, ranges_m: Floats32, num_threads: int = 0
    ) -> Floats32:
        """Predict values (N,) at points (N, 3), local frame, m, along directions (N, 3), unit vectors, from ranges (N,), m."""
        size_m = LEAVES_PER_SURFEL * self.leaf_size_m
        limit_m = MAX_CELLS_FROM_ORIGIN * self.leaf_size_m  # farther points have neither key nor cell
        near = np.ascontiguousarray(np.clip(np.nan_to_num(points), -limit_m, limit_m))
        directions = np.ascontiguousarray(directions)
        rows = self._planes.rows(cell_keys(near, size_m, num_threads), num_threads)
        incidence = _incidence(self.normals, rows, directions)
        found = self._response.at(directions, ranges_m, incidence, kinds_of(self.normals, rows))
        found += self._cells.sums(near, directions, incidence, num_threads)
        return found


def _in_metres(kinds: Floats, leaf_size_m: float) -> Floats:
    return np.ascontiguousarray(kinds * [leaf_size_m, 1, 1], np.float64)


def _incidence(normals: Floats32, plane: Ints32, directions: Floats32) -> Floats32:
    """Return the angles (N,) between the direction and the normal of the plane of each return, rad; NaN for plane -1."""
    if len(normals) == 0:
        return np.full(len(plane), np.nan, np.float32)
    cosine = np.abs(np.einsum("ni,ni->n", normals[plane], directions))
    angle: Floats32 = np.arccos(np.minimum(cosine, np.float32(1)))
    angle[plane < 0] = np.nan
    return angle


@dataclass(frozen=True)
class _Groups:
    """Returns grouped by place and view. With few returns, each is its own group."""

    rows: Ints32 | None  # (N,) row of each return's group. None: one group a return
    points: Floats32  # (G, 3) mean point, local frame, m
    directions: Floats32  # (G, 3) mean direction
    counts: Floats  # (G,) number of returns

    @classmethod
    def of(cls, points: Floats32, directions: Floats32, incidence_rad: Floats32, kind: Floats) -> _Groups:
        if len(points) <= _MOST_RETURNS:
            return cls(None, points, directions, np.ones(len(points)))
        rows, count = cell_rows(kind, points, directions, incidence_rad)
        counts = np.bincount(rows, minlength=count).astype(np.float64)
        means = [
            _divided(np.stack([np.bincount(rows, column, count) for column in columns.T], 1), counts)
            for columns in (points, directions)
        ]
        return cls(rows, means[0], means[1], counts)

    @property
    def weights(self) -> Floats32:
        return (self.counts / (1 + _CORRELATION * (self.counts - 1))).astype(np.float32)

    def means(self, values: Floats32) -> Floats32:
        if self.rows is None:
            return np.ascontiguousarray(values)
        return _divided(np.bincount(self.rows, values, len(self.counts)), self.counts)

    def of_returns(self, values: Floats32) -> Floats32:
        return values if self.rows is None else values[self.rows]


def _divided(sums: Array, counts: Floats) -> Floats32:
    return np.ascontiguousarray((sums.T / counts).T, np.float32)
