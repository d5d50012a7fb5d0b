"""The returns from which the surface is fitted: without ghosts, and for training moved towards flat surfels."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from radarsdf._core import CellSet
from radarsdf.arrays import Bools, Ints32, Keys
from radarsdf.config.fit_config import FitConfig
from radarsdf.fitting.average import BAND_CELLS
from radarsdf.fitting.sampling import NEAR_BAND_CELLS
from radarsdf.returns.evidence import ReturnsOfCells, bridged
from radarsdf.returns.ghosts import find_ghosts
from radarsdf.returns.noise import SensorNoise, onto_surfels, sensor_noise
from radarsdf.returns.planes import Surfels
from radarsdf.returns.rays import Rays
from radarsdf.returns.sums import MeanRays, ReturnCells, ScanSums


@dataclass(frozen=True)
class SurfaceReturns:
    """Returns from which the surface is fitted, with their surfels and noise."""

    rays: Rays  # for training, without ghosts and moved towards the flat surfel of their cell; otherwise all
    count: int  # number of returns that are no ghosts
    surfels: Surfels  # of all returns
    noise: SensorNoise
    means: MeanRays | None  # mean rays of the leaf cells without ghosts, to average. None for training
    # (N,) False for ghosts. None if ghosts are not detected, or nothing needs it.
    true: Bools | None

    @classmethod
    def of(
        cls,
        rays: Rays,
        config: FitConfig,
        num_threads: int,
        inside: Bools | None = None,
        sums: ScanSums | None = None,
        noise: SensorNoise | None = None,
    ) -> SurfaceReturns:
        """Clean `rays` by ``config.returns`` and select those `inside`, (N,); None: all. `sums`, `noise`: of the rays, if known."""
        needed_later = config.returns.free_space or inside is not None or noise is not None
        by_return = config.train or (config.returns.drop_ghosts and needed_later)
        weights = None if noise is None else noise.weights(rays)
        cells = _cells_of(rays, config, sums, by_return, num_threads, weights)
        if noise is None:
            noise = sensor_noise(cells.surfels, rays, config.returns, num_threads)
        clean = _returns_to_train if config.train else _returns_to_average
        return clean(rays, cells, noise, config, inside, num_threads)


class _Cells(NamedTuple):
    surfels: Surfels
    means: MeanRays | None  # None for training
    of_rays: Ints32 | None  # (N,) row of the surfel's cell of each return, if asked for


def _cells_of(
    rays: Rays,
    config: FitConfig,
    sums: ScanSums | None,
    by_return: bool,
    num_threads: int,
    weights: Ints32 | None,
) -> _Cells:
    leaves = None
    if sums is None:
        leaves = ReturnCells.of(rays, config.leaf_size_m, num_threads)
        sums = ScanSums.of_cells(rays, leaves, config.leaf_size_m, num_threads, weights)
    surfels, of_rays = Surfels.of_sums(sums, num_threads), None
    if by_return and leaves is not None:
        of_rays = surfels.cells_of_leaves(leaves.keys, num_threads)[leaves.cell_of_ray]
    elif by_return:
        of_rays = surfels.cells_at(rays.points, num_threads)
    return _Cells(surfels, None if config.train else MeanRays.of_sums(sums, num_threads), of_rays)


def _returns_to_train(
    rays: Rays, cells: _Cells, noise: SensorNoise, config: FitConfig, inside: Bools | None, num_threads: int
) -> SurfaceReturns:
    """Drop ghosts, found by all rays, and move the other returns towards their surfels."""
    surfels, true, kept = cells.surfels, None, inside
    assert cells.of_rays is not None
    if config.returns.drop_ghosts:
        true = ~find_ghosts(surfels, rays, cells.of_rays, noise, num_threads)[cells.of_rays]
        kept = true if inside is None else true & inside
    if config.returns.onto_planes:
        rays = onto_surfels(surfels, rays, cells.of_rays, noise, kept, num_threads)
    elif kept is not None:
        rays = rays.select(kept)
    return SurfaceReturns(rays, len(rays), surfels, noise, None, true)


def _returns_to_average(
    rays: Rays, cells: _Cells, noise: SensorNoise, config: FitConfig, inside: Bools | None, num_threads: int
) -> SurfaceReturns:
    """Drop ghosts, found by the mean rays of leaf cells."""
    surfels, means, true, count = cells.surfels, cells.means, None, len(rays)
    assert means is not None
    if config.returns.drop_ghosts:
        cell_of_mean = surfels.cells_of_leaves(means.keys, num_threads)
        of_ghosts = find_ghosts(surfels, means, cell_of_mean, noise, num_threads)
        means = means.select(~of_ghosts[cell_of_mean])
        true = None if cells.of_rays is None else ~of_ghosts[cells.of_rays]
        count = int(surfels.counts[~of_ghosts].sum() if true is None else np.count_nonzero(true))
    if inside is not None:
        count = int(np.count_nonzero(inside if true is None else true & inside))
        leaves = ReturnCells.of(rays.select(inside), config.leaf_size_m, num_threads)
        means = means.select(leaves.blocks.rows(means.keys, num_threads) >= 0)
    return SurfaceReturns(rays, count, surfels, noise, means, true)


def occupied_cells(used: SurfaceReturns, config: FitConfig, num_threads: int) -> tuple[Keys, ReturnsOfCells]:
    """Return the ascending keys (C,) of the leaf cells near returns or bridging gaps, and the returns of cells."""
    noise, returns = used.noise, config.returns
    if used.means is None:
        keys = near_leaf_keys(used.rays, config, num_threads)
        of_cells = ReturnsOfCells.of_rays(used.rays, noise, config.leaf_size_m, returns, num_threads)
    else:
        keys = used.means.leaf_keys(config.leaf_size_m, config.metres(BAND_CELLS), num_threads)
        of_cells = ReturnsOfCells.of_means(used.means, noise, returns)
    return bridged(keys, of_cells.keys, of_cells.counts, config.encoding.bridge_cells, num_threads), of_cells


def near_leaf_keys(rays: Rays, config: FitConfig, num_threads: int) -> Keys:
    """Return the ascending Morton keys (C,) of the leaf cells that can contain a sample near the surface."""
    # Points every half cell along the near band of each ray: random samples would make the cells depend on the seed.
    band_m = config.metres(NEAR_BAND_CELLS)
    steps = math.ceil(2 * band_m / (config.leaf_size_m / 2))
    cells = CellSet(config.leaf_size_m)
    offsets_m = np.linspace(-band_m, band_m, steps + 1).astype(np.float32)
    points, directions, _ = rays.in_c_order()
    cells.insert_along(points, directions, offsets_m, num_threads)
    return cells.sorted_keys(num_threads)
