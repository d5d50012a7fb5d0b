"""The leaf cells of a map: those near returns, and those that bridge gaps between them."""

from __future__ import annotations

import math

import numpy as np

from radarsdf._core import CellSet
from radarsdf.arrays import Keys
from radarsdf.config.fit_config import FitConfig
from radarsdf.fitting.average import BAND_CELLS
from radarsdf.fitting.sampling import NEAR_BAND_CELLS
from radarsdf.fitting.surface_returns import SurfaceReturns
from radarsdf.returns.evidence import ReturnsOfCells, bridged
from radarsdf.returns.rays import Rays


def occupied_cells(
    surface: SurfaceReturns, config: FitConfig, num_threads: int
) -> tuple[Keys, ReturnsOfCells]:
    """Return the ascending keys (C,) of the leaf cells near returns or bridging gaps, and the returns of cells."""
    noise, returns = surface.noise, config.returns
    if surface.means is None:
        keys = near_leaf_keys(surface.rays, config, num_threads)
        of_cells = ReturnsOfCells.of_rays(surface.rays, noise, config.leaf_size_m, returns, num_threads)
    else:
        keys = surface.means.leaf_keys(config.leaf_size_m, config.metres(BAND_CELLS), num_threads)
        of_cells = ReturnsOfCells.of_means(surface.means, noise, returns)
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
