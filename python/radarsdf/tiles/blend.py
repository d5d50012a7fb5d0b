"""The fields of many tiles blended into one, with few tiles in memory."""

from __future__ import annotations

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

from radarsdf.checks import positive
from radarsdf.map import queries, storage
from radarsdf.map.contents import MapContents
from radarsdf.map.map import Map
from radarsdf.returns.sums import lattice_of
from radarsdf.tiles.plan import Plan, Tile, TilePlan, failure_of, is_done, map_path, neighbours

_MEMORY_BYTES = 1 << 30
_OF_FEATURES = 2.4  # bytes in memory per feature: measured; includes tables of cells and evidence
_Floats = NDArray[np.float64]


class Share(NamedTuple):
    """Contribution of one tile at some of N positions."""

    tile: Tile
    contents: MapContents  # the map of the tile
    rows: NDArray[np.int64]  # (M,) indices of the positions at which the tile has a weight
    weights: _Floats  # (M,) weights there
    local: Tensor  # (M, 3) the positions in the frame of the tile, m

    def at(self, points: Tensor, chosen: NDArray[np.bool_]) -> Share:
        """Restrict the share to some (M,) of its positions; `points` (M, 3) are their local coordinates."""
        local = points[torch.from_numpy(chosen)]
        return self._replace(rows=self.rows[chosen], weights=self.weights[chosen], local=local)


class TileBlend(Map):
    """Queries of :class:`TiledMap`: weighted averages of the tiles that know a position."""

    def __init__(self, folder: str | PathLike[str], *, memory_bytes: float = _MEMORY_BYTES) -> None:
        self.folder = Path(folder)
        self.plan = Plan.load(self.folder)
        self.memory_bytes = positive(memory_bytes, "memory_bytes")
        self._held: OrderedDict[Tile, tuple[MapContents, int]] = OrderedDict()
        self._lock = threading.Lock()
        if not self.tiles:
            msg = f"no tile of {self.folder} is done: run radarsdf tiles fit {self.folder}"
            raise ValueError(msg)

    @cached_property
    def tiles(self) -> list[TilePlan]:
        """Tiles that were done at the first access."""
        return [tile for tile in self.plan.tiles if is_done(self.folder, self.plan, tile)]

    @property
    def missing(self) -> dict[str, str]:
        """Unfinished tiles by name, with the reason of the failure; empty if the fit was not tried or was killed."""
        return {
            tile.name: failure_of(self.folder, tile) for tile in self.plan.tiles if not self.has(tile.tile)
        }

    @cached_property
    def _done(self) -> set[Tile]:
        return {tile.tile for tile in self.tiles}

    def has(self, tile: Tile) -> bool:
        """Whether this tile exists and is done."""
        return tile in self._done

    @cached_property
    def contents_of_any(self) -> MapContents:
        """The map of any tile, for what all have in common."""
        return self.contents_of(self.tiles[0].tile)

    @property
    def _contents_of_any(self) -> MapContents:
        return self.contents_of_any

    def contents_of(self, tile: Tile) -> MapContents:
        """The map of a finished tile, cached in memory."""
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
        """(C, 3) leaf cells, by lattice indices, of the map of one finished tile that lie in another one."""
        keys = storage.load_leaf_keys(map_path(self.folder, self.plan.by_tile[of]))
        cells = lattice_of(keys).astype(np.int64) + self.plan.origin_cells(of)
        inside: NDArray[np.bool_] = (cells[:, :2] // self.plan.tile_cells == within).all(axis=1)
        return cells[inside]

    def _shares(self, world: _Floats) -> Iterator[Share]:
        """Yield the shares of tiles at positions (N, 3), world, m, in ascending order, which fixes the bits of sums."""
        # Weights depend only on the borders between tiles, not on what a tile observed.
        grid = self.plan.grid
        places = world[np.isfinite(world).all(axis=1), :2]
        if len(places) == 0:
            return
        reach_m = np.array([-grid.halo_m / 2, grid.tile_m + grid.halo_m / 2])
        for planned in self.tiles:
            first, last = grid.lower_corner(planned.tile) + reach_m[:, None]
            if (first > places.max(axis=0)).any() or (last < places.min(axis=0)).any():
                continue
            rows = grid.within_half_a_halo(planned.tile, world)
            if len(rows):
                contents = self.contents_of(planned.tile)
                local = queries.to_local(contents, torch.from_numpy(world[rows]))
                yield Share(planned.tile, contents, rows, grid.weights(planned.tile, world[rows]), local)

    def _seen(self, world: _Floats) -> NDArray[np.bool_]:
        """(N,) whether positions (N, 3), world, m, are in observed leaf cells, or on their border."""
        # Tiles disagree, because ghosts depend on surfaces in front of them. The tile that contains a position decides; for
        # an unfinished one, its neighbours do.
        found = np.zeros(len(world), bool)
        for share in self._shares(world):
            _, inside = queries.into_cells(share.contents, share.local)
            owners = self.plan.grid.tiles_of(world[share.rows])
            for tile in neighbours(share.tile):
                if tile == share.tile or not self.has(tile):
                    found[share.rows] |= inside.numpy() & (owners == tile).all(axis=1)
        return found

    def _known_shares(self, world: _Floats, extrapolate: bool) -> Iterator[Share]:
        """Yield the shares of tiles that observed a position, where any did. `extrapolate`: elsewhere, those of all tiles."""
        seen = self._seen(world)
        unseen = ~seen & np.isfinite(world).all(axis=1) & extrapolate
        for share in self._shares(world):
            points, inside = queries.into_cells(share.contents, share.local)
            yield share.at(points, (inside.numpy() & seen[share.rows]) | unseen[share.rows])

    def _average(
        self, world: Tensor, extrapolate: bool, of_tile: Callable[[Share], Tensor], columns: int = 1
    ) -> Tensor:
        positions = _contiguous(world)
        shares = self._known_shares(positions, extrapolate)
        return torch.from_numpy(_averages(shares, len(positions), of_tile, columns))

    def _sdf(self, world: Tensor, extrapolate: bool) -> Tensor:
        return self._average(world, extrapolate, _distance)[:, 0]

    def _gradient(self, world: Tensor, extrapolate: bool) -> Tensor:
        return self._average(
            world, extrapolate, lambda share: queries.gradient(share.contents, share.local), columns=3
        )

    def _observed(self, world: Tensor) -> Tensor:
        return torch.from_numpy(self._seen(_contiguous(world)))

    def _intensity(self, world: Tensor, sensors: Tensor, extrapolate: bool) -> Tensor:
        def of_tile(share: Share) -> Tensor:
            there = queries.to_local(share.contents, sensors[torch.from_numpy(share.rows)])
            predicted = partial(queries.intensity, share.contents, extrapolate=extrapolate)
            return queries.where(there.isfinite().all(dim=1), share.local, there, function=predicted)

        return self._average(world, extrapolate, of_tile)[:, 0]

    def evidence_at(self, world: Tensor) -> queries.EvidenceAt:
        """All tiles contribute, because evidence ends smoothly at each: a tile that observed no returns lowers it."""
        positions = _contiguous(world)

        def of_tile(share: Share) -> Tensor:
            return torch.stack(list(queries.evidence(share.contents, share.local)), 1)

        found = np.nan_to_num(_averages(self._shares(positions), len(positions), of_tile, columns=4))
        return queries.EvidenceAt(*torch.from_numpy(found).float().unbind(1))

    def distances_at(self, lattice: NDArray[np.int64], voxel_m: float) -> NDArray[np.float32]:
        """(K,) signed distances at corners (K, 3) of voxels that divide leaf cells, indexed from the lattice's first corner.

        The bits do not depend on the calling tile. NaN where no tile has an adjacent cell.
        """
        steps = round(self.config.leaf_size_m / voxel_m)

        def touching() -> Iterator[Share]:
            for share in self._shares(self.config.lattice.position(lattice / steps)):
                # Computed from integers: the same float32 position for every calling tile.
                origin = self.plan.origin_cells(share.tile) * steps
                points = torch.from_numpy(((lattice[share.rows] - origin) * voxel_m).astype(np.float32))
                # A corner on the border of the map may be in an outer cell, which has no features.
                points, inside = queries.into_cells(share.contents, points, voxel_m)
                yield share.at(points, inside.numpy())

        return _averages(touching(), len(lattice), _distance)[:, 0].astype(np.float32)


def _averages(
    shares: Iterable[Share], count: int, of_tile: Callable[[Share], Tensor], columns: int = 1
) -> _Floats:
    """(N, columns) weighted averages of the values of tiles, (M, columns) each, at `count` positions. NaN without a share."""
    sums, totals = np.zeros((count, columns)), np.zeros(count)
    for share in shares:
        values = of_tile(share).numpy().astype(np.float64).reshape(-1, columns)
        known = ~np.isnan(values[:, 0])  # a tile may lack a view that its neighbour has
        sums[share.rows[known]] += share.weights[known, None] * values[known]
        totals[share.rows[known]] += share.weights[known]
    with np.errstate(invalid="ignore", divide="ignore"):
        found: _Floats = sums / totals[:, None]
    return found


def _distance(share: Share) -> Tensor:
    return queries.signed_distance(share.contents, share.local)


def _contiguous(world: Tensor) -> _Floats:
    return np.ascontiguousarray(world.double().numpy())
