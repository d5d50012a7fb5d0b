# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""One map that answers from many tiles, of which few are in memory."""

from __future__ import annotations

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
from radarsdf.returns.echoes import EchoesAt
from radarsdf.tiles.blend import Share, TileBlend, averages, distance
from radarsdf.tiles.drive_poses import DrivePoses
from radarsdf.tiles.plan import map_path
from radarsdf.tiles.ray_files import rays_path
from radarsdf.tiles.tile_fit import report_of

if TYPE_CHECKING:
    import trimesh

    from radarsdf.map.queries import CellsInBox
    from radarsdf.map.threshold import Threshold
    from radarsdf.map.view import ViewedMap
    from radarsdf.tiles.grid import Tile

_Floats = NDArray[np.float64]


class TiledMap(TileBlend, Map):
    """A map in tiles, made by :func:`radarsdf.fit_tiles` or ``radarsdf.load(folder)``.

    :class:`Map` says what it answers. Where tiles overlap, their answers are averaged with weights that fall smoothly
    to zero, so that neither surface, gradient nor intensity has a seam. Tiles are read when they are asked for.

    Parameters
    ----------
    folder : path-like
        Where the plan and the maps are.
    memory_bytes : float
        About so much memory is used for tiles. One tile at a time is always held.

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
        return _opened, (str(self.folder), self.memory_bytes)

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
            executor=executor,
            progress=progress,
            **limits,
        )

    def _surface_mesh(self, voxel_size: float, **wanted: Any) -> trimesh.Trimesh:
        from radarsdf.tiles.meshing import mesh_of  # noqa: PLC0415 - trimesh is slow to import

        return mesh_of(self, voxel_size, **wanted)

    def cells_round(self, lower: _Floats, upper: _Floats) -> CellsInBox:
        from radarsdf.tiles.gridding import cells_of_tiles  # noqa: PLC0415 - it imports trimesh, which is slow

        return cells_of_tiles(self, lower, upper)

    def echoes(self) -> EchoesAt:
        from radarsdf.tiles.gridding import echoes_of_tiles  # noqa: PLC0415 - as above

        return echoes_of_tiles(self)

    def evidence_at(self, world: Tensor) -> queries.EvidenceAt:
        return self.evidence(_contiguous(world))

    def _viewed_from(self, position: _Floats, range_m: float) -> ViewedMap:
        from radarsdf.tiles.views import tiles_within, viewed_tiles  # noqa: PLC0415 - as above

        # Of a pose far away from all tiles, any will do to see nothing.
        tiles = tiles_within(self, position, range_m) or [self.tiles[0].tile]
        held = self._viewed
        if held is None or held[0] != tiles:

            def intensity(points: _Floats, sensor_position: _Floats) -> _Floats:
                found: _Floats = self.intensity(points, sensor_position, extrapolate=True)
                return found

            viewed = viewed_tiles(self, tiles, intensity if self.has_intensity else None)
            held = self._viewed = tiles, viewed
        return held[1]

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
            folder ``NAME`` beside it, in the frame of the world. To place it on the earth, set the ``transform`` of its root.

        Returns
        -------
        tuple
            Numbers of vertices and triangles.
        """
        from radarsdf.tiles.meshing import export_mesh  # noqa: PLC0415 - as above

        return export_mesh(self, path, voxel_size, executor, progress, **limits)

    def threshold(
        self, voxel_size: float = queries.VOXEL_M, *, progress: bool | None = None, **limits: Any
    ) -> Threshold:
        """What is expected of a mesh; arguments are those of :meth:`mesh`. After it or :meth:`export`, it takes no time."""
        from radarsdf.tiles.meshing import threshold_of  # noqa: PLC0415 - as above

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
        """Removes the rays of the tiles that are done, which only their fits need, and the pieces of meshes.

        Without its rays, a tile cannot be fitted again, so its map is read whole before. A mesh makes its pieces again.
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
        from radarsdf.tiles.pieces import pieces_in  # noqa: PLC0415 - as above

        freed = 0
        for tile in self.tiles:
            storage.load_contents(map_path(self.folder, tile))
            rays = rays_path(self.folder, tile.tile)
            for path in [*pieces_in(rays.parent), *([rays] if rays.exists() else [])]:
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


def _contiguous(world: Tensor) -> _Floats:
    return np.ascontiguousarray(world.double().numpy())


def _opened(folder: str, memory_bytes: float) -> TiledMap:
    return TiledMap(folder, memory_bytes=memory_bytes)
