# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The mesh of a map in tiles, in memory or in a file."""

from __future__ import annotations

from concurrent.futures import Executor
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from radarsdf.budget.estimate import check_triangles
from radarsdf.checks import check_box, path_of, positive
from radarsdf.io.clouds.writing import face_records, ply_header, records
from radarsdf.io.files import whole_file
from radarsdf.map.mesh import described_mesh
from radarsdf.map.threshold import Limits, Threshold
from radarsdf.tiles.blend import TileBlend
from radarsdf.tiles.pieces import PieceSettings, divides, mesh_tile, piece_path, write_piece
from radarsdf.tiles.running import Task, run_tasks
from radarsdf.tiles.tileset import content_folder, write_tileset
from radarsdf.tiles.welding import WeldedMesh, tally_of

if TYPE_CHECKING:
    import trimesh


def mesh_of(
    city: TileBlend,
    voxel_size: float,
    executor: Executor | None,
    progress: bool | None,
    **limits: Any,
) -> trimesh.Trimesh:
    """See :meth:`TiledMap.mesh`."""
    welded = _welded(city, voxel_size, executor, progress, **limits)
    check_triangles(welded.num_faces, city.config.max_memory_bytes)
    parts = list(welded.parts())
    leaf_cells, cells_searched = welded.cells.tolist()
    return described_mesh(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.faces for part in parts]),
        np.concatenate([part.confidence for part in parts]),
        np.concatenate([part.uncertainty_m for part in parts]),
        leaf_cells=leaf_cells,
        leaf_cells_searched=cells_searched,
        **welded.threshold.metadata,
    )


def export_mesh(
    city: TileBlend,
    path: str | PathLike[str],
    voxel_size: float,
    executor: Executor | None,
    progress: bool | None,
    **limits: Any,
) -> tuple[int, int]:
    """See :meth:`TiledMap.export`."""
    suffix = path_of(path, "path").suffix.lower()
    if suffix not in {".ply", ".json"}:
        msg = f"{path}: a mesh of tiles is written as .ply, or as .json for 3D Tiles"
        raise ValueError(msg)
    if suffix == ".json":
        content_folder(Path(path))  # first: it says at once if it cannot be written
        welded = _welded(city, voxel_size, executor, progress, **limits)
        return write_tileset(city, Path(path), welded)
    with whole_file(path) as file:  # first: it says at once if it cannot be written
        welded = _welded(city, voxel_size, executor, progress, **limits)
        columns = ("x", "y", "z", "confidence", "uncertainty_m")
        types = ["<f8"] * 3 + ["<f4"] * 2
        dtype = np.dtype(list(zip(columns, types, strict=True)))
        file.write(ply_header(dtype, welded.num_vertices, welded.num_faces))
        for part in welded.parts():
            values = (*part.vertices.T, part.confidence, part.uncertainty_m)
            file.write(records(dict(zip(columns, values, strict=True))).data)
        for part in welded.parts():
            file.write(face_records(part.faces).data)
    return welded.num_vertices, welded.num_faces


def threshold_of(
    city: TileBlend, voxel_size: float, executor: Executor | None, progress: bool | None, **limits: Any
) -> Threshold:
    """See :meth:`TiledMap.threshold`."""
    paths, found = _pieces(city, voxel_size, executor, progress, **limits)
    return tally_of(paths).threshold(found.min_confidence)


def _welded(
    city: TileBlend, voxel_size: float, executor: Executor | None, progress: bool | None, **limits: Any
) -> WeldedMesh:
    """Meshes all tiles, and welds them."""
    paths, found = _pieces(city, voxel_size, executor, progress, **limits)
    return WeldedMesh(paths, found.min_confidence, found.min_component_triangles)


def _pieces(
    city: TileBlend,
    voxel_size: float,
    executor: Executor | None,
    progress: bool | None,
    *,
    box: ArrayLike | None = None,
    **wanted: Any,
) -> tuple[list[Path], Limits]:
    """Meshes all tiles: the files of the pieces, and what a mesh of them leaves out, as `wanted` of :meth:`Map.mesh`."""
    voxel_size = positive(voxel_size, "voxel_size")
    limits = Limits.of(voxel_size, **wanted)
    settings = PieceSettings(
        divides(voxel_size, city.config.leaf_size_m),
        None if box is None else tuple(tuple(corner) for corner in check_box(box).tolist()),
        limits.of_triangles,
    )
    tiles = [tile for tile in city.tiles if not piece_path(city, tile.tile, settings).is_file()]
    if executor is None:  # what this map holds in memory serves all tiles
        task: Task = lambda name, _: write_piece(city, name, settings)
        arguments: list[tuple[str, ...]] = [(tile.name,) for tile in tiles]
    else:
        task = mesh_tile
        arguments = [(str(city.folder), tile.name, settings.to_json()) for tile in tiles]
    failed = run_tasks(task, arguments, executor, description="mesh", progress=progress)
    if failed:
        names = ", ".join(f"{tiles[i].name}: {reason}" for i, reason in failed.items())
        msg = f"{len(failed)} of {len(city.tiles)} tiles could not be meshed: {names!s:.400}"
        raise ValueError(msg)
    return [piece_path(city, tile.tile, settings) for tile in city.tiles], limits
