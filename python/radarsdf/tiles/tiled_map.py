"""One map over many tiles."""

import shutil
from collections.abc import Callable, Iterator
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from radarsdf.arrays import Floats, Mesh
from radarsdf.checks import AnyPath, check, path_of
from radarsdf.io.files import check_outputs, checked_suffix
from radarsdf.io.meshes import MESH_SUFFIXES, write_mesh
from radarsdf.map.confidence import CellsInBox, dense_cells
from radarsdf.map.map import Map
from radarsdf.map.radar_map import RadarMap, load_contents
from radarsdf.map.threshold import VOXEL_M, Threshold
from radarsdf.map.view import ViewedMap
from radarsdf.returns.rays import Rays
from radarsdf.returns.view_statistics import ViewStatisticsAt
from radarsdf.tiles.blend import TileBlend
from radarsdf.tiles.mesh import mesh_of, meshes_of, parts_of, viewed_tiles, write_tileset
from radarsdf.tiles.plan import TilePlan, map_path, report_of


class TiledMap(TileBlend):
    """A map in tiles, returned by :func:`radarsdf.fit_tiles` or ``radarsdf.load(folder)``.

    It has the methods of :class:`Map`. Where tiles overlap, their fields are averaged with weights that fall smoothly to zero,
    so neither surface, gradient nor intensity has a seam. Tiles are read on demand. The voxels of :meth:`mesh` must divide the edge
    of a leaf cell, so that triangles of adjacent tiles fit together. They are cached in the folder by `voxel_size` and `box`.

    Parameters
    ----------
    folder : path-like
        Folder of the plan and the maps.
    memory_bytes : float
        Approximate memory for tiles, bytes. At least one tile is always held.

    Raises
    ------
    ValueError, OSError
        If the plan is damaged, no tile is done, or a file cannot be read.
    """

    _viewed: tuple[list[TilePlan], ViewedMap] | None = None

    def __repr__(self) -> str:
        kind = "surface and reflectance" if self.has_intensity else "surface"
        count = f"{len(self.tiles)} of {len(self.plan.tiles)} tiles"
        return f"TiledMap({kind}, {count} of {self.plan.tile_m:g} m)"

    def __reduce__(self) -> "tuple[Callable[..., TiledMap], tuple[Any, ...]]":
        return partial(TiledMap, memory_bytes=self.memory_bytes), (str(self.folder),)

    def _surface_mesh(self, voxel_size: float, **wanted: Any) -> Any:
        return mesh_of(self, voxel_size, **wanted)

    def meshes(self, voxel_size: float) -> Iterator[Mesh]:
        return meshes_of(self, voxel_size, progress=False)

    def cells_near(self, lower: Floats, upper: Floats) -> CellsInBox:
        """Each cell belongs to the tile that contains it; cells of unfinished tiles are unknown."""
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
                here = start - np.array(planned.origin_cells)
                found = dense_cells(self.contents_of(planned), here, (x, y, z))
                place = tuple(slice(a, b) for a, b in zip(start - first, stop - first, strict=True))
                passed[place], returns[place], observed[place] = found
        return CellsInBox(lattice.position(first), passed, returns, observed)

    def view_statistics(self) -> ViewStatisticsAt:
        """View statistics of each cell come from its own tile."""
        found = []
        for planned in self.tiles:
            of_tile = self.contents_of(planned).views_in_world()
            cells = np.floor(self.config.lattice.cells(of_tile.points)[:, :2])
            found.append(of_tile.select((cells // self.plan.tile_cells == planned.tile).all(axis=1)))
        return ViewStatisticsAt.together(found)

    def _viewed_from(self, position: Floats, range_m: float) -> ViewedMap:
        away = np.clip(position[:2], self.corners_m, self.corners_m + self.plan.tile_m) - position[:2]
        near = np.flatnonzero(np.linalg.norm(away, axis=1) <= range_m)
        tiles = [self.tiles[i] for i in near] or self.tiles[:1]  # far from all tiles, any tile shows nothing
        if self._viewed is None or self._viewed[0] != tiles:
            self._viewed = tiles, viewed_tiles(self, tiles)
        return self._viewed[1]

    def export(
        self, path: AnyPath, voxel_size: float = VOXEL_M, *, progress: bool | None = None, **limits: Any
    ) -> tuple[int, int]:
        """Write the mesh to one file, or as 3D Tiles, with one tile at a time in memory.

        Parameters
        ----------
        path : path-like
            ``NAME.json``: 3D Tiles 1.1, one GLB file per tile in a folder ``NAME`` next to it, in the world frame. To
            georeference it, set the ``transform`` of its root. Small components that reach into the next tile are kept.
            Another suffix: one file, as for :func:`radarsdf.io.write_mesh`.
        voxel_size, progress, **limits
            As for :meth:`mesh`; also its `box`.

        Returns
        -------
        tuple
            Numbers of vertices and triangles. In 3D Tiles, vertices on borders are in both tiles.

        Raises
        ------
        ValueError, MemoryError, OSError
            As for :meth:`mesh`, or if the suffix is unknown, there is no surface, or a file cannot be written.
        """
        if path_of(path, "path").suffix.lower() == ".json":
            return write_tileset(self, Path(path), voxel_size, progress, **limits)
        checked_suffix(path, MESH_SUFFIXES, "meshes")
        check_outputs([path])  # before the work
        mesh = mesh_of(self, voxel_size, progress, **limits)
        check(len(mesh.faces) != 0, f"{self.folder} has no surface here: nothing written")
        write_mesh(path, mesh)
        return len(mesh.vertices), len(mesh.faces)

    def threshold(
        self, voxel_size: float = VOXEL_M, *, progress: bool | None = None, **limits: Any
    ) -> Threshold:
        """Compute the confidence threshold of :meth:`mesh` for the same arguments, and the shares in its ``metadata``.

        They are computed per tile, without a mesh of the whole map.
        """
        _, wanted, tally = parts_of(self, voxel_size, progress, **limits)
        return tally.threshold(wanted.min_confidence)

    def save(self, path: AnyPath) -> None:
        """Copy the plan and the maps of finished tiles, without their rays, to a new folder for :func:`radarsdf.load`.

        Raises an OSError if the folder exists, or cannot be written.
        """
        folder = path_of(path, "path")
        folder.mkdir()
        for tile in self.tiles:
            copy = map_path(folder, tile)
            copy.parent.mkdir(parents=True)
            shutil.copyfile(map_path(self.folder, tile), copy)
        self.plan.save(folder)  # last: without it, the folder is no map

    @property
    def origin(self) -> Floats:
        """(3,) origin of the middle tile, world, m, for coordinates near zero."""
        return self.config.lattice.position(self.tiles[len(self.tiles) // 2].origin_cells)

    @cached_property
    def report(self) -> dict[str, Any]:
        """Counts, noise of the sensor, skipped parts of the method, seconds, and names of missing tiles, over all fits."""
        reports = [report_of(self.folder, tile) for tile in self.tiles]
        timed = [n for n, value in reports[0].items() if n.endswith("_s") and isinstance(value, float)]
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
        """Number of leaf cells, each counted in the tile that contains it."""
        return sum(len(self.leaf_cells(tile, tile)) for tile in self.tiles)

    @cached_property
    def extent(self) -> Floats:
        """(2, 3) lower and upper corner of all leaf cells, world, m."""
        of_tiles = [cells for tile in self.tiles if len(cells := self.leaf_cells(tile, tile))]
        lower = np.min([cells.min(axis=0) for cells in of_tiles], axis=0)
        upper = np.max([cells.max(axis=0) for cells in of_tiles], axis=0)
        return self.config.lattice.position(np.stack([lower, upper + 1]))

    @property
    def file_bytes(self) -> int:
        """Size of all files of tiles, bytes."""
        return sum(map_path(self.folder, tile).stat().st_size for tile in self.tiles)


def load(path: AnyPath) -> Map:
    """Load a map from a file of :meth:`Map.save`, or a folder of :func:`fit_tiles`. Nothing in it is executed.

    Parameters
    ----------
    path : path-like
        A file or folder written by this version.

    Returns
    -------
    RadarMap or TiledMap
        Its results have the same bits as those of the saved map.

    Raises
    ------
    ValueError, OSError
        If it is no radarsdf map, is damaged, of another version, or cannot be read.
    """
    path = path_of(path, "path")
    return TiledMap(path) if path.is_dir() else RadarMap(load_contents(path))


def predicted(radar_map: Map, rays: Rays) -> tuple[Rays, Floats]:
    """Predicted intensities (N,) for rays, sensor units, and these rays: those in no tile are left out."""
    found = np.asarray(radar_map.intensity(*rays.in_world(), extrapolate=True), np.float64)
    known = np.isfinite(found)
    return (rays, found) if known.all() else (rays.select(np.flatnonzero(known)), found[known])
