# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The fields of many tiles as one, of which few are in memory."""

from __future__ import annotations

import itertools
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator
from functools import cached_property, partial
from os import PathLike
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from radarsdf._core import cell_keys
from radarsdf.checks import positive
from radarsdf.config.fit_config import FitConfig
from radarsdf.map import queries, storage
from radarsdf.map.contents import MapContents
from radarsdf.returns.intensities import IntensityScale
from radarsdf.returns.sensor import Sensor
from radarsdf.returns.sums import lattice_of
from radarsdf.tiles.plan import Plan, Tile, TilePlan, failure_of, is_done, map_path

_Floats = NDArray[np.float64]
_Cells = NDArray[np.int64]
_STEPS = np.array([step for step in itertools.product((-1, 0, 1), repeat=3) if any(step)])
_LEAST_KNOWN = 1e-6  # at points on the border itself, which are observed, and which were moved inwards
MEMORY_BYTES = 1 << 30
_OF_FEATURES = 2.4  # bytes in memory for each of the features: measured; tables of cells, evidence


class Share(NamedTuple):
    """What one tile contributes at some of N positions."""

    tile: Tile
    contents: MapContents
    """The map of the tile."""
    rows: NDArray[np.int64]
    """(M,) of the positions at which the tile has a weight."""
    weights: _Floats
    """(M,) there."""
    slopes: _Floats
    """(M, 3) derivatives of the weights, 1/m."""
    local: Tensor
    """(M, 3) the positions in the frame of the tile, m."""

    def select(self, chosen: NDArray[np.bool_]) -> Share:
        """The share at some (M,) of its positions."""
        return Share(
            self.tile,
            self.contents,
            self.rows[chosen],
            self.weights[chosen],
            self.slopes[chosen],
            self.local[torch.from_numpy(chosen)],
        )


class TileBlend:
    """The field of the tiles in a folder: the average of those that know a position. See :class:`TiledMap`."""

    def __init__(self, folder: str | PathLike[str], *, memory_bytes: float = MEMORY_BYTES) -> None:
        self.folder = Path(folder)
        self.plan = Plan.load(self.folder)
        self.memory_bytes = positive(memory_bytes, "memory_bytes")
        self._known: dict[Tile, bool] = {}
        self._held: OrderedDict[Tile, tuple[MapContents, int]] = OrderedDict()
        self._lock = threading.Lock()
        if not any(self.has(tile.tile) for tile in self.plan.tiles):
            msg = f"no tile of {self.folder} is done: radarsdf tiles fit {self.folder} makes them"
            raise ValueError(msg)

    @property
    def tiles(self) -> list[TilePlan]:
        """The tiles that are done."""
        return [tile for tile in self.plan.tiles if self.has(tile.tile)]

    @property
    def missing(self) -> dict[str, str]:
        """The others by name, and why their fit failed; empty if it was not tried or was killed."""
        return {
            tile.name: failure_of(self.folder, tile) for tile in self.plan.tiles if not self.has(tile.tile)
        }

    def has(self, tile: Tile) -> bool:
        """Whether there is such a tile, and it is done. What was found stays so for this object."""
        if tile not in self._known:
            planned = self.plan.by_tile.get(tile)
            self._known[tile] = planned is not None and is_done(self.folder, self.plan, planned)
        return self._known[tile]

    @property
    def config(self) -> FitConfig:
        """Settings of the fits."""
        return self.plan.config

    @property
    def intensity_scale(self) -> IntensityScale | None:
        """Range of the training intensities, sensor units. None: the map was fitted without intensities."""
        return self.plan.scale

    @property
    def sensor(self) -> Sensor:
        """The radar, as the scans of the fit show it."""
        return self.plan.sensor

    @property
    def rough_share(self) -> float:
        """Share of the returns that lie on no thin surface, in [0, 1]: clutter, vegetation, rough ground."""
        return self.plan.rough_share

    @cached_property
    def any_contents(self) -> MapContents:
        """The map of a tile, for what all have in common."""
        return self.contents_of(next(tile.tile for tile in self.plan.tiles if self.has(tile.tile)))

    def evidence(self, world: _Floats) -> queries.EvidenceAt:
        """Evidence of a surface at positions (N, 3), world, m. 0 without tiles.

        All tiles count, because each one's evidence ends smoothly: less is known where a tile that looked has no returns.
        """

        def of_tile(share: Share) -> _Floats:
            columns = torch.stack(list(queries.evidence(share.contents, share.local)), 1)
            return columns.numpy().astype(np.float64)

        found = np.nan_to_num(averages(self.shares(world), len(world), of_tile, columns=3)).astype(np.float32)
        return queries.EvidenceAt(*torch.from_numpy(found).unbind(1))

    def contents_of(self, tile: Tile) -> MapContents:
        """The map of a tile that is done. It is read, unless it is in memory."""
        with self._lock:
            if tile not in self._held:
                contents = storage.load_contents(map_path(self.folder, self.plan.by_tile[tile]))
                size = round(_OF_FEATURES * sum(p.nbytes for p in contents.field.parameters()))
                while self._held and sum(n for _, n in self._held.values()) + size > self.memory_bytes:
                    self._held.popitem(last=False)
                self._held[tile] = contents, size
            self._held.move_to_end(tile)
            return self._held[tile][0]

    def leaf_cells(self, of: Tile, within: Tile) -> NDArray[np.int64]:
        """(C, 3) leaf cells, as the lattice numbers them, of the map of one tile that is done, which lie in another."""
        keys = storage.load_leaf_keys(map_path(self.folder, self.plan.by_tile[of]))
        cells = lattice_of(keys).astype(np.int64) + self.plan.origin_cells(of)
        inside: NDArray[np.bool_] = (cells[:, :2] // self.plan.tile_cells == within).all(axis=1)
        return cells[inside]

    def shares(self, world: _Floats) -> Iterator[Share]:
        """The contribution of each tile at positions (N, 3), world, m: in ascending order, on which the bits of sums depend.

        Weights depend on the borders between tiles alone, not on what a tile observed.
        """
        for tile in self.plan.grid.counting(world):
            if not self.has(tile):
                continue
            rows = self.plan.grid.within_half_a_halo(tile, world)
            weights, slopes = self.plan.grid.weights(tile, world[rows])
            if len(rows):
                contents = self.contents_of(tile)
                local = queries.to_local(contents, torch.from_numpy(world[rows]))
                yield Share(tile, contents, rows, weights, np.pad(slopes, ((0, 0), (0, 1))), local)

    def seen(self, world: _Floats) -> NDArray[np.bool_]:
        """(N,) whether positions (N, 3), world, m, are in observed leaf cells, or on their border."""
        found = np.zeros(len(world), bool)
        for share in self.shares(world):
            found[share.rows] |= self._into_cells(share)[1].numpy()
        return found

    def _into_cells(self, share: Share) -> tuple[Tensor, Tensor]:
        """The local positions of a share, those on borders of observed cells moved into one, and which are inside."""

        def among(contents: MapContents, points: Tensor) -> Tensor:
            inside = queries.occupied(contents, points)
            cells = _cells_of(contents, points[inside])
            inside[inside.clone()] = torch.from_numpy(self._owners_observed(share.tile, cells))
            return inside

        return queries.into_cells(share.contents, share.local, among=among)

    def _owners_observed(self, asking: Tile, cells: NDArray[np.int64]) -> NDArray[np.bool_]:
        """(K,) whether leaf cells (K, 3) from the origin of the tile that is `asking` were observed.

        The tile that a cell lies in decides, because tiles disagree: which returns are ghosts depends on surfaces before
        them, of which a neighbour may have few returns. Of a tile that is not done, all may have been observed.
        """
        cells = cells + self.plan.origin_cells(asking)
        owners = cells[:, :2] // self.plan.tile_cells
        found = np.ones(len(cells), bool)
        left = np.arange(len(cells))
        while len(left):
            owner = tuple(owners[left[0]].tolist())
            of_owner = (owners[left, 0] == owner[0]) & (owners[left, 1] == owner[1])
            rows, left = left[of_owner], left[~of_owner]
            if self.has(owner):
                found[rows] = _holds(self.contents_of(owner), cells[rows] - self.plan.origin_cells(owner))
        return found

    def known_shares(self, world: _Floats, *, extrapolate: bool = False) -> Iterator[Share]:
        """The :meth:`shares` at observed positions: weights fall to zero where a tile stops knowing what others know.

        `extrapolate`: where a position was not observed, all of them count.
        """
        alone = np.zeros(len(world), bool)
        if extrapolate:
            alone = np.isfinite(world).all(axis=1) & ~self.seen(world)
        for share in self.shares(world):
            local, _ = self._into_cells(share)
            known, slopes = knowledge(share.contents, local, partial(self._owners_observed, share.tile))
            known[alone[share.rows]] = 1.0
            weights = share.weights * known
            slopes = share.slopes * known[:, None] + slopes * share.weights[:, None]
            yield share._replace(weights=weights, slopes=slopes, local=local).select(weights > 0)

    def distances_at(self, lattice: NDArray[np.int64], voxel_m: float) -> NDArray[np.float32]:
        """(K,) signed distances at corners (K, 3) of voxels that divide leaf cells, numbered from the lattice's first corner.

        They have the same bits whichever tile asks. NaN where no tile has an adjacent cell.
        """
        world = np.asarray(lattice * voxel_m, np.float64)
        touching = (self._touching(share, lattice[share.rows], voxel_m) for share in self.shares(world))
        return averages(touching, len(world), distance)[:, 0].astype(np.float32)

    def _touching(self, share: Share, lattice: NDArray[np.int64], voxel_m: float) -> Share:
        """The share of a tile at those of its corners (M, 3) of voxels that are in one of its cells, or touch one."""
        steps = round(self.config.leaf_size_m / voxel_m)
        # From integers: the same float32 position for every tile that asks.
        origin_cells = np.round(self.config.lattice.cells(share.contents.origin)).astype(np.int64)
        points = torch.from_numpy(((lattice - origin_cells * steps) * voxel_m).astype(np.float32))
        # A corner on the border of the map may be in a cell beyond it, which has no features.
        points, inside = queries.into_cells(share.contents, points, voxel_m)
        return share._replace(local=points).select(inside.numpy())


def averages(
    shares: Iterable[Share], count: int, of_tile: Callable[[Share], _Floats], columns: int = 1
) -> _Floats:
    """(N, columns) weighted averages of the values of tiles, (M, columns) each, at `count` positions. NaN without a share."""
    sums, totals = np.zeros((count, columns)), np.zeros(count)
    for share in shares:
        sums[share.rows] += share.weights[:, None] * of_tile(share)
        totals[share.rows] += share.weights
    with np.errstate(invalid="ignore", divide="ignore"):
        found: _Floats = sums / totals[:, None]
    return found


def distance(share: Share) -> _Floats:
    """(M, 1) the signed distance of a tile, m."""
    return queries.signed_distance(share.contents, share.local).numpy().astype(np.float64)[:, None]


def _cells_of(contents: MapContents, points: Tensor) -> _Cells:
    """(M, 3) the leaf cells of points (M, 3), local frame, m, from the origin of their map."""
    size_m = contents.field.table.leaf_size_m
    return np.floor(_places(points, size_m)).astype(np.int64)


def _holds(contents: MapContents, cells: _Cells) -> NDArray[np.bool_]:
    """(M,) whether a tile observed these leaf cells (M, 3), from its origin."""
    size_m = contents.field.table.leaf_size_m
    centres = (cells + 0.5).astype(np.float32) * np.float32(size_m)
    # The core looks them up on all threads: queries would start threads of their own.
    return contents.field.occupied(torch.from_numpy(centres)).numpy()


def knowledge(
    contents: MapContents, points: Tensor, observed: Callable[[_Cells], NDArray[np.bool_]]
) -> tuple[_Floats, _Floats]:
    """The factor of a tile's weight at points (M, 3), local frame, m: (M,) in [0, 1], and its derivatives (M, 3), 1/m.

    It is the distance to the nearest leaf cell that another tile has observed and this one has not, in leaf cells and along
    the axis where it is largest, at most one; 0 outside of the cells that the tile observed. `observed`: which of the cells
    (K, 3), from the tile's origin, were observed by the tiles that they lie in, (K,) bool.
    """
    known, slopes = np.zeros(len(points)), np.zeros((len(points), 3))
    inside = np.flatnonzero(queries.occupied(contents, points).numpy())
    size_m = contents.field.table.leaf_size_m
    place = _places(points[torch.from_numpy(inside)], size_m)
    cell = np.floor(place)
    _, first, of_point = np.unique(
        cell_keys(points.numpy()[inside], size_m), return_index=True, return_inverse=True
    )
    cells = cell[first].astype(np.int64)
    seen = observed(cells)[of_point]
    inside, of_point, place, cell = inside[seen], of_point[seen], place[seen], cell[seen]
    around = (cells[:, None, :] + _STEPS).reshape(-1, 3)
    lacks = observed(around)
    lacks[lacks] = ~_holds(contents, around[lacks])
    lacks_near: NDArray[np.bool_] = lacks.reshape(-1, len(_STEPS))
    known[inside] = 1 - queries.INWARD
    near = np.any(lacks_near, axis=1)[of_point]
    inside, of_point = inside[near], of_point[near]
    below = (place - cell)[near].astype(np.float64)
    nearest, directions = np.ones(len(inside)), np.zeros((len(inside), 3))
    for step, lacked in zip(_STEPS, lacks_near.T, strict=True):
        to_cell = np.where(step < 0, below, 1 - below) * (step != 0)
        axis = to_cell.argmax(axis=1)
        distance = to_cell.max(axis=1)
        rows = np.flatnonzero(lacked[of_point] & (distance < nearest))
        nearest[rows] = distance[rows]
        directions[rows] = 0
        directions[rows, axis[rows]] = -step[axis[rows]]
    known[inside] = np.maximum(nearest - queries.INWARD, _LEAST_KNOWN)
    slopes[inside] = directions / size_m
    return known, slopes


def _places(points: Tensor, size_m: float) -> NDArray[np.float32]:
    """(M, 3) in leaf cells. Rounded as the core does it: in the same cell."""
    places: NDArray[np.float32] = points.numpy() * np.float32(1 / size_m)
    return places
