# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""One map that answers from many tiles, of which few are in memory."""

from __future__ import annotations

import itertools
import shutil
from collections.abc import Callable
from concurrent.futures import Executor
from functools import cached_property, partial
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from radarsdf.checks import path_of
from radarsdf.map import queries, storage
from radarsdf.map.contents import MapContents
from radarsdf.map.map import Map
from radarsdf.map.radar_map import load_file
from radarsdf.returns.rays import Rays
from radarsdf.returns.view_statistics import EchoesAt
from radarsdf.tiles.blend import Share, TileBlend, averages, distance
from radarsdf.tiles.drive_poses import DrivePoses
from radarsdf.tiles.plan import Tile, map_path, report_of
from radarsdf.tiles.planning import rays_path

if TYPE_CHECKING:
    import trimesh

    from radarsdf.map.threshold import Threshold
    from radarsdf.map.view import ViewedMap

_Floats = NDArray[np.float64]


class TiledMap(TileBlend, Map):
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
    ValueError
        If the plan is damaged, or no tile is done.
    OSError
        If it cannot be read.
    """

    _viewed: tuple[list[Tile], ViewedMap] | None = None

    def __repr__(self) -> str:
        kind = "surface and reflectance" if self.has_intensity else "surface"
        return (
            f"TiledMap({kind}, {len(self.tiles)} of {len(self.plan.tiles)} tiles of {self.plan.tile_m:g} m)"
        )

    def __reduce__(self) -> tuple[Callable[..., TiledMap], tuple[Any, ...]]:
        return partial(TiledMap, memory_bytes=self.memory_bytes), (str(self.folder),)

    def _sdf(self, world: Tensor, extrapolate: bool) -> Tensor:
        positions = _contiguous(world)
        shares = self.known_shares(positions, extrapolate=extrapolate)
        return torch.from_numpy(averages(shares, len(positions), distance)[:, 0])

    def _gradient(self, world: Tensor, extrapolate: bool) -> Tensor:
        return self._plane_at(world, extrapolate)[1]

    def plane_at(self, world: Tensor) -> tuple[Tensor, Tensor]:
        return self._plane_at(world, False)

    def _plane_at(self, world: Tensor, extrapolate: bool) -> tuple[Tensor, Tensor]:
        positions = _contiguous(world)
        count = len(positions)
        # Of the quotient of two sums, of w f and of w: the weights change with the position, too.
        sums, distances, slopes = np.zeros((count, 4)), np.zeros((count, 3)), np.zeros((count, 3))
        totals = np.zeros(count)
        for share in self.known_shares(positions, extrapolate=extrapolate):
            gradients = queries.gradient(share.contents, share.local).numpy().astype(np.float64)
            values = np.column_stack([distance(share), gradients])
            sums[share.rows] += share.weights[:, None] * values
            totals[share.rows] += share.weights
            distances[share.rows] += values[:, :1] * share.slopes
            slopes[share.rows] += share.slopes
        with np.errstate(invalid="ignore", divide="ignore"):
            means = sums / totals[:, None]
            found = means[:, 1:] + (distances - means[:, :1] * slopes) / totals[:, None]
        return torch.from_numpy(means[:, 0]), torch.from_numpy(found)

    def _observed(self, world: Tensor) -> Tensor:
        return torch.from_numpy(self.seen(_contiguous(world)))

    @property
    def _contents_of_any(self) -> MapContents:
        return self.any_contents

    def _intensity(self, world: Tensor, sensors: Tensor, extrapolate: bool) -> Tensor:
        positions, places = _contiguous(world), _contiguous(sensors)

        def of_tile(share: Share) -> _Floats:
            there = queries.to_local(
                share.contents, torch.from_numpy(np.ascontiguousarray(places[share.rows]))
            )
            predicted = partial(queries.intensity, share.contents)
            values = queries.where(there.isfinite().all(dim=1), share.local, there, function=predicted)
            return values.numpy().astype(np.float64)[:, None]

        shares = self.known_shares(positions, extrapolate=extrapolate)
        return torch.from_numpy(averages(shares, len(positions), of_tile)[:, 0])

    def mesh(
        self,
        voxel_size: float = queries.VOXEL_M,
        *,
        box: ArrayLike | None = None,
        viewpoint: ArrayLike | None = None,
        executor: Executor | None = None,
        progress: bool | None = None,
        **limits: Any,
    ) -> trimesh.Trimesh:
        """Extracts the surface, without gaps or doubled triangles between tiles; arguments are those of :meth:`Map.mesh`.

        Each tile is a task for the `executor`. `voxel_size` must divide the leaf cell's edge. :meth:`export` writes a mesh
        that does not fit into memory.
        """
        return self._mesh_seen_from(
            viewpoint,
            voxel_size,
            box=box,
            **limits,
            executor=executor,
            progress=progress,
        )

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
        begin, end = first[:2] // edge, (last[:2] - 1) // edge
        for tile in itertools.product(range(begin[0], end[0] + 1), range(begin[1], end[1] + 1)):
            if not self.has(tile):
                continue
            own = np.array(tile) * edge
            start = np.array([*np.maximum(own, first[:2]), first[2]])
            stop = np.array([*np.minimum(own + edge, last[:2]), last[2]])
            place = tuple(slice(a, b) for a, b in zip(start - first, stop - first, strict=True))
            x, y, z = (stop - start).tolist()
            found = queries.dense_cells(
                self.contents_of(tile), start - self.plan.origin_cells(tile), (x, y, z)
            )
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

    def evidence_at(self, world: Tensor) -> queries.EvidenceAt:
        return self.evidence(_contiguous(world))

    def _viewed_from(self, position: _Floats, range_m: float) -> ViewedMap:
        from radarsdf.tiles.mesh import viewed_tiles  # noqa: PLC0415 - as above

        # Of a pose far away from all tiles, any will do to see nothing.
        tiles = self._tiles_within(position, range_m) or [self.tiles[0].tile]
        held = self._viewed
        if held is None or held[0] != tiles:

            def intensity(points: _Floats, sensor_position: _Floats) -> _Floats:
                found: _Floats = self.intensity(points, sensor_position, extrapolate=True)
                return found

            viewed = viewed_tiles(self, tiles, intensity if self.has_intensity else None)
            held = self._viewed = tiles, viewed
        return held[1]

    def _tiles_within(self, position: _Floats, range_m: float) -> list[Tile]:
        """The tiles that are done and within a horizontal range of a position (3,), world, m."""
        found = []
        for planned in self.plan.tiles:
            lower = self.plan.grid.lower_corner(planned.tile)
            nearest = np.clip(position[:2], lower, lower + self.plan.tile_m)
            if np.linalg.norm(nearest - position[:2]) <= range_m and self.has(planned.tile):
                found.append(planned.tile)
        return found

    def export(
        self,
        path: str | PathLike[str],
        voxel_size: float = queries.VOXEL_M,
        *,
        executor: Executor | None = None,
        progress: bool | None = None,
        **limits: Any,
    ) -> tuple[int, int]:
        """Writes the mesh tile by tile; arguments are those of :meth:`mesh`, without a viewpoint.

        Parameters
        ----------
        path : path-like
            ``NAME.ply``: one file, binary, in double precision. ``NAME.json``: 3D Tiles 1.1, a GLB file for each tile in a
            folder ``NAME`` next to it, in the frame of the world. To place it on the earth, set the ``transform`` of its root.

        Returns
        -------
        tuple
            Numbers of vertices and triangles.
        """
        from radarsdf.tiles.mesh import export_mesh  # noqa: PLC0415 - as above

        return export_mesh(self, path, voxel_size, executor, progress, **limits)

    def threshold(
        self, voxel_size: float = queries.VOXEL_M, *, progress: bool | None = None, **limits: Any
    ) -> Threshold:
        """The expected precision of a mesh; arguments are those of :meth:`mesh`. After it or :meth:`export`, it takes no time."""
        from radarsdf.tiles.mesh import threshold_of  # noqa: PLC0415 - as above

        return threshold_of(self, voxel_size, None, progress, **limits)

    def save(self, path: str | PathLike[str]) -> None:
        """Copies the plan and the maps of the tiles that are done to a new folder. The rays of the tiles stay behind.

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

    def clean(self) -> int:
        """Removes the rays of the tiles that are done, which only their fits need, and the parts of meshes.

        Without its rays, a tile cannot be fitted again, so its map is read whole before. A mesh makes its parts again.
        No other step may run on the folder meanwhile.

        Returns
        -------
        int
            Bytes that are free now.

        Raises
        ------
        ValueError
            If a map is damaged, or of another version. Its rays are kept.
        OSError
            If a file cannot be read or removed.
        """
        from radarsdf.tiles.mesh import part_files  # noqa: PLC0415 - as above

        freed = 0
        for tile in self.tiles:
            storage.load_contents(map_path(self.folder, tile))
            rays = rays_path(self.folder, tile.tile)
            for path in [*part_files(rays.parent), *([rays] if rays.exists() else [])]:
                freed += path.stat().st_size
                path.unlink()
        return freed

    @property
    def origin(self) -> _Floats:
        """(3,) that of the tile in the middle, world, m, for those who need coordinates near zero."""
        tiles = self.tiles
        return self.config.lattice.position(tiles[len(tiles) // 2].origin_cells)

    @cached_property
    def report(self) -> dict[str, Any]:
        """Counts, noise of the sensor, parts of the method that were skipped, and seconds, of all fits together.

        `missing_tiles`: names.
        """
        reports = [report_of(self.folder, tile) for tile in self.tiles]
        poses = DrivePoses.load(self.folder)
        skipped: dict[str, float | None] = {}
        for report in reports:
            for words, seconds in zip(report.get("skipped", []), report.get("skipped_s", []), strict=True):
                skipped[words] = None if seconds is None else (skipped.get(words) or 0.0) + seconds
        return {
            "tiles": len(reports),
            "missing_tiles": list(self.missing),
            "scans": self.plan.scans,
            "returns": sum(tile.returns for tile in self.plan.tiles),
            "leaf_cells": self.num_cells,
            **({} if poses is None else {"poses": poses.posed.way}),
            **{name: value for name, value in reports[0].items() if name == "noise"},
            "skipped": list(skipped),
            "skipped_s": list(skipped.values()),
            **{
                step: sum(report.get(step, 0.0) for report in reports)
                for step, seconds in reports[0].items()
                if step.endswith("_s") and isinstance(seconds, float)
            },
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


def load(path: str | PathLike[str]) -> Map:
    """Reads a map: a file of :meth:`Map.save`, or a folder of :func:`fit_tiles`. Nothing in it is executed.

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
    ValueError
        If it is no radarsdf map, is damaged, or comes from another version.
    OSError
        If it cannot be read.
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


def _contiguous(world: Tensor) -> _Floats:
    return np.ascontiguousarray(world.double().numpy())
