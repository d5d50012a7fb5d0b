# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Planes that scans have in common at given poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from radarsdf._core import CellBlocks, CommonPlanes
from radarsdf.config.groups import ReturnsConfig
from radarsdf.poses.rigid import Floats, skew
from radarsdf.returns.noise import SensorNoise, sensor_noise
from radarsdf.returns.planes import LEAVES_PER_SURFEL, NEIGHBOUR_WEIGHT, Surfels
from radarsdf.returns.rays import Rays
from radarsdf.returns.sums import UPPER, merged_keys

# The edge of a region is 2 to the power of this, in cells. Wide regions have many planes, and know well what is error: with
# 8 cells, the way along simulated walls was told 5 times too surely, with 16 to 64 not.
_DOUBLINGS = 4

# Scans in the band that is factored. 16 to 128 take the same time, since fewer need more iterations.
_TOGETHER = 32
_LEAST_RANGE_M = 1e-6  # to divide by
# Cells are at least a quarter as wide as returns of one scan are apart: with 40 returns over 150 m, planes of smaller cells have too
# few of them. Radars of 500 to 2,000 returns a scan have 0.2 to 0.5 m between them, so that their cells are those of a map.
_CELLS_APART = 4
_ASKED_SCANS = 16

Blocks = tuple[Floats, Floats, Floats]
"""Blocks on the diagonal (F, 6, 6), below it (F - 1, 6, 6), and a gradient (F, 6), as of :meth:`Motion.prior`."""


def unbiased_normals(surfels: Surfels, num_threads: int) -> Floats:
    """(P, 3) unit normals of the surfels.

    Along a wall, each normal points a little along it by chance, and so all returns would tell where the sensor is. In each
    region, what the normals have of each direction is compared with what their errors would make of it, and reduced to the rest
    (errors in variables, Fuller 1987). Whatever the normals are, scans that move together lose nothing.
    """
    assert surfels.widest is not None
    planes = np.flatnonzero(surfels.is_flat())
    if len(planes) == 0:
        return surfels.normals
    cells = surfels.cell_of_plane[planes]
    normals, widest = surfels.normals[planes], surfels.widest[planes].astype(np.float64)
    across = np.cross(widest, normals)
    thickness, *widths = surfels.variances[planes].T
    weights = surfels.counts[cells] / thickness
    # Of a regression: the variances of the two slopes.
    of_across, of_widest = (weights * thickness / (surfels.support[cells] * width) for width in widths)
    sums = np.empty((len(planes), 12))
    for k, (i, j) in enumerate(UPPER):
        sums[:, k] = weights * normals[:, i] * normals[:, j]
        sums[:, 6 + k] = of_across * across[:, i] * across[:, j] + of_widest * widest[:, i] * widest[:, j]
    keys = surfels.keys[cells]
    for _ in range(_DOUBLINGS):
        keys = merged_keys(keys)
    regions, first, region = np.unique(keys, return_index=True, return_inverse=True)
    of_regions = np.add.reduceat(sums, first)
    of_regions = CellBlocks(regions).sum_round(regions, of_regions, NEIGHBOUR_WEIGHT, num_threads)
    spread, errors = np.empty((2, len(regions), 3, 3))
    for k, (i, j) in enumerate(UPPER):
        spread[:, i, j] = spread[:, j, i] = of_regions[:, k]
        errors[:, i, j] = errors[:, j, i] = of_regions[:, 6 + k]
    found = np.einsum("nij,nj->ni", _reduction(spread, errors)[region], normals)
    lengths = np.sqrt(np.einsum("ni,ni->n", found, found))[:, None]
    # A normal that seems all error stays as it is: in this region, there are hardly any others.
    all_normals = surfels.normals.copy()
    all_normals[planes] = np.where(lengths > 0.5, found / np.maximum(lengths, 0.5), normals)
    return all_normals


def _reduction(spread: Floats, errors: Floats) -> Floats:
    """(R, 3, 3) linear maps after which sums of squares `spread` (R, 3, 3) are without their part `errors`, or 0."""
    values, axes = np.linalg.eigh(spread)
    root = np.sqrt(np.maximum(values, 1e-12 * values[:, 2:]))[:, None]
    white = axes / root
    shares, turned = np.linalg.eigh(np.einsum("rki,rkl,rlj->rij", white, errors, white))
    kept = np.sqrt(np.maximum(1 - shares, 0.0))
    into = np.einsum("rij,rjk->rik", axes * root, turned)
    back = np.einsum("rij,rjk->rik", white, turned)
    found: Floats = np.einsum("rij,rj,rkj->rik", into, kept, back)
    return found


def plane_cell_m(scans: Sequence[Floats], leaf_size_m: float) -> float:
    """Edge of the cell of a plane, m: as of a map's surfel, or larger where scans (N_i, 3) are sparse."""
    asked = [scan for scan in scans if len(scan) > 1]
    asked = asked[:: max(1, len(asked) // _ASKED_SCANS)]
    apart_m = [float(np.median(cKDTree(scan).query(scan, 2)[0][:, 1])) for scan in asked]
    return max(LEAVES_PER_SURFEL * leaf_size_m, float(np.median(apart_m or [0.0])) / _CELLS_APART)


@dataclass(frozen=True)
class SensorReturns:
    """Returns in the frames of their sensors, scan by scan."""

    directions: NDArray[np.float32]
    """(N, 3) unit vectors."""
    ranges_m: NDArray[np.float32]
    """(N,)."""
    scans: NDArray[np.int32]
    """(N,) ascending."""

    @classmethod
    def of(
        cls, scans: Sequence[NDArray[np.float64]], min_range_m: float, max_range_m: float | None
    ) -> SensorReturns:
        """Of scans (N_i, 3), sensor frame, m; without returns beyond these ranges."""
        points = np.concatenate(scans)
        ranges_m = np.sqrt(np.einsum("ni,ni->n", points, points))
        number = np.repeat(np.arange(len(scans), dtype=np.int32), [len(scan) for scan in scans])
        kept = ranges_m >= max(min_range_m, _LEAST_RANGE_M)
        kept &= ranges_m <= (np.inf if max_range_m is None else max_range_m)
        directions = points[kept] / ranges_m[kept, None]
        return cls(directions.astype(np.float32), ranges_m[kept].astype(np.float32), number[kept])

    def __len__(self) -> int:
        return len(self.scans)

    def select(self, part: NDArray[np.bool_]) -> SensorReturns:
        """Those of a mask (N,)."""
        return SensorReturns(self.directions[part], self.ranges_m[part], self.scans[part])

    def every(self, step: int) -> SensorReturns:
        """The first one, and each that comes `step` later."""
        return self.select(np.arange(len(self)) % step == 0)

    def posed(self, poses: Floats) -> Rays:
        """As rays of sensors with these poses (F, 4, 4). Their local frame begins at the mean position."""
        origin = poses[:, :3, 3].mean(axis=0)
        first = np.searchsorted(self.scans, np.arange(len(poses) + 1))
        directions = np.empty_like(self.directions)
        for i, R in enumerate(poses[:, :3, :3].astype(np.float32)):
            rows = slice(first[i], first[i + 1])
            np.einsum("ij,nj->ni", R, self.directions[rows], out=directions[rows])
        positions = (poses[:, :3, 3] - origin).astype(np.float32)
        points = directions * self.ranges_m[:, None] + positions[self.scans]
        up = poses[:, :3, 2].copy()
        return Rays(origin, points, directions, self.ranges_m, None, self.scans, up, len(self))


def plane_windows(num_scans: int, size: int, shifted: bool) -> list[tuple[int, int]]:
    """Begin and end of windows of at most `size` scans whose returns share planes. `shifted`: by half of one."""
    begin = -(size // 2) if shifted and size < num_scans else 0
    ranges = [(max(0, k), min(num_scans, k + size)) for k in range(begin, num_scans, size)]
    return [(low, high) for low, high in ranges if high - low > 1]


@dataclass(frozen=True)
class Groups:
    """Consecutive scans, of which the middle one has an increment, and the others what lies between those of two middle ones."""

    num_scans: int
    size: int
    """Scans of a group; the last one may have fewer. 1: each scan is on its own."""

    @property
    def middles(self) -> NDArray[np.intp]:
        """(G,) number of the scan in the middle of each group."""
        begins = np.arange(0, self.num_scans, self.size)
        return (begins + np.minimum(begins + self.size, self.num_scans)) // 2

    def of(self, scans: NDArray[np.int32]) -> NDArray[np.int32]:
        """The number of the group of each scan."""
        return scans // np.int32(self.size)

    def prior(self, of_scans: Blocks, poses: Floats) -> Blocks:
        """Of increments of the groups, from that of increments of the scans with these poses (F, 4, 4)."""
        if self.size == 1:
            return of_scans
        diagonal, below, gradient = of_scans
        count = len(self.middles)
        own, at = self._segments()
        found = np.zeros((count, 6, 6)), np.zeros((count - 1, 6, 6)), np.zeros((count, 6))
        ends = self._by_ends(poses, own, at)
        for k, end in enumerate(ends):
            np.add.at(found[0], own + k, np.einsum("fki,fkl,flj->fij", end, diagonal, end))
            np.add.at(found[2], own + k, np.einsum("fki,fk->fi", end, gradient))
        np.add.at(found[1], own, np.einsum("fki,fkl,flj->fij", ends[1], diagonal, ends[0]))
        # Both scans of a step lie between the same two middles, or on them.
        first = [end[:-1] for end in ends]
        second = [end[1:] for end in self._by_ends(poses, np.concatenate([own[:1], own[:-1]]), at)]
        products = [[np.einsum("fki,fkl,flj->fij", b, below, a) for a in first] for b in second]
        for k in range(2):
            np.add.at(found[0], own[:-1] + k, products[k][k] + products[k][k].transpose(0, 2, 1))
        np.add.at(found[1], own[:-1], products[1][0] + products[0][1].transpose(0, 2, 1))
        return found

    def increments(self, of_groups: Floats, poses: Floats) -> Floats:
        """(F, 6) of the scans with these poses (F, 4, 4), from those of the groups (G, 6)."""
        if self.size == 1:
            return of_groups
        own, at = self._segments()
        ends = self._by_ends(poses, own, at)
        parts = [np.einsum("fij,fj->fi", end, of_groups[own + k]) for k, end in enumerate(ends)]
        found: Floats = parts[0] + parts[1]
        return found

    def _segments(self) -> tuple[NDArray[np.intp], Floats]:
        """(F,) for each scan, the group whose middle is the last one not after it; of the last group, the one before. And the
        places (F,) of all scans: those before the first middle and after the last one are there."""
        middles = self.middles
        at = np.clip(np.arange(self.num_scans), middles[0], middles[-1])
        own = np.searchsorted(middles, at, side="right") - 1
        return np.minimum(own, len(middles) - 2), at.astype(np.float64)

    def _by_ends(self, poses: Floats, own: NDArray[np.intp], at: Floats) -> list[Floats]:
        """Two times (F, 6, 6): how the increment of each scan follows from those of the middles of its group `own` and of the next."""
        middles = self.middles
        shares = (at - middles[own]) / (middles[own + 1] - middles[own])
        found = []
        for share, middle in ((1 - shares, middles[own]), (shares, middles[own + 1])):
            moved = np.tile(np.eye(6), (self.num_scans, 1, 1))
            moved[:, :3, 3:] = -skew(poses[:, :3, 3] - poses[middle, :3, 3])
            found.append(share[:, None, None] * moved)
        return found


@dataclass(frozen=True)
class PlaneGrid:
    """How returns are put together to planes."""

    window: int
    """So many scans that follow each other share planes."""
    shifted: bool
    """Whether windows begin in the middle of one."""
    cell_m: float
    """Edge of the cell of a plane, m."""
    together: int = 1
    """So many consecutive scans move as one, and have as many returns as one."""


def common_planes(
    returns: SensorReturns,
    poses: Floats,
    grid: PlaneGrid,
    noise: SensorNoise | None,
    config: ReturnsConfig,
    num_threads: int = 0,
) -> tuple[CommonPlanes, SensorNoise]:
    """What returns on common planes say of the poses (F, 4, 4), and the noise of the sensor that this supposes.

    Of poses of groups of scans, if `grid` has them together. `noise` None: as these planes show it. `num_threads` 0: as many as OpenMP uses.
    """
    groups = Groups(len(poses), grid.together)
    rays = returns.every(grid.together).posed(poses)
    planes = np.full(len(rays), -1, np.int32)
    centres, normals, noises, total = [], [], [], 0
    for low, high in plane_windows(len(poses), grid.window, grid.shifted):
        rows = slice(*np.searchsorted(rays.scans, [low, high]).tolist())
        part = rays.select(rows)
        surfels = Surfels.of(part, grid.cell_m / LEAVES_PER_SURFEL, num_threads)
        found = _planes_of(part.points, surfels, num_threads)
        planes[rows] = np.where(found >= 0, found + np.int32(total), np.int32(-1))
        centres.append(surfels.centres)
        normals.append(unbiased_normals(surfels, num_threads))
        total += len(surfels.centres)
        if noise is None:
            noises.append(sensor_noise(surfels, part, config, num_threads))
    known = SensorNoise.median(noises) if noise is None else noise
    common = CommonPlanes(
        rays.points,
        rays.directions,
        rays.ranges_m,
        groups.of(rays.scans),
        planes,
        poses[groups.middles, :3, 3] - rays.origin,
        np.ascontiguousarray(rays.up_of_scan[groups.middles]),
        np.concatenate(centres),
        np.ascontiguousarray(np.concatenate(normals)),
        grid.cell_m,
        known.variances,
        min(grid.window // grid.together, _TOGETHER),
        num_threads,
    )
    return common, known


def _planes_of(points: NDArray[np.float32], surfels: Surfels, num_threads: int) -> NDArray[np.int32]:
    """(N,) the flat surfel of each point (N, 3), local, m: that of the cell in which its foot on the surface lies. -1: none.

    Noise moves returns across surfaces, into cells beyond them. By the cells that they lie in themselves, it would be cut where
    cells end, unlike for near and far returns, and turn poses.
    """
    planes = surfels.flat_planes_at(points, num_threads)
    on = np.flatnonzero(planes >= 0)
    normals = surfels.normals[planes[on]]
    off = np.einsum("ni,ni->n", points[on] - surfels.centres[planes[on]], normals)
    feet = np.ascontiguousarray(points[on] - (off[:, None] * normals).astype(np.float32))
    beneath = surfels.flat_planes_at(feet, num_threads)
    planes[on] = np.where(beneath >= 0, beneath, planes[on])
    return planes
