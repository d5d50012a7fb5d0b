# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The mesh of a map in tiles: a part for each tile, cut on the lattice of all tiles, and welded by its edges."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import lru_cache
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from radarsdf.checks import check_box, path_of, positive
from radarsdf.io.cloud_writing import face_records, ply_header, records
from radarsdf.io.files import whole_file
from radarsdf.io.npz import arrays_of, check_arrays, write_arrays
from radarsdf.map.marching_cubes import extract_cells, mesh_components, sparse_lattice
from radarsdf.map.mesh import Surface, crossed, described_mesh, renumbered, with_all
from radarsdf.map.threshold import TALLY_NUMBERS, Limits, Tally, Threshold
from radarsdf.map.view import ViewedMap
from radarsdf.memory import check_triangles, check_views
from radarsdf.threads import torch_threads
from radarsdf.tiles.blend import TileBlend
from radarsdf.tiles.plan import Tile, folder_of, neighbours
from radarsdf.tiles.tasks import Task, run_tasks
from radarsdf.tiles.tileset import content_folder, write_tileset

if TYPE_CHECKING:
    import trimesh

_FILES = "mesh-*.npz"
_ON_LATTICE = 1e-4  # voxels: vertices are at least 1e-3 from the corners of their edges
_Floats = NDArray[np.float64]


@dataclass(frozen=True)
class PartSettings:
    """What the triangles of a tile depend on."""

    voxels_per_cell: int
    """Along the edge of a leaf cell."""
    box: tuple[tuple[float, ...], ...] | None
    """Lower and upper corner, world, m."""
    max_uncertainty: float
    """m. What else a mesh leaves out depends on the other tiles."""


@dataclass(frozen=True)
class Part:
    """The triangles in one tile."""

    vertices: NDArray[np.float64]
    """(V, 3) world, m."""
    faces: NDArray[np.int32]
    """(F, 3) rows of the vertices."""
    confidence: NDArray[np.float32]
    """(V,)"""
    uncertainty_m: NDArray[np.float32]
    """(V,)"""
    border_rows: NDArray[np.int64]
    """(B,) vertices on the border of the tile, which the next tile has too."""
    border_edges: NDArray[np.int64]
    """(B, 4) the edge of the lattice that each of them is on: its lower corner, in voxels of the lattice, and its axis."""
    cells: NDArray[np.int64]
    """(2,) leaf cells, and those in which the surface can be."""
    tally: NDArray[np.float64]
    """:meth:`Tally.sums` of all surface of the tile."""


_ARRAYS: dict[str, tuple[Any, ...]] = {
    "vertices": (np.float64, None, 3),
    "faces": (np.int32, None, 3),
    "confidence": (np.float32, None),
    "uncertainty_m": (np.float32, None),
    "border_rows": (np.int64, None),
    "border_edges": (np.int64, None, 4),
    "cells": (np.int64, 2),
    "tally": (np.float64, TALLY_NUMBERS),
}
"""Type and shape of each array of a `Part`. None: any length."""


def _read(path: Path, *names: str) -> dict[str, NDArray[Any]]:
    """Arrays of a part, by default all. Raises a ValueError if the file is damaged."""
    names = names or tuple(_ARRAYS)
    arrays = arrays_of(path, names)
    try:
        check_arrays(arrays, {name: _ARRAYS[name] for name in names})
    except ValueError as error:
        msg = f"{path} is not a whole part of a mesh: {error}"
        raise ValueError(msg) from error
    return arrays


def part_files(folder: Path) -> list[Path]:
    """The files of all parts in the folder of a tile, of whatever settings."""
    return list(folder.glob(_FILES))


def part_path(city: TileBlend, tile: Tile, settings: PartSettings) -> Path:
    """The file of a part. The same settings of the same plan and tiles give the same file."""
    text = repr((settings, [other for other in neighbours(tile) if city.has(other)]))
    key = hashlib.blake2b((city.plan.digest + text).encode(), digest_size=8).hexdigest()
    return folder_of(city.folder, tile) / _FILES.replace("*", key)


def mesh_tile(folder: str, name: str, settings: PartSettings, run: str) -> None:
    """Meshes the tile of this name, unless that is done. A task of :func:`run_tasks`."""
    city = _opened(folder, run)
    with torch_threads(city.config.num_threads):
        _write_part(city, name, settings)


@lru_cache(maxsize=1)
def _opened(folder: str, run: str) -> TileBlend:
    """One for all tasks of a run in a process: the next tile mostly needs the same neighbours in memory."""
    del run
    return TileBlend(folder)


def _write_part(city: TileBlend, name: str, settings: PartSettings) -> None:
    (tile,) = (planned.tile for planned in city.plan.tiles if planned.name == name)
    path = part_path(city, tile, settings)
    if not path.is_file():
        write_arrays(path, vars(part_of(city, tile, settings)))


def part_of(city: TileBlend, tile: Tile, settings: PartSettings) -> Part:
    """The triangles of the blended field in the leaf cells of a tile that are certain enough, whatever their confidence."""
    config, steps = city.config, settings.voxels_per_cell
    voxel_m, threads = config.leaf_size_m / steps, torch.get_num_threads()
    cells = _cells_in(city, tile)
    if settings.box is not None:
        lower, upper = np.array(settings.box)
        position = config.lattice.position
        cells = cells[((position(cells + 1) >= lower) & (position(cells) <= upper)).all(axis=1)]
    found = len(cells)
    if steps > 1:
        cells = crossed(
            cells,
            config.leaf_size_m,
            lambda _, corners, __: city.distances_at(corners.astype(np.int64), config.leaf_size_m),
        ).astype(np.int64)
    inside = np.stack(np.meshgrid(*[np.arange(steps)] * 3, indexing="ij"), -1).reshape(1, -1, 3)
    voxels = (cells[:, None, :] * steps + inside).reshape(-1, 3)
    if settings.box is not None:
        centres = config.lattice.position((voxels + 0.5) / steps)
        voxels = voxels[((centres >= lower) & (centres <= upper)).all(axis=1)]
    _, corners, voxel_corners = sparse_lattice(voxels, num_threads=threads)
    vertices, faces = extract_cells(
        corners,
        city.distances_at(corners.astype(np.int64), voxel_m),
        voxel_corners,
        origin=config.lattice.position([0, 0, 0]),
        spacing=[voxel_m] * 3,
        num_threads=threads,
    )
    surface = Surface.told_by(city.any_contents, vertices, faces, city.evidence(vertices), len(cells))
    kept, faces = renumbered(len(vertices), faces[surface.allowed(settings.max_uncertainty)])
    vertices = vertices[kept]
    rows, edges = _border(config.lattice.cells(vertices) * steps, city.plan.tile_cells * steps)
    return Part(
        vertices,
        faces,
        surface.confidence[kept],
        surface.uncertainty_m[kept],
        rows,
        edges,
        np.array([found, len(cells)]),
        surface.tally.sums(),
    )


def _cells_in(city: TileBlend, tile: Tile) -> NDArray[np.int64]:
    """(C, 3) leaf cells of a tile, as the lattice numbers them: those of its map, and of others with a weight there."""
    plan = city.plan
    parts = []
    for other in neighbours(tile):
        if city.has(other):
            cells = city.leaf_cells(other, within=tile)
            centres = plan.config.lattice.position(cells + 0.5)
            parts.append(cells[plan.grid.within_half_a_halo(other, centres)])
    found: NDArray[np.int64] = sparse_lattice(np.concatenate(parts))[0].astype(np.int64)
    return found


def _border(places: _Floats, voxels_per_tile: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows (B,) of vertices (V, 3), in voxels of the lattice, on borders between tiles, and their edges (B, 4)."""
    nearest = np.round(places)
    on_lattice = np.abs(places - nearest) < _ON_LATTICE
    border = (on_lattice[:, :2] & (nearest[:, :2] % voxels_per_tile == 0)).any(axis=1)
    rows = np.flatnonzero(border)
    axis = np.argmin(on_lattice[rows], axis=1)  # the one along which the vertex is between corners
    corners = nearest[rows].astype(np.int64)
    along = np.arange(len(rows)), axis
    corners[along] = np.floor(places[rows][along]).astype(np.int64)
    return rows, np.column_stack([corners, axis])


class WeldedPart(NamedTuple):
    """What one part adds to the mesh."""

    vertices: _Floats
    """(V, 3) world, m: those that no earlier part has."""
    confidence: NDArray[np.float32]
    """(V,)"""
    uncertainty_m: NDArray[np.float32]
    """(V,)"""
    faces: NDArray[np.int64]
    """(F, 3) rows of the vertices of all parts."""


class WeldedMesh:
    """The mesh of parts in files, welded by the edges of their lattice. Only what touches borders is held in memory.

    `paths`: in the order of the tiles. Triangles with a vertex of less than `min_confidence` are left out (None: that of the
    highest expected F-score), then components of fewer than `min_triangles`, counted over all parts.
    """

    def __init__(self, paths: Sequence[Path], min_confidence: float | None, min_triangles: int) -> None:
        self._paths = paths
        self.threshold = _tally_of(paths).threshold(min_confidence)
        self._kept = self._large(min_triangles)
        self.num_vertices = self.num_faces = 0
        self.cells = np.zeros(2, np.int64)
        edges = []
        own = []  # number of vertices of each part that are used, and rows of those on its border
        for i in range(len(paths)):
            part, used, faces = self._used(i)
            on_border = used[part.border_rows]
            edges.append(part.border_edges[on_border])
            own.append((int(used.sum()), (np.cumsum(used) - 1)[part.border_rows[on_border]]))
            self.num_faces += len(faces)
            self.cells += part.cells
        first, group = _groups(edges)
        number = np.zeros(len(group), np.int64)  # of each border vertex in the whole mesh
        self._borders: list[tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_], int]] = []
        end = 0
        for count, rows in own:
            begin, end = end, end + len(rows)
            owner = first[group[begin:end]]
            is_new = owner == np.arange(begin, end)
            new = np.ones(count, bool)
            new[rows[~is_new]] = False
            numbers = np.cumsum(new) - 1 + self.num_vertices
            number[begin:end] = np.where(is_new, numbers[rows], number[owner])
            self._borders.append((rows, number[begin:end], new, self.num_vertices))
            self.num_vertices += int(new.sum())

    def parts(self) -> Iterator[WeldedPart]:
        """What each part adds, one after another."""
        for i, (rows, numbers, new, before) in enumerate(self._borders):
            part, used, faces = self._used(i)
            of_all = np.cumsum(new) - 1 + before
            of_all[rows] = numbers
            kept = np.flatnonzero(used)[new]
            yield WeldedPart(
                part.vertices[kept], part.confidence[kept], part.uncertainty_m[kept], of_all[faces]
            )

    def separate(self) -> Iterator[tuple[_Floats, NDArray[np.int32]]]:
        """Vertices (V, 3), world, m, and faces (F, 3) of each part alone, with all vertices on its borders."""
        for i in range(len(self._paths)):
            part, used, faces = self._used(i)
            yield part.vertices[used], faces

    def _used(self, i: int) -> tuple[Part, NDArray[np.bool_], NDArray[np.int32]]:
        """A part, which of its vertices are used, and the faces as rows of these."""
        part, faces, labels, _ = self._components(i)
        return part, *renumbered(len(part.vertices), faces[self._kept[i][labels]])

    def _components(self, i: int) -> tuple[Part, NDArray[np.int32], NDArray[np.int32], NDArray[np.int64]]:
        """A part, its triangles that are probable enough, to which component each belongs, and the sizes of those."""
        part = Part(**_read(self._paths[i]))
        good = part.confidence >= self.threshold.min_confidence
        faces = part.faces[with_all(good, part.faces)]
        return part, faces, *mesh_components(faces, len(part.vertices))

    def _large(self, min_triangles: int) -> list[NDArray[np.bool_]]:
        """Which of the components of each part are kept. Those that meet at a border are one."""
        sizes, edges, of_vertex = [], [], []
        before = 0
        for i in range(len(self._paths)):
            part, faces, labels, counts = self._components(i)
            label = np.full(len(part.vertices), -1, np.int64)
            label[faces] = labels[:, None]
            used = label[part.border_rows] >= 0
            sizes.append(counts)
            edges.append(part.border_edges[used])
            of_vertex.append(label[part.border_rows[used]] + before)
            before += len(counts)
        if before == 0:
            return [np.zeros(0, bool) for _ in sizes]
        first, group = _groups(edges)
        component = np.concatenate(of_vertex)
        pairs = (component, component[first[group]])
        links = coo_array((np.ones(len(component), bool), pairs), shape=(before, before))
        _, joined = connected_components(links, directed=False)
        totals = np.bincount(joined, np.concatenate(sizes))
        large = totals[joined] >= min_triangles
        return np.split(large, np.cumsum([len(counts) for counts in sizes])[:-1])


def _groups(edges: list[NDArray[np.int64]]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Of the edges (B_i, 4) of all parts: the first row of each that is different, and to which of these each row belongs."""
    together = np.concatenate([np.zeros((0, 4), np.int64), *edges])
    _, first, group = np.unique(together, axis=0, return_index=True, return_inverse=True)
    return first, group.ravel()


def _tally_of(paths: Sequence[Path]) -> Tally:
    return Tally.of_sums(sum((_read(path, "tally")["tally"] for path in paths), np.zeros(TALLY_NUMBERS)))


def mesh_of(
    city: TileBlend, voxel_size: float, executor: Executor | None, progress: bool | None, **limits: Any
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
    """See :meth:`TiledMap.export`. What cannot be written is noticed before the work."""
    suffix = path_of(path, "path").suffix.lower()
    if suffix not in {".ply", ".json"}:
        msg = f"{path}: a mesh of tiles is written as .ply, or as .json for 3D Tiles"
        raise ValueError(msg)
    if suffix == ".json":
        content_folder(Path(path))
        welded = _welded(city, voxel_size, executor, progress, **limits)
        return write_tileset(city, Path(path), welded.separate())
    with whole_file(path) as file:
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
    paths, found = _part_files(city, voxel_size, executor, progress, **limits)
    return _tally_of(paths).threshold(found.min_confidence)


def _welded(
    city: TileBlend, voxel_size: float, executor: Executor | None, progress: bool | None, **limits: Any
) -> WeldedMesh:
    paths, found = _part_files(city, voxel_size, executor, progress, **limits)
    return WeldedMesh(paths, found.min_confidence, found.min_component_triangles)


def _part_files(
    city: TileBlend,
    voxel_size: float,
    executor: Executor | None,
    progress: bool | None,
    *,
    box: ArrayLike | None = None,
    **wanted: Any,
) -> tuple[list[Path], Limits]:
    """Meshes all tiles: the files of the parts, and the limits of a mesh of them, as `wanted` of :meth:`Map.mesh`."""
    limits = Limits.of(positive(voxel_size, "voxel_size"), **wanted)
    settings = PartSettings(
        _voxels_per_cell(voxel_size, city.config.leaf_size_m),
        None if box is None else tuple(tuple(corner) for corner in check_box(box).tolist()),
        limits.max_uncertainty,
    )
    tiles = [tile for tile in city.tiles if not part_path(city, tile.tile, settings).is_file()]
    if executor is None:  # what this map holds in memory serves all tiles
        task: Task = lambda name, _: _write_part(city, name, settings)
        arguments: list[tuple[Any, ...]] = [(tile.name,) for tile in tiles]
    else:
        task = mesh_tile
        arguments = [(str(city.folder), tile.name, settings) for tile in tiles]
    failed = run_tasks(task, arguments, executor, description="mesh", progress=progress)
    if failed:
        names = ", ".join(f"{tiles[i].name}: {reason}" for i, reason in failed.items())
        msg = f"{len(failed)} of {len(city.tiles)} tiles could not be meshed: {names!s:.400}"
        raise ValueError(msg)
    return [part_path(city, tile.tile, settings) for tile in city.tiles], limits


def _voxels_per_cell(voxel_m: float, leaf_size_m: float) -> int:
    """Along the edge of a leaf cell. Raises a ValueError unless they fill it."""
    steps = round(leaf_size_m / voxel_m) if voxel_m <= leaf_size_m else 0
    if steps < 1 or not math.isclose(steps * voxel_m, leaf_size_m, rel_tol=1e-9):
        msg = f"voxels of {voxel_m:g} m do not divide leaf cells of {leaf_size_m:g} m, as those of tiles must: use {leaf_size_m / 2:g} or {leaf_size_m:g}"
        raise ValueError(msg)
    return steps


def viewed_tiles(
    city: TileBlend, tiles: list[Tile], intensity: Callable[[_Floats, _Floats], _Floats] | None
) -> ViewedMap:
    """What views need of some tiles. `intensity`: of points (N, 3) seen from a sensor (3,), both in the world, m."""
    config = city.config
    cells = sum(len(city.contents_of(tile).evidence.looks) for tile in tiles)
    check_views(config.max_memory_bytes, cells=cells)
    origin = config.lattice.position(city.plan.origin_cells(tiles[0]))
    parts = [part_of(city, tile, PartSettings(1, None, math.inf)) for tile in tiles]
    starts = np.cumsum([0, *[len(part.vertices) for part in parts]])
    # Parts share the vertices on their borders, to the bit.
    together = np.concatenate([part.vertices for part in parts])
    vertices, rows = np.unique(together, axis=0, return_inverse=True)
    faces = np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=False)])
    surface = Surface.told_by(
        city.any_contents,
        vertices - origin,
        rows.ravel()[faces].astype(np.int32),
        city.evidence(vertices),
        cells,
    )

    def local_intensity(points: _Floats, position: _Floats) -> NDArray[np.float32]:
        assert intensity is not None
        return intensity(points + origin, position + origin).astype(np.float32)

    return ViewedMap.of_surface(
        surface,
        city.any_contents,
        origin,
        lambda points: city.evidence(points + origin),
        None if intensity is None else local_intensity,
    )
