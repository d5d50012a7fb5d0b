"""What grids and comparisons need of a map: free-space crossings of leaf cells, and mean intensities by place and view."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from radarsdf.arrays import AnyFloats, ArrayLike, Bools, Bytes, Floats, Floats32, Ints, Ints32, Keys, NDArray
from radarsdf.checks import check
from radarsdf.core import cell_rows, find_free_space
from radarsdf.returns.noise import SensorNoise
from radarsdf.returns.rays import Rays
from radarsdf.returns.sums import MAX_CELLS_FROM_ORIGIN, lattice_of

BLOCK_CELLS = 8
"""Edge of a block, leaf cells."""
MOST_SCANS = 7
"""Largest number of crossing scans that is counted for a cell."""

_LEVELS = 3  # octree levels of a block: 2³ cells along an edge
_PLANES, _WORDS = 4, 8
_SIGMAS = 2.0  # standard deviations before a return at which the free space of its ray ends
_INSIDE = np.arange(BLOCK_CELLS**3, dtype=np.uint64)


@dataclass(frozen=True)
class FreeSpace:
    """Free-space crossings of leaf cells, in blocks of 8 × 8 × 8."""

    keys: Keys  # (B,) Morton keys of the blocks' leaf cells without the last 9 bits, ascending
    # (B, 4, 8) bit planes of the 512 leaf cells of a block, in Morton order. Planes 0 to 2: the number of scans with a
    # ray through the cell, at most 7. Plane 3: whether the cell has returns.
    planes: Keys

    @classmethod
    def of(
        cls,
        rays: Rays,
        noise: SensorNoise,
        leaf_size_m: float,
        box_cells: Ints | None = None,
        num_threads: int = 0,
    ) -> "FreeSpace":
        """Compute the crossings of `rays` to true returns in the box [lower, upper), (2, 3) leaf cells; None for no limit."""
        # Rays end two standard deviations before the return, and where the angular error exceeds one cell: beyond
        # that, the crossed cell is uncertain.
        end_m = rays.ranges_m.copy()
        for rows, own in noise.by_radar(rays):
            end_m[rows] -= np.float32(_SIGMAS) * np.sqrt(own.variances_m2(rays.ranges_m[rows]))
            end_m[rows] = np.minimum(end_m[rows], np.float32(leaf_size_m / own.angle_rad))
        limit = [[-MAX_CELLS_FROM_ORIGIN] * 3, [MAX_CELLS_FROM_ORIGIN] * 3]
        lower, upper = limit if box_cells is None else box_cells.tolist()
        of_rays = rays.points, rays.directions, rays.ranges_m, end_m, rays.scans
        return cls(*find_free_space(*of_rays, leaf_size_m, lower, upper, num_threads))

    @classmethod
    def none(cls) -> "FreeSpace":
        return cls(np.zeros(0, np.uint64), np.zeros((0, _PLANES, _WORDS), np.uint64))

    def check(self) -> None:
        shaped = self.keys.ndim == 1 and self.planes.shape == (len(self.keys), _PLANES, _WORDS)
        fits = shaped and (np.diff(self.keys.astype(np.int64), prepend=-1) > 0).all()
        check(fits, "the free-space crossings are not planes of 512 cells for ascending keys")

    def dense(self, lower: ArrayLike, shape: tuple[int, int, int]) -> tuple[Bytes, Bools]:
        """Return dense arrays of crossing scans, at most 7, and of whether there are returns, from leaf cell `lower` (3,) on."""
        first = np.asarray(lower, np.int64)
        last = first + np.asarray(shape)
        begin, end = first // BLOCK_CELLS, -(-last // BLOCK_CELLS)  # blocks that the box touches
        # Block i begins at leaf cell 8 i.
        blocks = lattice_of(self.keys << np.uint64(3 * _LEVELS)) // BLOCK_CELLS
        rows = np.flatnonzero(((blocks >= begin) & (blocks < end)).all(axis=1))
        whole = tuple((end - begin).tolist())
        found = np.zeros((*whole, BLOCK_CELLS, BLOCK_CELLS, BLOCK_CELLS), np.uint8)
        found[tuple((blocks[rows] - begin).T)] = unpacked(self.planes[rows])
        cells = found.transpose(0, 3, 1, 4, 2, 5).reshape([BLOCK_CELLS * n for n in whole])
        offset = first - begin * BLOCK_CELLS
        inside = cells[tuple(slice(o, o + n) for o, n in zip(offset, shape, strict=True))]
        return inside & np.uint8(MOST_SCANS), inside > MOST_SCANS

    def at(self, leaf_keys: Keys) -> Bytes:
        """Return the number (N,) of scans that crossed the leaf cells with Morton keys (N,), at most 7."""
        if len(self.keys) == 0:
            return np.zeros(len(leaf_keys), np.uint8)
        blocks, bit = leaf_keys >> np.uint64(3 * _LEVELS), leaf_keys & _INSIDE[-1]
        rows = np.minimum(np.searchsorted(self.keys, blocks), len(self.keys) - 1)
        words = self.planes[rows, :, bit >> np.uint64(6)] >> (bit & np.uint64(63))[:, None] & np.uint64(1)
        scans = (words[:, 0] + 2 * words[:, 1] + 4 * words[:, 2]).astype(np.uint8)
        return np.where(self.keys[rows] == blocks, scans, np.uint8(0))


def unpacked(planes: Keys) -> Bytes:
    """Unpack bit planes to (B, 8, 8, 8) cells: the number of crossing scans, plus 8 where there are returns."""
    bits = np.unpackbits(planes.astype("<u8").view(np.uint8), axis=-1, bitorder="little")
    weights = np.array([1, 2, 4, 8], np.uint8)[:, None]
    return (bits * weights).sum(axis=1, dtype=np.uint8)[:, _MORTON]


_PLACES = np.ravel_multi_index(tuple((lattice_of(_INSIDE) % BLOCK_CELLS).T), (BLOCK_CELLS,) * 3)
_MORTON = np.argsort(_PLACES).reshape((BLOCK_CELLS,) * 3)  # bit of each cell


PLACE_CELLS = 3
"""Edge of the cells in which returns of similar view share a mean, leaf cells."""
# Bin widths of the direction's components and of the logarithm of the range: an echo hardly varies within one.
_DIRECTION_STEP, _LOG_RANGE_STEP = 0.25, 0.3
_UNITS = 127  # scale of a direction's components in 8 bits
_MOST = 2**16 - 1  # largest stored count


def rows_of_views(
    points: AnyFloats, directions: AnyFloats, ranges_m: AnyFloats, leaf_size_m: float
) -> tuple[Ints32, int]:
    """Return the group (N,) by place and view of returns at points (N, 3), m, along directions (N, 3), and their number."""
    # The third bin width of the core applies to any quantity.
    kind = np.array([[PLACE_CELLS * leaf_size_m, _DIRECTION_STEP, _LOG_RANGE_STEP]])
    log_ranges = np.log(np.maximum(ranges_m, 1e-6))
    return cell_rows(kind, *(np.ascontiguousarray(a, np.float32) for a in (points, directions, log_ranges)))


_COLUMNS = ("points", "directions", "ranges_m", "intensities", "counts")


@dataclass(frozen=True)
class ViewStatisticsAt:
    """View statistics in the world frame."""

    points: Floats  # (G, 3) mean place, m
    directions: Floats  # (G, 3) unit vectors from the sensor
    ranges_m: Floats  # (G,) mean range
    intensities: Floats  # (G,) mean intensity, sensor units
    counts: Floats  # (G,) number of returns
    sigma: float  # standard deviation of single returns from the mean of their group

    def select(self, chosen: Bools) -> "ViewStatisticsAt":
        return replace(self, **{name: getattr(self, name)[chosen] for name in _COLUMNS})

    @classmethod
    def together(cls, parts: "Sequence[ViewStatisticsAt]") -> "ViewStatisticsAt":
        weights = np.array([max(float(part.counts.sum()), 1.0) for part in parts])
        variances = np.array([part.sigma**2 for part in parts])
        columns = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _COLUMNS}
        return cls(**columns, sigma=float(np.sqrt((weights * variances).sum() / weights.sum())))


@dataclass(frozen=True)
class ViewStatistics:
    """View statistics in the compact form that a map stores: 23 bytes each."""

    points: Floats32  # (G, 3) mean place, local frame, m
    directions: NDArray[np.int8]  # (G, 3) mean direction from the sensor, a unit vector times 127
    ranges_m: NDArray[np.float16]  # (G,) mean range
    intensities: Floats32  # (G,) mean intensity, scaled to [0, 1]
    counts: NDArray[np.int16]  # (G,) number of returns, at most 65,535, as the bits of an uint16
    sigma: float  # standard deviation of single returns from the mean of their group

    @classmethod
    def of(cls, rays: Rays, unit: Floats32, leaf_size_m: float) -> "ViewStatistics":
        rows, count = rows_of_views(rays.points, rays.directions, rays.ranges_m, leaf_size_m)
        counts = np.bincount(rows, minlength=count)
        of_returns = unit.astype(np.float64)

        def means(column: AnyFloats) -> Floats:
            return np.bincount(rows, column, count) / counts

        mean = means(of_returns)
        squares = ((of_returns - mean[rows]) ** 2).sum()
        directions = np.stack([means(column) for column in rays.directions.T], axis=1)
        directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-9)
        return cls(
            np.stack([means(column) for column in rays.points.T], axis=1).astype(np.float32),
            np.rint(_UNITS * directions).astype(np.int8),
            means(rays.ranges_m).astype(np.float16),
            mean.astype(np.float32),
            np.minimum(counts, _MOST).astype(np.uint16).view(np.int16),
            float(np.sqrt(squares / max(len(rows) - count, 1))),
        )

    @classmethod
    def none(cls) -> "ViewStatistics":
        empty = np.zeros((0, 3), np.float32)
        none = empty[:, 0]
        return cls(empty, empty.astype(np.int8), none.astype(np.float16), none, none.astype(np.int16), 0.0)

    def check(self, leaf_size_m: float) -> None:
        count, limit_m = len(self.counts), MAX_CELLS_FROM_ORIGIN * leaf_size_m
        shapes = [getattr(self, name).shape for name in _COLUMNS]
        fits = shapes == [(count, 3), (count, 3), (count,), (count,), (count,)]
        check(fits, "the view statistics have arrays of wrong shapes")
        near = (np.abs(self.points) <= limit_m).all() and (self.ranges_m >= 0).all()
        plausible = near and (self.counts.view(np.uint16) > 0).all() and 0 <= self.sigma < np.inf
        check(plausible, "the view statistics hold numbers out of range")

    def in_world(self, origin: Floats, low: float, high: float) -> ViewStatisticsAt:
        """Convert to the world frame. `origin` (3,): of the local frame, m. `low`, `high`: values of 0 and 1, sensor units."""
        width = high - low
        return ViewStatisticsAt(
            self.points.astype(np.float64) + origin,
            self.directions / float(_UNITS),
            self.ranges_m.astype(np.float64),
            low + width * self.intensities.astype(np.float64),
            self.counts.view(np.uint16).astype(np.float64),
            width * self.sigma,
        )
