"""Mesh of a tiled map: one part per tile, cut on the common lattice, so that parts fit to the bit."""

import hashlib
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import torch
from tqdm import tqdm

from radarsdf.arrays import Array, ArrayLike, Floats, Floats32, Ints, Ints32, Mesh
from radarsdf.checks import check, check_box, hides_bar, positive
from radarsdf.core import marching_cubes_sparse
from radarsdf.io.files import check_outputs, reading, write_whole
from radarsdf.io.meshes import MATT, T_GLTF_WORLD, encode_glb
from radarsdf.io.npz import arrays_of, check_arrays, write_arrays
from radarsdf.map.confidence import EvidenceAt
from radarsdf.map.marching_cubes import sparse_lattice
from radarsdf.map.mesh import Surface, crossed, per_cell, renumbered, subdivided
from radarsdf.map.threshold import TALLY_NUMBERS, Limits, Tally
from radarsdf.map.view import ViewedMap
from radarsdf.memory import check_memory, check_views
from radarsdf.tiles.blend import TileBlend
from radarsdf.tiles.plan import TilePlan, folder_of

_ON_LATTICE = 1e-4  # tolerance in voxels: vertices are at least 1e-3 from the corners of their edges
_BYTES_PER_TRIANGLE = 28  # size in the file of a part
_MEMORY_PER_TRIANGLE = 320.0  # bytes of a welded mesh and its normals, measured on hugin in tiles

_ARRAYS: dict[str, tuple[Any, ...]] = {
    "vertices": (np.float64, None, 3),  # world, m
    "faces": (np.int32, None, 3),
    "confidence": (np.float32, None),
    "uncertainty_m": (np.float32, None),
    "cells": (np.int64, 2),  # numbers of leaf cells, and of those that may contain surface
    "tally": (np.float64, TALLY_NUMBERS),  # of the whole surface of the tile
}  # in the file of a part, the triangles of one tile


def _read(path: Path, *names: str) -> dict[str, Array]:
    wanted = {name: _ARRAYS[name] for name in names or _ARRAYS}
    with reading(path, "a complete part of a mesh"):
        arrays = arrays_of(path, tuple(wanted))
        check_arrays(arrays, wanted)
    return arrays


def voxels_along(leaf_m: float, voxel_size: float) -> int:
    """Number of voxels along a leaf cell. Raises a ValueError unless they divide it, so that those of tiles coincide."""
    steps, even = per_cell(positive(voxel_size, "voxel_size"), leaf_m)
    wrong = f"voxels of {voxel_size:g} m do not divide leaf cells of {leaf_m:g} m, as tiles need"
    check(even, f"{wrong}: use {leaf_m / 2:g} or {leaf_m:g}")
    return steps


def parts_of(
    city: TileBlend, voxel_size: float, progress: bool | None, *, box: ArrayLike | None = None, **wanted: Any
) -> tuple[list[Path], Limits, Tally]:
    """Mesh all tiles; return the files of the parts, the limits of a mesh (`wanted`), and the tally of all parts."""
    limits = Limits.of(positive(voxel_size, "voxel_size"), **wanted)
    steps = voxels_along(city.config.leaf_size_m, voxel_size)
    corners = None if box is None else check_box(box)
    paths = []
    for planned in tqdm(city.tiles, "mesh", unit="tile", disable=hides_bar(progress)):
        # The file is determined by the settings, the plan and the neighbours.
        done = [other.tile for other in city.neighbours(planned)]
        text = repr((city.plan.digest, steps, corners, done))
        key = hashlib.blake2b(text.encode(), digest_size=8).hexdigest()
        path = folder_of(city.folder, planned.tile) / f"mesh-{key}.npz"
        if not path.is_file():
            surface, leaf_cells = _surface(city, planned, steps, corners)
            arrays = {name: value for name, value in vars(surface).items() if name in _ARRAYS}
            counts = np.array([leaf_cells, surface.cells_searched])
            write_arrays(path, arrays | {"cells": counts, "tally": surface.tally.sums})
        paths.append(path)
    tally = sum((_read(path, "tally")["tally"] for path in paths), np.zeros(TALLY_NUMBERS))
    return paths, limits, Tally(tally)


def _surface(
    city: TileBlend, tile: TilePlan, steps: int = 1, box: Floats | None = None
) -> tuple[Surface, int]:
    """Surface in the leaf cells of a tile, world, m, with `steps` voxels along a cell's edge, and the number of the cells."""
    config, position = city.config, city.config.lattice.position
    voxel_m, threads = config.leaf_size_m / steps, torch.get_num_threads()
    parts = []  # the cells of the tile's map, and those of others with a weight there
    for other in city.neighbours(tile):
        theirs = city.leaf_cells(other, within=tile)
        parts.append(theirs[city.plan.grid.within_half_a_halo(other.tile, position(theirs + 0.5))])
    cells = sparse_lattice(np.concatenate(parts))[0].astype(np.int64)
    if box is not None:
        lower, upper = box
        cells = cells[((position(cells + 1) >= lower) & (position(cells) <= upper)).all(axis=1)]
    found = len(cells)
    if steps > 1:

        def distances_at(_: Ints32, corners: Ints32, __: Ints32) -> Floats32:
            return city.distances_at(corners.astype(np.int64), config.leaf_size_m)

        cells = crossed(cells, config.leaf_size_m, distances_at).astype(np.int64)
    voxels = subdivided(cells, steps)
    if box is not None:
        centres = position((voxels + 0.5) / steps)
        voxels = voxels[((centres >= lower) & (centres <= upper)).all(axis=1)]
    _, corners, voxel_corners = sparse_lattice(voxels, num_threads=threads)
    distances_m = city.distances_at(corners.astype(np.int64), voxel_m)
    placement = [voxel_m] * 3, position([0, 0, 0]).tolist(), 0.0, threads
    vertices, faces = marching_cubes_sparse(corners, distances_m, voxel_corners, *placement)
    evidence = city.evidence_at(vertices)
    return Surface.from_triangles(city.contents_of_any, vertices, faces, evidence, len(cells)), found


def _on_borders(city: TileBlend, vertices: Floats) -> Ints:
    """(B,) rows of the vertices (V, 3) on borders of tiles, which the adjacent tile may share."""
    tiles = city.config.lattice.cells(vertices)[:, :2] / city.plan.tile_cells
    return np.flatnonzero((np.abs(tiles - np.round(tiles)) * city.plan.tile_cells < _ON_LATTICE).any(axis=1))


def _welded(city: TileBlend, vertices: Sequence[Floats], faces: Sequence[Ints32]) -> tuple[Floats, Ints32]:
    """Merge the vertices (V, 3) and faces (F, 3) of all parts, with one vertex for equal ones on borders of tiles."""
    starts = np.cumsum([0, *map(len, vertices)], dtype=np.int32)
    merged = np.concatenate([part + start for part, start in zip(faces, starts, strict=False)])
    together = np.concatenate(vertices)
    own, rows = np.arange(len(together), dtype=np.int32), _on_borders(city, together)
    _, first, which = np.unique(together[rows], axis=0, return_index=True, return_inverse=True)
    own[rows] = rows[first][which.ravel()]
    return together, own[merged]


def mesh_of(city: TileBlend, voxel_size: float, progress: bool | None, **wanted: Any) -> Mesh:
    paths, limits, tally = parts_of(city, voxel_size, progress, **wanted)
    file_bytes = sum(path.stat().st_size for path in paths)
    count, most = file_bytes // _BYTES_PER_TRIANGLE, city.config.max_memory_bytes
    remedy = "limit it to a box, or write 3D Tiles (radarsdf tiles mesh -o NAME.json)"
    check_memory(f"a mesh of {count} triangles", count * _MEMORY_PER_TRIANGLE, most, remedy)
    parts = [_read(path).values() for path in paths]
    vertices, faces, confidence, uncertainty_m, cells, _ = zip(*parts, strict=True)
    leaf_cells, searched = np.sum(cells, axis=0).tolist()
    of_vertices = np.concatenate(confidence), np.concatenate(uncertainty_m)
    whole = Surface(*_welded(city, vertices, faces), *of_vertices, tally, searched)
    return whole.mesh(np.zeros(3), limits, leaf_cells)


def meshes_of(city: TileBlend, voxel_size: float, progress: bool | None, **wanted: Any) -> Iterator[Mesh]:
    """Yield the mesh of each tile, which may be empty. Small components that reach a border are kept."""
    paths, limits, tally = parts_of(city, voxel_size, progress, **wanted)
    for path in paths:
        vertices, faces, confidence, uncertainty_m, *_ = _read(path).values()
        part = Surface(vertices, faces, confidence, uncertainty_m, tally, len(faces))
        yield part.part(np.zeros(3), part.kept(limits, _on_borders(city, vertices)))


def viewed_tiles(city: TileBlend, tiles: list[TilePlan]) -> ViewedMap:
    cells = sum(len(city.contents_of(tile).evidence.visibility) for tile in tiles)
    check_views(city.config.max_memory_bytes, cells=cells)
    origin = city.config.lattice.position(tiles[0].origin_cells)
    surfaces = [_surface(city, tile)[0] for tile in tiles]
    vertices, faces = _welded(city, [one.vertices for one in surfaces], [one.faces for one in surfaces])
    used, faces = renumbered(len(vertices), faces)

    def evidence(points: Floats) -> EvidenceAt:
        return city.evidence_at(points + origin)

    def intensity(points: Floats, sensor_position: Floats) -> Floats32:
        found = city.intensity(points + origin, sensor_position + origin, extrapolate=True)
        return np.asarray(found, np.float32)

    local = vertices[used] - origin
    surface = Surface.from_triangles(city.contents_of_any, local, faces, evidence(local), cells)
    predicted = intensity if city.has_intensity else None
    return ViewedMap.of_surface(surface, city.contents_of_any, origin, evidence, predicted)


# Viewers open a node when its error exceeds about 16 pixels: here, at less than about three times its edge.
_ERROR_OF_EDGE = 1 / 16
_GREY = MATT["pbrMetallicRoughness"] | {"baseColorFactor": [0.784, 0.784, 0.784, 1.0]}


def write_tileset(
    city: TileBlend, path: Path, voxel_size: float, progress: bool | None, **wanted: Any
) -> tuple[int, int]:
    """Write ``NAME.json`` and in a folder ``NAME`` a GLB file per tile with triangles.

    GLB files hold float32 relative to the origin of the tile, float64 in the JSON: as precise far from the world's origin.
    """
    folder = path.with_suffix("")
    check_outputs([path])
    folder.mkdir(exist_ok=True)
    check_outputs([folder / "0_0.glb"])
    children, corners, count = [], [], np.zeros(2, np.int64)
    for planned, mesh in zip(city.tiles, meshes_of(city, voxel_size, progress, **wanted), strict=True):
        if len(mesh.faces) == 0:
            continue
        name, origin = f"{planned.name}.glb", city.config.lattice.position(planned.origin_cells)
        corners += [*mesh.bounds]
        count += len(mesh.vertices), len(mesh.faces)
        mesh.vertices = local = np.asarray(mesh.vertices) - origin
        normals = {"NORMAL": mesh.vertex_normals}
        # Viewers turn y up into z up, which 3D Tiles have.
        material = MATT | {"pbrMetallicRoughness": _GREY}
        data = encode_glb(local, mesh.faces, normals, material=material, matrix=T_GLTF_WORLD)
        write_whole(folder / name, data)
        T_world_tile = np.eye(4)
        T_world_tile[:3, 3] = origin
        child = {
            "boundingVolume": _box(local),
            "geometricError": 0.0,
            "content": {"uri": quote(f"{folder.name}/{name}")},
            "transform": T_world_tile.T.ravel().tolist(),  # column-major
        }
        children.append(child)
    check(children, "no tile has a triangle, so there is nothing to write")
    error_m = float(np.ptp(corners, axis=0).max()) * _ERROR_OF_EDGE
    root = {"boundingVolume": _box(np.array(corners)), "geometricError": error_m}
    root |= {"refine": "ADD", "children": children}
    # The JSON is last, so that all files it names exist.
    described = {"asset": {"version": "1.1"}, "geometricError": error_m, "root": root}
    write_whole(path, json.dumps(described, allow_nan=False).encode())
    num_vertices, num_faces = count.tolist()
    return num_vertices, num_faces


def _box(points: Floats) -> dict[str, Any]:
    lower, upper = points.min(axis=0), points.max(axis=0)
    half = np.maximum((upper - lower) / 2, 1e-3)  # a flat box would have no volume
    return {"box": [*((lower + upper) / 2).tolist(), *np.diag(half).ravel().tolist()]}
