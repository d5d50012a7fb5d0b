"""The fields of many tiles blended into one, with few tiles in memory."""

import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np

from radarsdf.arrays import Array, Bools, Floats, Floats32, Ints
from radarsdf.checks import AnyPath, check, positive
from radarsdf.map import queries
from radarsdf.map.confidence import EvidenceAt, evidence
from radarsdf.map.map import Map, Query
from radarsdf.map.queries import MapContents
from radarsdf.map.radar_map import load_contents, load_leaf_keys
from radarsdf.returns.sums import lattice_of
from radarsdf.tiles.plan import Plan, TilePlan, failure_of, is_done, map_path

_MEMORY_BYTES = 1 << 30
_OF_FEATURES = 2.4  # bytes in memory per feature: measured; includes tables of cells and evidence


class Share(NamedTuple):
    """Contribution of one tile at some of N positions."""

    tile: TilePlan
    contents: MapContents  # the map of the tile
    rows: Ints  # (M,) indices of the positions at which the tile has a weight
    weights: Floats  # (M,) weights there
    local: Floats32  # (M, 3) the positions in the frame of the tile, m


class TileBlend(Map):
    """Queries of :class:`TiledMap`: weighted averages of the tiles that know a position."""

    def __init__(self, folder: AnyPath, *, memory_bytes: float = _MEMORY_BYTES) -> None:
        self.folder = Path(folder)
        self.plan = Plan.load(self.folder)
        self.memory_bytes = positive(memory_bytes, "memory_bytes")
        self._held: OrderedDict[TilePlan, tuple[MapContents, int]] = OrderedDict()
        self._lock = threading.Lock()
        check(self.tiles, f"no tile of {self.folder} is done: run radarsdf tiles fit {self.folder}")

    @cached_property
    def tiles(self) -> list[TilePlan]:
        """Tiles that were done at the first access."""
        return [tile for tile in self.plan.tiles if is_done(self.folder, self.plan, tile)]

    @property
    def missing(self) -> dict[str, str]:
        """Unfinished tiles by name, with the reason of the failure; empty if the fit was not tried or was killed."""
        done = set(self.tiles)
        return {tile.name: failure_of(self.folder, tile) for tile in self.plan.tiles if tile not in done}

    def neighbours(self, tile: TilePlan) -> list[TilePlan]:
        """A finished tile and those of its eight neighbours that are done, in ascending order."""
        away_m = np.abs(self.corners_m - self.plan.grid.lower_corner(tile.tile)).max(axis=1)
        return [self.tiles[i] for i in np.flatnonzero(away_m < 1.5 * self.plan.tile_m)]

    @cached_property
    def contents_of_any(self) -> MapContents:
        return self.contents_of(self.tiles[0])

    def contents_of(self, tile: TilePlan) -> MapContents:
        """The map of a finished tile, cached in memory."""
        with self._lock:
            if tile not in self._held:
                contents = load_contents(map_path(self.folder, tile))
                size = round(_OF_FEATURES * sum(p.nbytes for p in contents.field.parameters()))
                while self._held and sum(n for _, n in self._held.values()) + size > self.memory_bytes:
                    self._held.popitem(last=False)
                self._held[tile] = contents, size
            self._held.move_to_end(tile)
            return self._held[tile][0]

    def leaf_cells(self, of: TilePlan, within: TilePlan) -> Ints:
        """(C, 3) leaf cells, by lattice indices, of the map of one finished tile that lie in another one."""
        cells = lattice_of(load_leaf_keys(map_path(self.folder, of))).astype(np.int64) + of.origin_cells
        return cells[(cells[:, :2] // self.plan.tile_cells == within.tile).all(axis=1)]

    def _shares(self, world: Floats) -> Iterator[Share]:
        """Yield the shares of tiles at positions (N, 3), world, m, in ascending order, which fixes the bits of sums."""
        return (self._share(world, *near) for near in self._near(world))

    def _share(self, world: Floats, tile: TilePlan, rows: Ints) -> Share:
        contents, x = self.contents_of(tile), world[rows]
        # Weights depend only on the borders between tiles, not on what a tile observed.
        weights = self.plan.grid.weights(tile.tile, x)
        return Share(tile, contents, rows, weights, queries.to_local(contents, x))

    def _near(self, world: Floats) -> Iterator[tuple[TilePlan, Ints]]:
        """Yield the tiles with a weight at any of the positions (N, 3), world, m, and the rows (M,) of these."""
        grid, places = self.plan.grid, world[np.isfinite(world).all(axis=1), :2]
        if len(places) == 0:
            return
        reach_m = grid.halo_m / 2
        first, last = self.corners_m - reach_m, self.corners_m + (grid.tile_m + reach_m)
        near = ((first <= places.max(axis=0)) & (last >= places.min(axis=0))).all(axis=1)
        for i in np.flatnonzero(near).tolist():
            if len(rows := grid.within_half_a_halo(self.tiles[i].tile, world)):
                yield self.tiles[i], rows

    @cached_property
    def corners_m(self) -> Floats:
        """(T, 2) lower corners of the tiles, world."""
        return np.array([self.plan.grid.lower_corner(tile.tile) for tile in self.tiles])

    def _known_shares(self, world: Floats, seen: Bools) -> Iterator[Share]:
        """Yield the shares of tiles in whose leaf cells, or on their border, positions (N, 3), world, m, are. Set `seen` (N,)."""
        # Ghosts depend on surfaces in front of them, so tiles disagree: that of a position decides, or else its neighbours.
        near, owners = list(self._near(world)), np.full(len(world), -1)
        for number, (tile, rows) in enumerate(near):
            owners[rows[(self.plan.grid.tiles_of(world[rows]) == tile.tile).all(axis=1)]] = number
        for number, (tile, rows) in enumerate(near):
            share, owner = self._share(world, tile, rows), owners[rows]
            inside = queries.into_cells(share.contents, share.local)
            seen[rows] |= inside & ((owner == number) | (owner < 0))
            weights, local = share.weights[inside], share.local[inside]
            yield share._replace(rows=rows[inside], weights=weights, local=local)

    def _evaluate(self, query: Query, world: Floats, *others: Floats, extrapolate: bool) -> Array:
        def of_tile(share: Share) -> Array:
            rest = [queries.to_local(share.contents, x[share.rows]) for x in others]
            known = np.isfinite(np.concatenate([share.local, *rest], axis=1)).all(axis=1)
            return queries.where(known, query, share.contents, share.local, *rest)

        count, seen, columns = len(world), np.zeros(len(world), bool), 4 if query is queries.plane else 1
        found = _averages(self._known_shares(world, seen), count, of_tile, columns)
        found[~seen] = np.nan
        if extrapolate and not seen.all():
            rest = self._shares(np.where(seen[:, None], np.nan, world))

            def of_moved(share: Share) -> Array:
                queries.into_cells(share.contents, share.local)
                return of_tile(share)

            found[~seen] = _averages(rest, count, of_moved, columns)[~seen]
        return found if columns > 1 else found[:, 0]

    def _observed(self, world: Floats) -> Bools:
        seen = np.zeros(len(world), bool)
        list(self._known_shares(world, seen))  # sets `seen`
        return seen

    def evidence_at(self, world: Floats) -> EvidenceAt:
        """All tiles contribute, because evidence ends smoothly at each: a tile that observed no returns lowers it."""

        def of_tile(share: Share) -> Floats32:
            return np.stack(evidence(share.contents, share.local), axis=1)

        found = np.nan_to_num(_averages(self._shares(world), len(world), of_tile, columns=4))
        return EvidenceAt(*found.astype(np.float32).T)

    def distances_at(self, lattice: Ints, voxel_m: float) -> Floats32:
        """(K,) signed distances at corners (K, 3) of voxels that divide leaf cells, indexed from the lattice's first corner.

        The bits do not depend on the calling tile. NaN where no tile has an adjacent cell.
        """
        steps = round(self.config.leaf_size_m / voxel_m)

        def of_tile(share: Share) -> Floats32:
            # Computed from integers: the same float32 position for every calling tile.
            origin = np.array(share.tile.origin_cells) * steps
            points = ((lattice[share.rows] - origin) * voxel_m).astype(np.float32)
            # A corner on the border of the map may be in an outer cell, which has no features.
            inside = queries.into_cells(share.contents, points, voxel_m)
            return queries.where(inside, queries.signed_distance, share.contents, points)

        shares = self._shares(self.config.lattice.position(lattice / steps))
        return _averages(shares, len(lattice), of_tile)[:, 0].astype(np.float32)


def _averages(
    shares: Iterable[Share], count: int, of_tile: Callable[[Share], Array], columns: int = 1
) -> Floats:
    """(N, columns) weighted averages of the values of tiles, (M, columns) each, at `count` positions. NaN without a share."""
    sums, totals = np.zeros((count, columns)), np.zeros(count)
    for share in shares:
        values = of_tile(share).astype(np.float64).reshape(-1, columns)
        known = ~np.isnan(values[:, 0])  # a tile may lack a view that its neighbour has
        sums[share.rows[known]] += share.weights[known, None] * values[known]
        totals[share.rows[known]] += share.weights[known]
    with np.errstate(invalid="ignore", divide="ignore"):
        return sums / totals[:, None]
