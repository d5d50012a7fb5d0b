# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The planes that scans have in common, where their poses put them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from radarsdf._core import CommonPlanes
from radarsdf.config.groups import ReturnsConfig
from radarsdf.poses.groups import Groups
from radarsdf.poses.normals import told_normals
from radarsdf.poses.rigid import Floats
from radarsdf.returns.noise import SensorNoise, sensor_noise
from radarsdf.returns.planes import LEAVES_PER_SURFEL, Surfels
from radarsdf.returns.rays import Rays

# Scans in the band that is factored. 16 to 128 take the same time, since fewer need more iterations.
_TOGETHER = 32
_LEAST_RANGE_M = 1e-6  # to divide by
# Cells are at least a quarter as wide as returns of one scan are apart: with 40 returns over 150 m, planes of smaller cells have too
# few of them. Radars of 500 to 2,000 returns a scan have 0.2 to 0.5 m between them, so that their cells are those of a map.
_CELLS_APART = 4
_ASKED_SCANS = 16


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
        return SensorReturns(
            np.ascontiguousarray(self.directions[::step]),
            np.ascontiguousarray(self.ranges_m[::step]),
            np.ascontiguousarray(self.scans[::step]),
        )

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
        normals.append(told_normals(surfels, num_threads))
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
