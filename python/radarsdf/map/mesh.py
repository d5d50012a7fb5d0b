"""Mesh extraction: distances at the corners of voxels, triangles, and filtering by evidence."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch

from radarsdf.arrays import Array, Bools, Floats, Floats32, Ints, Ints32, Mesh, NDArray
from radarsdf.checks import check
from radarsdf.config.fit_config import FitConfig
from radarsdf.core import marching_cubes_sparse, mesh_components, vertex_areas
from radarsdf.map.confidence import EvidenceAt, evidence, probabilities, uncertainty
from radarsdf.map.marching_cubes import sparse_lattice
from radarsdf.map.queries import MapContents, WholeMap, evaluate, signed_distance, to_local
from radarsdf.map.threshold import Limits, Tally
from radarsdf.memory import check_memory

_MAX_VOXELS = 2**30  # duplicates included. Lattice coordinates and rows of corners are int32
_MEMORY_PER_VOXEL = 220.0  # bytes, measured
# Leaf cells. A cell is skipped if all its corners are farther than this from the surface, on the same side. Measured on
# four scenes: with 0 some triangles are lost, with 0.1 none. With 0.25 half of the cells are left.
_CLEARLY = 0.25
# Shift of a corner on the map's border for evaluation, as a share of its distance to the voxel's centre.
_INWARD = 1e-3


@dataclass(frozen=True)
class Surface:
    """All triangles where the field crosses zero, with the evidence of their vertices."""

    vertices: Floats  # (V, 3) local frame, m
    faces: Ints32  # (F, 3) rows of the vertices, counter-clockwise seen from free space
    confidence: Floats32  # (V,) see :meth:`Map.confidence`
    uncertainty_m: Floats32  # (V,) see :meth:`Map.uncertainty`
    tally: Tally  # area by confidence
    cells_searched: int  # number of leaf cells that may contain surface

    @classmethod
    def of(
        cls, contents: MapContents, voxel_m: float, box: Floats | None = None, progress: bool | None = False
    ) -> "Surface":
        """Extract the surface in voxels of this edge, m, of the whole map or in a `box` (2, 3), local frame, m."""
        vertices, faces, searched = extract_triangles(contents, voxel_m, box, progress)
        # Via world coordinates, for the same rounding as queries at the vertices of the mesh.
        points = to_local(contents, vertices + contents.origin)
        return cls.from_triangles(contents, vertices, faces, evidence(contents, points), searched)

    @classmethod
    def from_triangles(
        cls, scene: WholeMap, vertices: Floats, faces: Ints32, evidence: EvidenceAt, cells_searched: int
    ) -> "Surface":
        found = probabilities(scene, evidence)
        confidence = found.confidence.astype(np.float32)
        columns = confidence.astype(np.float64), found.covering, found.reach, evidence.hits.astype(np.float64)
        tally = Tally.of(vertex_areas(vertices, faces), *columns)
        sigma_m = uncertainty(scene, evidence)
        return cls(vertices, faces, confidence, sigma_m, tally, cells_searched)

    def kept(self, limits: Limits, open_at: Sequence[int] | Ints = ()) -> Bools:
        """Return a mask (F,) of the faces within the limits, without small components that use no vertex of `open_at` (B,)."""
        min_confidence = self.tally.threshold(limits.min_confidence).min_confidence
        kept = with_all(limits.met(min_confidence, self.confidence, self.uncertainty_m), self.faces)
        rows = np.flatnonzero(kept)
        if len(rows):
            labels, sizes = mesh_components(self.faces.take(rows, axis=0), len(self.vertices))
            large = sizes >= limits.min_component_triangles
            if len(open_at):
                large[labels[np.isin(self.faces[rows], open_at).any(axis=1)]] = True
            kept[rows] = large.take(labels)
        return kept

    def mesh(self, origin: Floats, limits: Limits, leaf_cells: int) -> Mesh:
        """Build the mesh within the limits in the world frame. `leaf_cells`: number in the whole map."""
        counts = {"leaf_cells": leaf_cells, "leaf_cells_searched": self.cells_searched}
        threshold = self.tally.threshold(limits.min_confidence)
        return self.part(origin, self.kept(limits), **counts, **vars(threshold))

    def part(self, origin: Floats, kept: Bools, **metadata: Any) -> Mesh:
        """Build the mesh of the faces in the mask `kept` (F,), in the world frame."""
        import trimesh  # noqa: PLC0415 - slow

        used, faces = renumbered(len(self.vertices), self.faces.take(np.flatnonzero(kept), axis=0))
        rows = np.flatnonzero(used)
        vertices = self.vertices.take(rows, axis=0) + origin
        known = {"confidence": self.confidence, "uncertainty_m": self.uncertainty_m}
        of_rows: dict[str, Any] = {name: values.take(rows) for name, values in known.items()}
        return trimesh.Trimesh(vertices, faces, process=False, vertex_attributes=of_rows, metadata=metadata)


def across_triangles(vertices: Floats, faces: Ints32) -> tuple[Floats, Floats]:
    """Return the cross products (F, 3) of the edges of triangles (F, 3), and their lengths (F,), twice the areas, m²."""
    corners = vertices[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return across, np.sqrt(np.einsum("ni,ni->n", across, across))


def with_all(good: Bools, faces: Ints32) -> Bools:
    """Return a mask (F,) of the faces (F, 3) with all vertices in the mask `good` (V,)."""
    first, second, third = faces.T
    return good.take(first) & good.take(second) & good.take(third)


def renumbered(num_vertices: int, faces: Ints32) -> tuple[Bools, Ints32]:
    """Return a mask (V,) of the vertices that faces use, and the faces (F, 3) renumbered accordingly."""
    used = np.zeros(num_vertices, bool)
    used[faces] = True
    renumbered = np.cumsum(used, dtype=np.int32) - np.int32(1)
    return used, renumbered.take(faces)


def extract_triangles(
    contents: MapContents, voxel_size: float, box: Floats | None, progress: bool | None
) -> tuple[Floats, Ints32, int]:
    """Triangulate in voxels with centres in the box, local frame, m: vertices (V, 3), faces (F, 3), number of cells searched."""
    config, table, num_threads = contents.config, contents.field.table, torch.get_num_threads()
    placement = [voxel_size] * 3, [0.0] * 3, 0.0, num_threads
    parts, even = per_cell(voxel_size, config.leaf_size_m)
    stored_m = contents.field.corner_distances_m()
    if stored_m is None or not even:
        corners, voxel_corners, distances_m, searched = sample_lattice(contents, voxel_size, box, progress)
        return *marching_cubes_sparse(corners, distances_m, voxel_corners, *placement), searched
    if parts == 1 and box is None:  # on the corners themselves, in two thirds of the time
        corners, of_cells = table.leaf_vertices(num_threads)
        return *marching_cubes_sparse(corners, stored_m, of_cells, *placement), len(of_cells)
    rows = table.cells_near_surface(stored_m, 0.0, num_threads)
    within = np.full((2, 3), [[-np.inf], [np.inf]])  # voxels
    if box is not None:
        rows = rows[_overlap(table.leaf_cells()[rows], config.leaf_size_m, box)]
        within = box / voxel_size - 0.5
    _check_voxels(len(rows), voxel_size, parts, even, config)
    ends = np.ceil(within[0]), np.floor(within[1])
    lowest, highest = np.clip(ends, -_MAX_VOXELS, _MAX_VOXELS).astype(int)
    return *table.surface(stored_m, rows, parts, voxel_size, lowest, highest, num_threads), len(rows)


def sample_lattice(
    contents: MapContents, voxel_size: float, box: Floats | None, progress: bool | None
) -> tuple[Ints32, Ints32, Floats32, int]:
    """Return lattice coordinates of the corners (K, 3) of voxels in leaf cells that may contain surface, the rows of each
    voxel (M, 8), signed distances at the corners (K,), m, and the number of these cells."""
    config, leaf_size_m, num_threads = contents.config, contents.config.leaf_size_m, torch.get_num_threads()
    parts, even = per_cell(voxel_size, leaf_size_m)
    cells = contents.field.table.leaf_cells()
    stored_m = contents.field.corner_distances_m()
    if stored_m is not None and voxel_size < leaf_size_m:
        cells = cells[contents.field.table.cells_near_surface(stored_m, _CLEARLY * leaf_size_m, num_threads)]
    if box is not None:
        cells = cells[_overlap(cells, leaf_size_m, box)]
    if stored_m is None and voxel_size < leaf_size_m and contents.field.smooth_in_cells:
        cells = crossed(cells, leaf_size_m, partial(_corner_distances, contents, leaf_size_m))
    _check_voxels(len(cells), voxel_size, parts, even, config)
    if even:
        voxels = subdivided(cells, parts)
    else:
        # Points across a cell, at most a voxel apart, hit every voxel that overlaps it; with duplicates.
        ends = np.clip(np.arange(parts + 1) / parts, 1e-6, 1 - 1e-6)
        inside = np.stack(np.meshgrid(*[ends] * 3, indexing="ij"), -1).reshape(1, -1, 3)
        places = (cells[:, None] + inside) * (leaf_size_m / voxel_size)
        voxels = np.floor(places).astype(np.int32).reshape(-1, 3)
    if box is not None:
        centres = (voxels + 0.5) * voxel_size
        voxels = voxels[((centres >= box[0]) & (centres <= box[1])).all(axis=1)]
    if voxel_size < leaf_size_m and not even:
        # Only voxels with their centre in an occupied cell: others would extrapolate the surface beyond the map.
        middles = (voxels.astype(np.float32) + np.float32(0.5)) * np.float32(voxel_size)
        voxels = voxels[evaluate(contents.field.occupied, middles)]
    voxels, corners, voxel_corners = sparse_lattice(voxels, num_threads=num_threads)
    distances_m = _corner_distances(contents, voxel_size, voxels, corners, voxel_corners, progress)
    return corners, voxel_corners, distances_m, len(cells)


def _overlap(cells: Ints32, leaf_size_m: float, box: Floats) -> Bools:
    return (((cells + 1) * leaf_size_m >= box[0]) & (cells * leaf_size_m <= box[1])).all(axis=1)


def crossed(
    cells: NDArray[np.integer[Any]],
    leaf_size_m: float,
    distances_at: Callable[[Ints32, Ints32, Ints32], Array],
) -> Ints32:
    """Return the leaf cells among (M, 3) with corners, by `distances_at`, not all clearly on one side of the surface."""
    unique, corners, cell_corners = sparse_lattice(cells, num_threads=torch.get_num_threads())
    values_m = distances_at(unique, corners, cell_corners)[cell_corners]
    columns = np.ascontiguousarray(values_m.T)  # reductions along rows of eight are slow
    margin_m = _CLEARLY * leaf_size_m
    return unique[(columns.min(axis=0) <= margin_m) & (columns.max(axis=0) >= -margin_m)]


def per_cell(voxel_size: float, leaf_size_m: float) -> tuple[int, bool]:
    """Return the number of voxels along the edge of a leaf cell, and whether they divide it evenly."""
    parts = max(1, math.ceil(min(leaf_size_m / voxel_size, _MAX_VOXELS) - 1e-9))
    return parts, math.isclose(parts * voxel_size, leaf_size_m, rel_tol=1e-9)


def subdivided(cells: Array, parts: int) -> Array:
    """Subdivide cells (M, 3) into voxels (M · parts³, 3), `parts` along an edge."""
    inside = np.indices((parts,) * 3, cells.dtype).reshape(3, -1).T
    return (cells[:, None] * cells.dtype.type(parts) + inside).reshape(-1, 3)


def _check_voxels(cells: int, voxel_size: float, parts: int, even: bool, config: FitConfig) -> None:
    within = max(cells, 1) * (parts + 1) ** 3 <= _MAX_VOXELS  # so that coordinates are int32, too
    check(
        within, f"voxels of {voxel_size} m are too many for cells of {config.leaf_size_m} m: use larger ones"
    )
    needed = cells * (parts if even else parts + 1) ** 3 * _MEMORY_PER_VOXEL
    check_memory(f"voxels of {voxel_size} m", needed, config.max_memory_bytes, "use larger ones")


def _corner_distances(
    contents: MapContents,
    voxel_size: float,
    voxels: Ints32,
    corners: Ints32,
    voxel_corners: Ints32,
    progress: bool | None = False,
) -> Floats32:
    # A corner on the border of the map may be in an empty cell beyond it. It is moved towards the centre of one of its voxels
    # until it is in an occupied cell, and the distance moved is added to its absolute value.
    points = corners.astype(np.float32) * np.float32(voxel_size)
    moved = np.flatnonzero(~evaluate(contents.field.occupied, points))
    # Move each corner into its last voxel: NumPy keeps the last assignment of repeated indices.
    owners = np.zeros(len(corners), np.int32)
    owners[voxel_corners.reshape(-1)] = np.repeat(np.arange(len(voxels), dtype=np.int32), 8)
    centres = (voxels[owners[moved]].astype(np.float32) + np.float32(0.5)) * np.float32(voxel_size)
    corner, place, left = points[moved], points[moved], np.arange(len(moved))
    for share in (_INWARD, 0.25, 0.5, 0.75, 1.0):
        place[left] = corner[left] + np.float32(share) * (centres[left] - corner[left])
        left = left[~evaluate(contents.field.occupied, place[left])]
    points[moved] = place
    values = signed_distance(contents, points, description="mesh", progress=progress)
    values[moved] += np.copysign(np.linalg.norm(place - corner, axis=1), values[moved])
    return values
