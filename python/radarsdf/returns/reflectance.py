"""Closed-form intensities: a regression on the terms of the radar equation, plus cell means of its residuals.

The regression is robust, on range, elevation and incidence, independent of the place.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from radarsdf.arrays import AnyFloats, Bools, Floats, Floats32, Ints, Ints32, Keys, NDArray
from radarsdf.checks import check
from radarsdf.core import CellBlocks, CellMeans, cell_keys, cell_rows, fit_cell_means
from radarsdf.products import normal_matrix, product
from radarsdf.returns.planes import LEAVES_PER_SURFEL, Surfels
from radarsdf.returns.rays import Rays
from radarsdf.returns.sums import MAX_CELLS_FROM_ORIGIN

# A return lies on no known surface, on a level one or on a steep one. The ground is of another material than walls and
# its echoes are weak at grazing angles: separate regressions reduce the error of the regression by up to 9 %. A place
# without a plane may be unobserved, so its regression is over all returns. One over the returns without a plane would
# treat each as clutter.
NO_SURFACE, LEVEL, STEEP = 0, 1, 2
NUM_KINDS = 3
_LEVEL_COSINE = 0.7  # minimum |z| of the normal of a level surface; 0.5 to 0.7 differ by less than 1 %
_FEWEST = 50  # minimum number of sampled returns of a kind for a regression of its own

_LOBES_RAD = np.radians([3, 6, 12, 25, 50])  # standard deviations of specular lobes
_MIN_COSINE = 0.02
_MOST_REGRESSED = 8_000  # size of the evenly spaced sample of returns: enough for fourteen coefficients
_REWEIGHTINGS = 2  # three are no better
_REFERENCE_RANGE_M = 10.0
_ROWS_AT_ONCE = 1 << 18  # chunk size: all columns at once would take 80 bytes a return
_ANGLES_RAD = np.linspace(0, np.pi / 2, 2001)  # grid of the tabulated response to the incidence
_BASE = 5  # number of coefficients that do not depend on the incidence
NUM_COEFFICIENTS = _BASE + 4 + len(_LOBES_RAD)

# Residuals of the regression over all returns, by range and elevation, which separate the ground from objects on it: bin
# means, smoothed with Gaussian kernels from wide to narrow.
TABLE_SHAPE = (48, 96)
_LOG_RANGES = (np.log10(0.5), np.log10(200.0))  # of the table, m
# Standard deviations in log10(range) and sine of elevation.
_KERNELS = ((0.22, 0.083), (0.11, 0.042), (0.055, 0.021))
_TABLE_SHRINKAGE = 1.0  # 0.5 to 2 differ by up to 2 %
RANGE_MARGIN = 10 ** _KERNELS[0][0]
"""Factor of the range over which residuals are averaged: views farther from all returns are unmeasured."""
# Added to a residual, far smaller, whose range and elevation are unmeasured. The precision left is 1e-5.
_UNMEASURED = -64.0
_HALF = -32.0  # after the halving for a network


class Views(NamedTuple):
    """N views of surfaces, by unit vectors from the sensor."""

    directions: Floats32  # (N, 3)
    ranges_m: Floats32  # (N,)
    incidence_rad: Floats32  # (N,)
    kinds: NDArray[np.int8]  # (N,) of surface


@np.errstate(under="ignore")  # lobes and kernels underflow far from their centre
def fit_response(values: Floats32, views: Views) -> tuple[Floats, Floats32]:
    """Fit `coefficients` and `table` of a :class:`Reflectance` to `values` (N,) of returns."""
    directions, ranges_m, incidence_rad, kinds = views
    some = slice(None, None, -(-len(values) // _MOST_REGRESSED))
    chosen, y = kinds[some], values[some].astype(np.float64)
    rays = _of_ray(directions[some], ranges_m[some]).astype(np.float64)
    coefficients = np.zeros((NUM_KINDS, NUM_COEFFICIENTS))
    coefficients[:, :_BASE] = regression(rays, y)
    left = y - product(rays, coefficients[NO_SURFACE, :_BASE, None])[:, 0]
    table = _smooth_means(_bins(rays[:, 1], rays[:, 3]), left)
    table[_far_from_returns(directions, ranges_m)] += _UNMEASURED
    for kind in (LEVEL, STEEP):
        own = chosen == kind
        if np.count_nonzero(own) >= _FEWEST:
            of_incidence = _of_incidence(incidence_rad[some][own].astype(np.float64))
            # Both have a column of ones: the ridge makes the system regular.
            coefficients[kind] = regression(np.concatenate([rays[own], of_incidence], axis=1), y[own])
    return coefficients, table.astype(np.float32)


@np.errstate(under="ignore")
def response(coefficients: Floats, table: Floats32, views: Views) -> Floats32:
    directions, ranges_m, incidence_rad, kinds = views
    of_angles = _of_incidence(_ANGLES_RAD).T.astype(np.float32)
    by_angle = [_weighted_sum(of_kind[_BASE:], of_angles) for of_kind in coefficients]
    found = np.empty(len(kinds), np.float32)
    for first in range(0, len(kinds), _ROWS_AT_ONCE):
        for kind in range(NUM_KINDS):
            own = first + np.flatnonzero(kinds[first : first + _ROWS_AT_ONCE] == kind)
            columns = _of_ray(directions[own], ranges_m[own])
            values = _weighted_sum(coefficients[kind, :_BASE], columns.T)
            if kind == NO_SURFACE:
                residuals = table.ravel()[_bins(columns[:, 1], columns[:, 3])]
                values += residuals - _HALF * np.rint(residuals / _HALF)
            else:
                # Nearest tabulated angle: interpolation would dominate the time.
                nearest = incidence_rad[own] * np.float32((len(_ANGLES_RAD) - 1) / _ANGLES_RAD[-1])
                values += by_angle[kind][np.nan_to_num(nearest + np.float32(0.5)).astype(np.int32)]
            found[own] = values
    return found


def kinds_of(normals: Floats32, plane: Ints | Ints32) -> NDArray[np.int8]:
    """Return the kind of surface (N,) of each return from the row `plane` (N,) of its normal in `normals` (P, 3); -1: none."""
    # The last entry serves row -1.
    of_plane = np.full(len(normals) + 1, NO_SURFACE, np.int8)
    of_plane[:-1] = np.where(np.abs(normals[:, 2]) > _LEVEL_COSINE, LEVEL, STEEP)
    return of_plane[plane]


def _weighted_sum(weights: Floats, columns: Floats32) -> Floats32:
    """Sum `columns` (K, N) to (N,). Not a matrix product, whose rounding depends on N and the number of threads."""
    found = np.zeros(columns.shape[1], np.float32)
    with np.errstate(invalid="ignore", over="ignore"):  # the result of a non-finite query is non-finite
        for weight, column in zip(weights.astype(np.float32), columns, strict=True):
            found += weight * column
    return found


def _of_incidence(angle_rad: Floats) -> Floats:
    """Return columns (N, 9): 1, the cosine, its square and logarithm, and the lobes."""
    cosine = np.maximum(np.cos(angle_rad), _MIN_COSINE)
    lobes = [np.exp(-0.5 * (angle_rad / width) ** 2) for width in _LOBES_RAD]
    return np.stack([np.ones_like(cosine), cosine, cosine**2, np.log10(cosine), *lobes], axis=-1)


def _of_ray(directions: Floats32, ranges_m: Floats32) -> Floats32:
    """Return columns (N, 5): 1, the logarithm of the range and its square, the sine of the elevation and its square."""
    log_range, up = _log_range(ranges_m), directions[:, 2]
    return np.stack([np.ones_like(up), log_range, log_range**2, up, up**2], axis=1)


def _log_range(ranges_m: Floats32) -> Floats32:
    return np.log10(np.maximum(ranges_m, np.float32(1e-6)) / np.float32(_REFERENCE_RANGE_M))


def of_views(directions: Floats32, ranges_m: Floats32, normals: Floats, plane: Ints) -> Floats:
    """Return columns (N, 24): those of a regression on range, elevation and incidence on planes (N,) of each kind of surface."""
    incidence = np.arccos(np.minimum(np.abs(np.einsum("ni,ni->n", normals[plane], directions)), 1.0))
    of_view = np.concatenate([_of_ray(directions, ranges_m)[:, 1:], _of_incidence(incidence)[:, 1:]], axis=1)
    kinds = kinds_of(normals.astype(np.float32), plane)[:, None]
    return np.concatenate([np.where(kinds == kind, of_view, 0.0) for kind in (LEVEL, STEEP)], axis=1)


def _bins(log_range: AnyFloats, up: AnyFloats) -> Ints32:
    """Return the bin (N,) of the table for each log10(range / 10 m) and sine of the elevation."""
    rows, columns = TABLE_SHAPE
    low, high = np.array(_LOG_RANGES) - np.log10(_REFERENCE_RANGE_M)
    row = np.clip((log_range - low) * (rows / (high - low)), 0, rows - 1)
    column = np.clip((up + 1) * (columns / 2), 0, columns - 1)
    # NaN has no bin: any will do, since the prediction is NaN whatever the table holds.
    row, column = (np.nan_to_num(place).astype(np.int32) for place in (row, column))
    return row * np.int32(columns) + column


def regression(design: Floats, values: Floats) -> Floats:
    """Fit coefficients by iteratively reweighted least squares, approximately minimising the absolute error."""
    weights = np.ones(len(values))
    ridge = np.eye(design.shape[1]) * (1e-3 * np.sqrt(len(values)) + 1e-6 * float((design**2).sum()))
    for _ in range(_REWEIGHTINGS):
        weighted = design * weights[:, None]
        right = normal_matrix(weighted, values[:, None])[:, 0]
        coefficients: Floats = np.linalg.solve(normal_matrix(design, weighted) + ridge, right)
        error = np.abs(values - product(design, coefficients[:, None])[:, 0])
        weights = 1 / np.maximum(1, error / max(float(np.median(error)), 1e-9))
    return coefficients


def _smooth_means(bins: Ints32, values: Floats) -> Floats:
    """Return smoothed bin means of `values` (N,): bins with few returns shrink to the mean of a wider kernel."""
    weights, means = np.ones(len(values)), np.zeros(TABLE_SHAPE)
    for _ in range(2):
        error = np.abs(values - means.ravel()[bins])
        weights = 1 / np.hypot(1, error / max(2 * float(np.median(error)), 1e-9)) if means.any() else weights
        tables = [np.bincount(bins, w, means.size).reshape(TABLE_SHAPE) for w in (weights * values, weights)]
        means = np.zeros(TABLE_SHAPE)
        for widths in _KERNELS:
            by_range, by_elevation = _kernels(widths)
            smooth_sums, smooth_masses = (product(product(by_range, t), by_elevation) for t in tables)
            means = (smooth_sums + _TABLE_SHRINKAGE * means) / (smooth_masses + _TABLE_SHRINKAGE)
    return means


def _far_from_returns(directions: Floats32, ranges_m: Floats32) -> Bools:
    bins = _bins(_log_range(ranges_m), directions[:, 2])
    returns = np.bincount(bins, minlength=TABLE_SHAPE[0] * TABLE_SHAPE[1]).reshape(TABLE_SHAPE)
    # Beyond a standard deviation of the widest kernels.
    by_range, by_elevation = (kernel > np.exp(-0.51) for kernel in _kernels(_KERNELS[0]))
    return product(product(by_range, returns), by_elevation) <= 0


def _kernels(widths: tuple[float, float]) -> list[Floats]:
    """Return Gaussian weights of pairs of bins by range and of pairs by elevation; 1 on the diagonals."""
    bins = (_LOG_RANGES[1] - _LOG_RANGES[0]) / TABLE_SHAPE[0], 2 / TABLE_SHAPE[1]
    places = [np.arange(n) / (width / bin_) for n, width, bin_ in zip(TABLE_SHAPE, widths, bins, strict=True)]
    return [np.exp(-0.5 * (place[:, None] - place) ** 2) for place in places]


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
    """Closed-form intensity in [0, 1], or residual of a network, as a function of place, direction, range and incidence."""

    leaf_size_m: float  # edge of a leaf cell, m
    coefficients: Floats  # (3, 14) of the regression for each kind of surface
    table: Floats32  # (48, 96) residuals of the first of them by range and elevation, plus `_UNMEASURED` far from returns
    plane_keys: Keys  # (P,) Morton keys of the surfels' cells with a plane, ascending
    normals: Floats32  # (P, 3) unit normals of these planes, local frame
    mean_keys: Keys  # (M,) keys of the cells with means
    means: NDArray[np.float16]  # (M,) means of the regression's residuals in them
    network_share: float = 0.0  # factor on the intensity network's prediction, to which this is added

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
    ) -> "Reflectance":
        """Fit the reflectance of `rays`, ghosts included: a sensor sees them again.

        `unit` (N,): their intensities, scaled to [0, 1]. `surfels`: of these returns or a superset. `ask`: predicts intensities
        (M,) of points (M, 3) along directions (M, 3) from ranges (M,) by a network. None without a network.
        """
        flat = np.flatnonzero(surfels.is_flat())
        normals = surfels.normals.astype(np.float32)
        points, directions, ranges_m = rays.points, rays.directions, rays.ranges_m
        plane = surfels.flat_planes_at(points, num_threads)
        incidence, kinds = _incidence(normals, plane, directions), kinds_of(normals, plane)
        kind = _in_metres(_GROUPS if ask is None else _GROUPS_ASKED, leaf_size_m)
        few = len(points) <= _MOST_RETURNS  # of few returns, each is its own group
        groups = np.arange(len(points)) if few else cell_rows(kind, points, directions, incidence)[0]
        counts = np.bincount(groups).astype(np.float64)
        places = _means(points, groups, counts), _means(directions, groups, counts)
        times, share = 1.0, 0.0
        if ask is not None:
            unit_vectors = places[1] / np.linalg.norm(places[1], axis=1, keepdims=True)
            answers = ask(places[0], unit_vectors, _means(ranges_m, groups, counts))
            unit = unit - np.float32(_NETWORK_TIMES) * answers[groups]
            times, share = _CLOSED_TIMES, 1 - _CLOSED_TIMES * (1 - _NETWORK_TIMES)
        views = Views(directions, ranges_m, incidence, kinds)
        coefficients, table = fit_response(unit, views)
        left = unit - response(coefficients, table, views)
        incidence = _means(incidence, groups, counts)
        del plane, kinds, views  # per-return arrays: frees memory
        weights = (counts / (1 + _CORRELATION * (counts - 1))).astype(np.float32)
        columns = (*places, incidence, _means(left, groups, counts), weights)
        options = (_SHRINKAGE, _ROUNDS, _LEAST_MEAN, num_threads)
        keys, means, explained = fit_cell_means(_in_metres(_KINDS, leaf_size_m), _TILINGS, *columns, *options)
        # Cells store means, but the absolute error is to be minimised, so the offset is the median residual.
        coefficients[:, 0] += np.median(left - explained[groups])
        return cls(
            leaf_size_m,
            times * coefficients,
            np.float32(times) * table,
            surfels.keys[surfels.cell_of_plane[flat]],
            normals[flat],
            keys,
            (np.float32(times) * means).astype(np.float16),
            share,
        )

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
        views = Views(directions, ranges_m, incidence, kinds_of(self.normals, rows))
        of_cells = self._cells.sums(near, directions, incidence, num_threads)
        return response(self.coefficients, self.table, views) + of_cells

    def measured(self, directions: Floats32, ranges_m: Floats32) -> Bools:
        """Return a mask (N,) of the directions (N, 3) and ranges (N,), m, near which there were returns."""
        return (self.table > _HALF / 2).ravel()[_bins(_log_range(ranges_m), directions[:, 2])]


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


def _means(values: Floats32, groups: Ints | Ints32, counts: Floats) -> Floats32:
    """Return the means (G,) or (G, K) of `values` (N,) or (N, K) of returns in groups of sizes `counts` (G,)."""
    sums = np.stack([np.bincount(groups, column) for column in np.atleast_2d(values.T)])
    return np.ascontiguousarray((sums / counts).T.reshape(-1, *values.shape[1:]), np.float32)
