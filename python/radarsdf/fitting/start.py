# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The field before the training: random, or an average of the rays' signed distances."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray

from radarsdf._core import CellSet, VertexTable, count_scans
from radarsdf.config.fit_config import FitConfig
from radarsdf.config.groups import ReturnsConfig
from radarsdf.field.field import Field
from radarsdf.fitting.surface import SurfaceReturns
from radarsdf.returns.cells import ReturnCells
from radarsdf.returns.evidence import ReturnsOfCells
from radarsdf.returns.mean_rays import MeanRays
from radarsdf.returns.noise import SensorNoise
from radarsdf.returns.rays import Rays
from radarsdf.returns.surfels import Surfels

# Iterations of smoothing. Measured: twice as many are 0.0 to 0.1 points of F-score better on whole simulated scenes, half as
# many 0.0 to 0.3 worse.
_SMOOTHINGS = 24


class Start(ABC):
    """Decides which leaf cells the map has, what the field is at first, and what the returns tell of the cells."""

    def __init__(self, surface: SurfaceReturns, config: FitConfig, num_threads: int) -> None:
        self._surface = surface
        self._config = config
        self._num_threads = num_threads

    @abstractmethod
    def leaf_keys(self) -> NDArray[np.uint64]:
        """(C,) uint64, Morton keys of the leaf cells in which a surface can lie, ascending."""

    @abstractmethod
    def initialise(self, field: Field, generator: torch.Generator) -> None:
        """Sets the parameters of the field."""

    @abstractmethod
    def returns_of_cells(self) -> ReturnsOfCells:
        """What the returns in each leaf cell tell."""


class FromNoise(Start):
    """Random networks and features (3QFP)."""

    def leaf_keys(self) -> NDArray[np.uint64]:
        return near_leaf_keys(self._surface.rays, self._config, self._num_threads)

    def initialise(self, field: Field, generator: torch.Generator) -> None:
        field.initialise(generator)

    def returns_of_cells(self) -> ReturnsOfCells:
        rays = self._surface.rays
        cells = ReturnCells.of(rays, self._config.leaf_size_m, self._num_threads)
        information = 1 / self._surface.noise.variances_m2(rays.ranges_m)
        found = ReturnsOfCells(
            keys=cells.keys,
            information=np.bincount(cells.cell_of_ray, information, len(cells.keys)).astype(np.float32),
            scans=count_scans(cells.cell_of_ray, rays.scans, len(cells.keys), self._num_threads),
            counts=cells.counts,
        )
        ranges_m = np.zeros(len(cells.keys), np.float32)
        ranges_m[cells.cell_of_ray] = rays.ranges_m  # any return of the cell
        return found.with_uncertain_poses(ranges_m, self._config.returns)


class FromAverage(Start):
    """The average of the rays' truncated signed distances (Curless and Levoy, 1996). It needs no training."""

    def leaf_keys(self) -> NDArray[np.uint64]:
        config = self._config
        return self._means.leaf_keys(config.leaf_size_m, config.near_band_m, self._num_threads)

    def initialise(self, field: Field, generator: torch.Generator) -> None:
        # Only the first number of each feature holds the average. The other seven are random if they are
        # used, else 0.
        learns = self._config.training.sdf_iterations != 0 or field.intensity_network is not None
        field.initialise(generator, features=learns)
        average_rays(
            field,
            self._means,
            self._told,
            self._surface.surfels,
            self._config,
            self._num_threads,
        )

    def returns_of_cells(self) -> ReturnsOfCells:
        return self._told

    @cached_property
    def _told(self) -> ReturnsOfCells:
        return told_by(self._means, self._surface.noise, self._config.returns)

    @property
    def _means(self) -> MeanRays:
        means = self._surface.means
        assert means is not None
        return means


STARTS: dict[str, type[Start]] = {"noise": FromNoise, "average": FromAverage, "smoothed": FromAverage}
"""The starts by their names in ``config.training.start``."""


def near_leaf_keys(rays: Rays, config: FitConfig, num_threads: int) -> NDArray[np.uint64]:
    """(C,) uint64, Morton keys of the leaf cells that a sample near the surface can fall into, ascending.

    Points every half cell along the near band of each ray find the cells. Random samples would make the map's
    cells depend on the seed.
    """
    steps = math.ceil(2 * config.near_band_m / (config.leaf_size_m / 2))
    cells = CellSet(config.leaf_size_m)
    offsets_m = np.linspace(-config.near_band_m, config.near_band_m, steps + 1).astype(np.float32)
    points, directions = np.ascontiguousarray(rays.points), np.ascontiguousarray(rays.directions)
    cells.insert_along(points, directions, offsets_m, num_threads)
    return cells.sorted_keys(num_threads)


def average_rays(
    field: Field,
    rays: MeanRays,
    told: ReturnsOfCells,
    surfels: Surfels,
    config: FitConfig,
    num_threads: int,
) -> None:
    """Sets the field to the average over rays, interpolated between the vertices of an octree's leaf cells.

    A ray counts at the vertices of the cells that it crosses, up to `truncation_m` before and behind its
    return. Its value there is the vertex's distance to a plane through its return: parallel to the surfel
    there, or, if there is none, perpendicular to the ray. `told`: what the returns of the same cells tell.
    """
    normals = normals_at(rays, surfels, num_threads)
    distances_m = average_at_vertices(field.cells.table, rays, told, normals, config, num_threads)
    with torch.no_grad():
        field.cells.features[:, 0] = torch.from_numpy(distances_m) / config.sigma_m
    field.sdf_network.start_as_input(0)


def normals_at(rays: MeanRays, surfels: Surfels, num_threads: int) -> NDArray[np.float32]:
    """(M, 3) of the planes at the ends of rays: of the surfel there if it is flat, else towards the sensor."""
    plane = surfels.flat_planes_of_leaves(rays.keys, num_threads)
    of_planes = surfels.normals[plane].astype(np.float32) if len(surfels.normals) else 0
    normals: NDArray[np.float32] = np.where(plane[:, None] >= 0, of_planes, -rays.directions)
    # A surfel of returns from both sides of a thin wall faces one of them alone.
    away = np.einsum("ij,ij->i", normals, rays.directions) > 0
    normals[away] *= -1
    return normals


def average_at_vertices(
    table: VertexTable,
    rays: MeanRays,
    told: ReturnsOfCells,
    normals: NDArray[np.float32],
    config: FitConfig,
    num_threads: int,
) -> NDArray[np.float32]:
    """(V,) the average of :func:`average_rays` at the vertices of an octree's `table`, m, smoothed if `config` says so.

    What a vertex gets depends on what is within :func:`cells_smoothed` leaf cells of the cells of its rays, to the bit.
    """
    distances_m, sides = table.average_rays(
        rays.points,
        rays.directions,
        np.ascontiguousarray(normals, np.float32),
        rays.counts,
        config.truncation_m,
        num_threads,
    )
    if config.training.start == "smoothed":
        distances_m = table.smoothed(
            distances_m,
            rays.points,
            np.ascontiguousarray(normals, np.float32),
            told.information,
            sides,
            _SMOOTHINGS,
            num_threads,
        )
    return distances_m


def cells_smoothed(config: FitConfig) -> int:
    """Leaf cells, along each axis, over which :func:`average_at_vertices` carries what is known."""
    return _SMOOTHINGS * VertexTable.SMOOTHING_REACH if config.training.start == "smoothed" else 0


def told_by(means: MeanRays, noise: SensorNoise, config: ReturnsConfig) -> ReturnsOfCells:
    """What the returns of each leaf cell tell, by their mean rays."""
    # The returns of a cell are at nearly the same range if they are of the same sensor position.
    information = means.counts / noise.variances_m2(means.ranges_m)
    counts = means.counts.astype(np.float64)
    found = ReturnsOfCells(means.keys, information.astype(np.float32), means.scans, counts)
    return found.with_uncertain_poses(means.ranges_m, config)
