# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""One map that answers from many tiles, of which few are in memory."""

from __future__ import annotations

import shutil
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator
from functools import cached_property, partial
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from radarsdf.checks import path_of, positive
from radarsdf.map import queries, storage
from radarsdf.map.contents import MapContents
from radarsdf.map.map import Map
from radarsdf.map.radar_map import load_file
from radarsdf.returns.rays import Rays
from radarsdf.returns.sums import lattice_of
from radarsdf.returns.view_statistics import EchoesAt
from radarsdf.tiles.plan import Plan, Tile, TilePlan, failure_of, is_done, map_path, neighbours, report_of

if TYPE_CHECKING:
    import trimesh

    from radarsdf.map.threshold import Threshold
    from radarsdf.map.view import ViewedMap

_MEMORY_BYTES = 1 << 30
_OF_FEATURES = 2.4  # bytes in memory for each of the features: measured; tables of cells, evidence
_Floats = NDArray[np.float64]


class Share(NamedTuple):
    """What one tile contributes at some of N positions."""

    tile: Tile
    contents: MapContents  # the map of the tile
    rows: NDArray[np.int64]  # (M,) of the positions at which the tile has a weight
    weights: _Floats  # (M,) there
    local: Tensor  # (M, 3) the positions in the frame of the tile, m

    def at(self, points: Tensor, chosen: NDArray[np.bool_]) -> Share:
        """The share at some (M,) of its positions, of which the local `points` (M, 3) are these."""
        local = points[torch.from_numpy(chosen)]
        return self._replace(rows=self.rows[chosen], weights=self.weights[chosen], local=local)


class TiledMap(Map):
    """A map in tiles, made by :func:`radarsdf.fit_tiles` or ``radarsdf.load(folder)``.

    It has the methods of :class:`Map`. Where tiles overlap, their fields are averaged with weights that fall smoothly to zero,
    so that neither surface, gradient nor intensity has a seam. Tiles are read when they are needed.

    Parameters
    ----------
    folder : path-like
        Where the plan and the maps are.
    memory_bytes : float
        Memory for tiles, about, bytes. One tile at a time is always held.

    Raises
    ------
    ValueError, OSError
        If the plan is damaged, no tile is done, or it cannot be read.
    """

    _viewed: tuple[list[Tile], ViewedMap] | None = None

    def __init__(self, folder: str | PathLike[str], *, memory_bytes: float = _MEMORY_BYTES) -> None:
        self.folder = Path(folder)
        self.plan = Plan.load(self.folder)
        self.memory_bytes = positive(memory_bytes, "memory_bytes")
        self._held: OrderedDict[Tile, tuple[MapContents, int]] = OrderedDict()
        self._lock = threading.Lock()
        if not self.tiles:
            msg = f"no tile of {self.folder} is done: radarsdf tiles fit {self.folder} makes them"
            raise ValueError(msg)

    @cached_property
    def tiles(self) -> list[TilePlan]:
        """The tiles that were done when they were first asked for."""
        return [tile for tile in self.plan.tiles if is_done(self.folder, self.plan, tile)]

    @property
    def missing(self) -> dict[str, str]:
        """The others by name, and why their fit failed; empty if it was not tried or was killed."""
        return {
            tile.name: failure_of(self.folder, tile) for tile in self.plan.tiles if not self.has(tile.tile)
        }

    @cached_property
    def _done(self) -> set[Tile]:
        return {tile.tile for tile in self.tiles}

    def has(self, tile: Tile) -> bool:
        """Whether there is such a tile, and it is done."""
        return tile in self._done

    @cached_property
    def contents_of_any(self) -> MapContents:
        """The map of a tile, for what all have in common."""
        return self.contents_of(self.tiles[0].tile)

    @property
    def _contents_of_any(self) -> MapContents:
        return self.contents_of_any

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

    def __repr__(self) -> str:
        kind = "surface and reflectance" if self.has_intensity else "surface"
        return (
            f"TiledMap({kind}, {len(self.tiles)} of {len(self.plan.tiles)} tiles of {self.plan.tile_m:g} m)"
        )

    def __reduce__(self) -> tuple[Callable[..., TiledMap], tuple[Any, ...]]:
        return partial(TiledMap, memory_bytes=self.memory_bytes), (str(self.folder),)

    def mesh(
        self,
        voxel_size: float = queries.VOXEL_M,
        *,
        box: ArrayLike | None = None,
        viewpoint: ArrayLike | None = None,
        progress: bool | None = None,
        **limits: Any,
    ) -> trimesh.Trimesh:
        """Extract the surface as one mesh, without gaps or doubled triangles between tiles.

        The triangles of tiles stay in the folder, so that another mesh of the same `voxel_size` and `box` is quick.

        Parameters
        ----------
        voxel_size : float
            Edge of a voxel, m. It must divide the edge of a leaf cell.
        box, viewpoint, progress, **limits
            As of :meth:`Map.mesh`.

        Returns
        -------
        trimesh.Trimesh
            World frame, m, with the attributes and metadata of :meth:`Map.mesh`.

        Raises
        ------
        ValueError
            If an argument is out of range, or a tile could not be meshed.
        MemoryError
            If memory cannot hold the mesh: :meth:`export` writes 3D Tiles one after another.
        """
        return self._mesh_seen_from(viewpoint, voxel_size, box=box, progress=progress, **limits)

    def _surface_mesh(self, voxel_size: float, **wanted: Any) -> trimesh.Trimesh:
        from radarsdf.tiles.mesh import mesh_of  # noqa: PLC0415 - trimesh is slow to import

        return mesh_of(self, voxel_size, **wanted)

    def cells_round(self, lower: _Floats, upper: _Floats) -> queries.CellsInBox:
        """Each cell is that of the tile that it lies in; of a tile that is not done, unknown."""
        lattice, edge = self.config.lattice, self.plan.tile_cells
        first = np.floor(lattice.cells(lower)).astype(np.int64)
        last = np.floor(lattice.cells(upper)).astype(np.int64) + 1
        shape = tuple((last - first).tolist())
        passed, returns, observed = np.zeros(shape, np.uint8), np.zeros(shape, bool), np.zeros(shape, bool)
        for planned in self.tiles:
            own = np.array(planned.tile) * edge
            start = np.array([*np.maximum(own, first[:2]), first[2]])
            stop = np.array([*np.minimum(own + edge, last[:2]), last[2]])
            if (start < stop).all():
                x, y, z = (stop - start).tolist()
                here = start - self.plan.origin_cells(planned.tile)
                found = queries.dense_cells(self.contents_of(planned.tile), here, (x, y, z))
                place = tuple(slice(a, b) for a, b in zip(start - first, stop - first, strict=True))
                passed[place], returns[place], observed[place] = found
        return queries.CellsInBox(lattice.position(first), passed, returns, observed)

    def echoes(self) -> EchoesAt:
        """Each echo is that of the tile that it lies in."""
        scale = self.intensity_scale
        ends = (0.0, 1.0) if scale is None else (scale.low, scale.high)
        found = []
        for planned in self.tiles:
            contents = self.contents_of(planned.tile)
            echoes = contents.echoes.in_world(contents.origin, *ends)
            cells = np.floor(self.config.lattice.cells(echoes.points)[:, :2])
            found.append(echoes.select((cells // self.plan.tile_cells == planned.tile).all(axis=1)))
        return EchoesAt.together(found)

    def _viewed_from(self, position: _Floats, range_m: float) -> ViewedMap:
        from radarsdf.tiles.mesh import viewed_tiles  # noqa: PLC0415 - as above

        tiles = []
        for planned in self.tiles:
            lower = self.plan.grid.lower_corner(planned.tile)
            nearest = np.clip(position[:2], lower, lower + self.plan.tile_m)
            if np.linalg.norm(nearest - position[:2]) <= range_m:
                tiles.append(planned.tile)
        tiles = tiles or [self.tiles[0].tile]  # of a pose far away from all, any will do to see nothing
        if self._viewed is None or self._viewed[0] != tiles:
            self._viewed = tiles, viewed_tiles(self, tiles)
        return self._viewed[1]

    def export(
        self,
        path: str | PathLike[str],
        voxel_size: float = queries.VOXEL_M,
        *,
        progress: bool | None = None,
        **limits: Any,
    ) -> tuple[int, int]:
        """Write the mesh to one file, or as 3D Tiles, of which one tile at a time is in memory.

        Parameters
        ----------
        path : path-like
            ``NAME.json``: 3D Tiles 1.1, a GLB file for each tile in a folder ``NAME`` next to it, in the frame of the world. To
            place it on the earth, set the ``transform`` of its root. Small components that reach into the next tile stay.
            Another suffix: one file, as of :func:`radarsdf.io.write_mesh`.
        voxel_size, progress, **limits
            As of :meth:`mesh`; also its `box`.

        Returns
        -------
        tuple
            Numbers of vertices and triangles. In 3D Tiles, vertices on borders are in both tiles.

        Raises
        ------
        ValueError, MemoryError
            As of :meth:`mesh`, or if the suffix is another, or there is no surface for 3D Tiles.
        OSError
            If a file cannot be written.
        """
        from radarsdf.tiles.mesh import export_mesh  # noqa: PLC0415 - as above

        return export_mesh(self, path, voxel_size, progress, **limits)

    def threshold(
        self, voxel_size: float = queries.VOXEL_M, *, progress: bool | None = None, **limits: Any
    ) -> Threshold:
        """Expected precision and coverage of a mesh, by tile: no mesh of the whole map is made.

        Parameters
        ----------
        voxel_size, progress, **limits
            As of :meth:`mesh`; also its `box`.

        Returns
        -------
        Threshold
            The confidence that :meth:`mesh` applies, and the shares that its ``metadata`` holds.
        """
        from radarsdf.tiles.mesh import parts_of  # noqa: PLC0415 - as above

        return parts_of(self, voxel_size, progress, **limits)[2]

    def save(self, path: str | PathLike[str]) -> None:
        """Copy the plan and the maps of the tiles that are done to a new folder, which :func:`radarsdf.load` reads.

        Parameters
        ----------
        path : path-like
            The folder. The rays of the tiles are not copied.

        Raises
        ------
        OSError
            If the folder exists, or cannot be written.
        """
        folder = path_of(path, "path")
        folder.mkdir()
        for tile in self.tiles:
            copy = map_path(folder, tile)
            copy.parent.mkdir(parents=True)
            shutil.copyfile(map_path(self.folder, tile), copy)
        self.plan.save(folder)  # last: without it, the folder is no map

    @property
    def origin(self) -> _Floats:
        """(3,) that of the tile in the middle, world, m, for those who need coordinates near zero."""
        return self.config.lattice.position(self.tiles[len(self.tiles) // 2].origin_cells)

    @cached_property
    def report(self) -> dict[str, Any]:
        """Counts, noise of the sensor, parts of the method that were skipped, and seconds, of all fits together.

        `missing_tiles`: names.
        """
        reports = [report_of(self.folder, tile) for tile in self.tiles]
        timed = [
            name for name, value in reports[0].items() if name.endswith("_s") and isinstance(value, float)
        ]
        return {
            "tiles": len(reports),
            "missing_tiles": list(self.missing),
            "scans": self.plan.scans,
            "returns": sum(tile.returns for tile in self.plan.tiles),
            "leaf_cells": self.num_cells,
            "noise": reports[0].get("noise"),
            "skipped": list(dict.fromkeys(step for report in reports for step in report.get("skipped", []))),
            **{name: sum(report.get(name, 0.0) for report in reports) for name in timed},
        }

    @cached_property
    def num_cells(self) -> int:
        """Number of leaf cells, each of them in the tile that it lies in."""
        return sum(len(self.leaf_cells(tile.tile, tile.tile)) for tile in self.tiles)

    @cached_property
    def extent(self) -> _Floats:
        """(2, 3) lower and upper corner of all leaf cells, world, m."""
        of_tiles = [cells for tile in self.tiles if len(cells := self.leaf_cells(tile.tile, tile.tile))]
        lower = np.min([cells.min(axis=0) for cells in of_tiles], axis=0)
        upper = np.max([cells.max(axis=0) for cells in of_tiles], axis=0)
        return self.config.lattice.position(np.stack([lower, upper + 1]))

    @property
    def file_bytes(self) -> int:
        """Size of the files of the tiles, bytes."""
        return sum(map_path(self.folder, tile).stat().st_size for tile in self.tiles)

    def leaf_cells(self, of: Tile, within: Tile) -> NDArray[np.int64]:
        """(C, 3) leaf cells, as the lattice numbers them, of the map of one tile that is done, which lie in another."""
        keys = storage.load_leaf_keys(map_path(self.folder, self.plan.by_tile[of]))
        cells = lattice_of(keys).astype(np.int64) + self.plan.origin_cells(of)
        inside: NDArray[np.bool_] = (cells[:, :2] // self.plan.tile_cells == within).all(axis=1)
        return cells[inside]

    def _shares(self, world: _Floats) -> Iterator[Share]:
        """The contribution of each tile at positions (N, 3), world, m: in ascending order, on which the bits of sums depend.

        Weights depend on the borders between tiles alone, not on what a tile observed.
        """
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
        """(N,) whether positions (N, 3), world, m, are in observed leaf cells, or on their border.

        The tile that a position lies in decides, because tiles disagree: which returns are ghosts depends on surfaces before
        them, of which a neighbour may have few returns. In the place of one that is not done, its neighbours do.
        """
        found = np.zeros(len(world), bool)
        for share in self._shares(world):
            _, inside = queries.into_cells(share.contents, share.local)
            owners = self.plan.grid.tiles_of(world[share.rows])
            for tile in neighbours(share.tile):
                if tile == share.tile or not self.has(tile):
                    found[share.rows] |= inside.numpy() & (owners == tile).all(axis=1)
        return found

    def _known_shares(self, world: _Floats, extrapolate: bool) -> Iterator[Share]:
        """The shares of the tiles that observed a position, where it was seen. `extrapolate`: elsewhere, all of them."""
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
            predicted = partial(queries.intensity, share.contents)
            return queries.where(there.isfinite().all(dim=1), share.local, there, function=predicted)

        return self._average(world, extrapolate, of_tile)[:, 0]

    def evidence_at(self, world: Tensor) -> queries.EvidenceAt:
        """All tiles count, because each one's evidence ends smoothly: less is known where a tile that looked has no returns."""
        positions = _contiguous(world)

        def of_tile(share: Share) -> Tensor:
            return torch.stack(list(queries.evidence(share.contents, share.local)), 1)

        found = np.nan_to_num(_averages(self._shares(positions), len(positions), of_tile, columns=3))
        return queries.EvidenceAt(*torch.from_numpy(found).float().unbind(1))

    def distances_at(self, lattice: NDArray[np.int64], voxel_m: float) -> NDArray[np.float32]:
        """(K,) signed distances at corners (K, 3) of voxels that divide leaf cells, numbered from the lattice's first corner.

        They have the same bits whichever tile asks. NaN where no tile has an adjacent cell.
        """
        steps = round(self.config.leaf_size_m / voxel_m)

        def touching() -> Iterator[Share]:
            for share in self._shares(self.config.lattice.position(lattice / steps)):
                # From integers: the same float32 position for every tile that asks.
                origin = self.plan.origin_cells(share.tile) * steps
                points = torch.from_numpy(((lattice[share.rows] - origin) * voxel_m).astype(np.float32))
                # A corner on the border of the map may be in a cell beyond it, which has no features.
                points, inside = queries.into_cells(share.contents, points, voxel_m)
                yield share.at(points, inside.numpy())

        return _averages(touching(), len(lattice), _distance)[:, 0].astype(np.float32)


def load(path: str | PathLike[str]) -> Map:
    """Read a map: a file of :meth:`Map.save`, or a folder of :func:`fit_tiles`. Nothing in it is executed.

    Parameters
    ----------
    path : path-like
        Written by this version.

    Returns
    -------
    RadarMap or TiledMap
        Its results have the same bits as those of the map that was written.

    Raises
    ------
    ValueError, OSError
        If it is no radarsdf map, is damaged, comes from another version, or cannot be read.
    """
    path = path_of(path, "path")
    return TiledMap(path) if path.is_dir() else load_file(path)


def lacking(radar_map: Map) -> str:
    """How many tiles a map lacks, as a phrase; empty if none."""
    if not isinstance(radar_map, TiledMap) or not (missing := radar_map.missing):
        return ""
    return f"{len(missing)} of {len(radar_map.plan.tiles)} tiles"


def predicted(radar_map: Map, rays: Rays) -> tuple[Rays, NDArray[np.float64]]:
    """The intensities (N,) that a map predicts for rays, sensor units, and these rays: those in no tile are left out."""
    found = np.asarray(radar_map.intensity(*rays.in_world(), extrapolate=True), np.float64)
    known = np.isfinite(found)
    return (rays, found) if known.all() else (rays.select(np.flatnonzero(known)), found[known])


def _averages(
    shares: Iterable[Share], count: int, of_tile: Callable[[Share], Tensor], columns: int = 1
) -> _Floats:
    """(N, columns) weighted averages of the values of tiles, (M, columns) each, at `count` positions. NaN without a share."""
    sums, totals = np.zeros((count, columns)), np.zeros(count)
    for share in shares:
        values = of_tile(share).numpy().astype(np.float64).reshape(-1, columns)
        sums[share.rows] += share.weights[:, None] * values
        totals[share.rows] += share.weights
    with np.errstate(invalid="ignore", divide="ignore"):
        found: _Floats = sums / totals[:, None]
    return found


def _distance(share: Share) -> Tensor:
    return queries.signed_distance(share.contents, share.local)


def _contiguous(world: Tensor) -> _Floats:
    return np.ascontiguousarray(world.double().numpy())
