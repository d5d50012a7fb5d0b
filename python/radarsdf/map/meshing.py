# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""From a map to triangles: where to look for the surface, its vertices, and what they carry."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from radarsdf.budget.estimate import check_mesh
from radarsdf.checks import MAX_POSITION_M, positive, real_array
from radarsdf.fitting.stopping import whole_import
from radarsdf.map.isosurface import extract_cells, mesh_components, sparse_lattice
from radarsdf.map.radar_map import evaluate
from radarsdf.render.picture import intensity_colors

with whole_import():
    import trimesh

if TYPE_CHECKING:
    from radarsdf.config import FitConfig
    from radarsdf.map.radar_map import RadarMap

_MAX_VOXELS = 2**30  # of which some are the same; coordinates, and rows of corners, are int32
_CLEARLY = 0.25  # of a leaf cell. Measured on four scenes: 0.1 loses no triangle that 0 lost, and 0.25 keeps half the cells
_PART = 1 << 21  # numbers that NumPy is given at a time
_INWARD = 1e-3  # of a voxel: how far corners on the map's border are moved into it to be evaluated


def extract_mesh(
    radar_map: RadarMap,
    voxel_size: float = 0.1,
    *,
    box: ArrayLike | None = None,
    viewpoint: ArrayLike | None = None,
    min_confidence: float = 0.0,
    progress: bool | None = None,
) -> trimesh.Trimesh:
    """Marching cubes on the zero level of the signed distance, only where the map is occupied.

    Parameters
    ----------
    radar_map : RadarMap
        The map.
    voxel_size : float
        Edge of the marching cubes' cells, m.
    box : (2, 3) array_like, optional
        Lower and upper corner, world, m: only voxels whose centres lie inside are meshed.
    viewpoint : (3,) array_like, optional
        Sensor position, world, m. The vertices then carry the predicted intensity for it, in sensor units, as
        ``mesh.vertex_attributes["intensity"]``, and colours from dark (low) to bright (high).
    min_confidence : float
        In [0, 1]: triangles with a vertex of less confidence are left out, before small components are; so are, in any
        case, those below :attr:`RadarMap.least_confidence`.
    progress : bool, optional
        Whether to show a progress bar; by default only on a terminal.

    Returns
    -------
    trimesh.Trimesh
        World frame, m; triangles, and so vertex normals, face free space. Components of fewer triangles
        than ``config.min_component_triangles`` are left out. Empty where there is no surface. The vertices carry
        :meth:`RadarMap.confidence` as ``mesh.vertex_attributes["confidence"]``, where the map knows it. ``mesh.metadata`` counts leaf cells, and those
        that were searched because the surface could lie in them.

    Raises
    ------
    ValueError
        For a voxel size, box, viewpoint or confidence that makes no sense, a viewpoint for a map without intensities,
        or a confidence for a map that does not know it.
    MemoryError
        If so many voxels take more than ``config.max_memory_bytes``, or than the system has.
    """
    if not 0 <= min_confidence <= 1:
        msg = f"min_confidence must be in [0, 1], not {min_confidence}"
        raise ValueError(msg)
    voxel_size = positive(voxel_size, "voxel_size")
    if voxel_size > MAX_POSITION_M:
        msg = f"voxel_size must be at most {MAX_POSITION_M:g} m, not {voxel_size}"
        raise ValueError(msg)
    sensor_position = None if viewpoint is None else _check_viewpoint(radar_map, viewpoint)
    cells = radar_map.field.cells.table.leaf_cells()
    num_cells = len(cells)
    leaf_size_m = radar_map.config.leaf_size_m
    if box is not None:
        lower, upper = _check_box(box) - radar_map.origin
        cells = cells[(((cells + 1) * leaf_size_m >= lower) & (cells * leaf_size_m <= upper)).all(axis=1)]
    num_threads = torch.get_num_threads()
    if voxel_size == leaf_size_m and box is None and _is_grid(radar_map.config):
        searched = len(cells)
        corners, voxel_corners, values = _grid(radar_map, progress)
    else:
        if voxel_size < leaf_size_m and _smooth_in_cells(radar_map.config):
            cells = _crossed(radar_map, cells)
        searched = len(cells)
        voxels = _voxels_of(cells, voxel_size, radar_map.config)
        if box is not None:
            centres = (voxels + 0.5) * voxel_size
            voxels = voxels[((centres >= lower) & (centres <= upper)).all(axis=1)]
        if voxel_size < leaf_size_m and not _per_cell(voxel_size, leaf_size_m)[1]:
            voxels = _in_map(radar_map, voxels, voxel_size)
        voxels, corners, voxel_corners = sparse_lattice(voxels, num_threads=num_threads)
        values = _corner_distances(radar_map, voxel_size, voxels, corners, voxel_corners, progress)
    vertices, faces = extract_cells(
        corners, values, voxel_corners, spacing=[voxel_size] * 3, num_threads=num_threads
    )
    confidence = None
    if radar_map.support is not None or min_confidence > 0:
        confidence = radar_map.confidence(vertices + radar_map.origin).astype(np.float32)
        least = max(min_confidence, radar_map.least_confidence)
        faces = faces[(confidence[faces] >= least).all(axis=1)]
    kept, faces = _without_small_components(len(vertices), faces, radar_map.config.min_component_triangles)
    mesh = trimesh.Trimesh(vertices[kept] + radar_map.origin, faces, process=False)
    mesh.metadata |= {"leaf_cells": num_cells, "leaf_cells_searched": searched}
    if confidence is not None:
        mesh.vertex_attributes["confidence"] = confidence[kept]
    if sensor_position is not None:
        intensity = radar_map.intensity(np.asarray(mesh.vertices), sensor_position).astype(np.float32)
        mesh.vertex_attributes["intensity"] = intensity
        scale = radar_map.intensity_scale
        assert scale is not None
        colors = intensity_colors(intensity, scale.low, scale.high)
        mesh.visual = trimesh.visual.ColorVisuals(mesh, vertex_colors=colors)
    return mesh


def _check_viewpoint(radar_map: RadarMap, viewpoint: ArrayLike) -> NDArray[np.float64]:
    if not radar_map.has_intensity:
        msg = "a viewpoint needs a map with intensities, and this one was fitted without"
        raise ValueError(msg)
    sensor_position = real_array(viewpoint, "viewpoint")
    if sensor_position.shape != (3,) or not np.isfinite(sensor_position).all():
        msg = "viewpoint must be one position (3,)"
        raise ValueError(msg)
    return sensor_position


def _check_box(box: ArrayLike) -> NDArray[np.float64]:
    corners = real_array(box, "box")
    if corners.shape != (2, 3) or not (corners[0] < corners[1]).all():
        msg = "box must be a lower and a higher corner, (2, 3)"
        raise ValueError(msg)
    return corners


def _smooth_in_cells(config: FitConfig) -> bool:
    """Whether nothing in the encoding swings more than once within two leaf cells."""
    finest = config.fourier_first + config.fourier_count - 1
    return config.fourier_count == 0 or 2 * config.fourier_half_width_m / 2**finest >= 2 * config.leaf_size_m


def _is_grid(config: FitConfig) -> bool:
    """Whether the field at a vertex of the leaf cells is that of its features alone."""
    return config.encoding == "octree" and config.num_levels == 1 and config.fourier_count == 0


def _grid(
    radar_map: RadarMap, progress: bool | None
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.float32]]:
    """Vertices (V, 3) of the leaf cells, those (C, 8) of each cell, and the signed distances (V,), m, where :func:`_is_grid`.

    The features are what would be interpolated there, so nothing has to be looked up.
    """
    field = radar_map.field
    corners, cell_corners = field.cells.table.leaf_vertices()
    values: NDArray[np.float32] = evaluate(
        lambda features: field.sdf_network([features])[0] * field.sigma_m,
        field.cells.features.detach(),
        description="mesh",
        progress=progress,
    ).numpy()
    return corners, cell_corners, values


def _crossed(radar_map: RadarMap, cells: NDArray[np.int32]) -> NDArray[np.int32]:
    """The leaf cells (M, 3) that can hold the surface: those whose corners are not all clearly on one side."""
    size_m = radar_map.config.leaf_size_m
    cells, corners, cell_corners = sparse_lattice(cells, num_threads=torch.get_num_threads())
    values = _corner_distances(radar_map, size_m, cells, corners, cell_corners, progress=False)[cell_corners]
    margin_m = _CLEARLY * size_m
    crossed: NDArray[np.int32] = cells[(values.min(axis=1) <= margin_m) & (values.max(axis=1) >= -margin_m)]
    return crossed


def _per_cell(voxel_size: float, leaf_size_m: float) -> tuple[int, bool]:
    """Voxels along the edge of a leaf cell, and whether they divide it: each then lies in one cell."""
    parts = max(1, math.ceil(min(leaf_size_m / voxel_size, _MAX_VOXELS) - 1e-9))
    return parts, math.isclose(parts * voxel_size, leaf_size_m, rel_tol=1e-9)


def _occupied(radar_map: RadarMap, points: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Whether each of the points (N, 3), local frame, m, lies in an occupied leaf cell."""
    inside: NDArray[np.bool_] = evaluate(radar_map.field.cells.occupied, torch.from_numpy(points)).numpy()
    return inside


def _voxels_of(cells: NDArray[np.int32], voxel_size: float, config: FitConfig) -> NDArray[np.int32]:
    """Lattice coordinates (M, 3) of the voxels that overlap leaf cells; some more than once."""
    leaf_size_m = config.leaf_size_m
    parts, even = _per_cell(voxel_size, leaf_size_m)
    if max(len(cells) * (parts + 1) ** 3, int(np.abs(cells).max(initial=0)) * parts) > _MAX_VOXELS:
        msg = f"voxels of {voxel_size} m are too many for {len(cells)} cells of {leaf_size_m} m: use larger ones"
        raise ValueError(msg)
    check_mesh(len(cells) * (parts if even else parts + 1) ** 3, voxel_size, config.max_memory_bytes)
    # Where they are not even: points of the cell no further apart than a voxel, from one end to the other, fall into each
    # voxel that overlaps it.
    ends = np.clip(np.arange(parts + 1) / parts, 1e-6, 1 - 1e-6)
    steps = np.arange(parts, dtype=np.int32) if even else ends
    inside = np.stack(np.meshgrid(*[steps] * 3, indexing="ij"), -1).reshape(1, -1, 3)
    voxels = np.zeros((len(cells), *inside.shape[1:]), np.int32)
    for some in _parts(len(cells), inside.size):
        if even:
            voxels[some] = cells[some, None, :] * np.int32(parts) + inside
        else:
            voxels[some] = np.floor((cells[some, None, :] + inside) * (leaf_size_m / voxel_size))
    return voxels.reshape(-1, 3)


def _in_map(radar_map: RadarMap, voxels: NDArray[np.int32], voxel_size: float) -> NDArray[np.int32]:
    """The voxels whose centre lies in an occupied cell: others would continue the surface beyond the map."""
    centres = (voxels.astype(np.float32) + np.float32(0.5)) * np.float32(voxel_size)
    return voxels[_occupied(radar_map, centres)]


def _corner_distances(
    radar_map: RadarMap,
    voxel_size: float,
    voxels: NDArray[np.int32],
    corners: NDArray[np.int32],
    voxel_corners: NDArray[np.int32],
    progress: bool | None,
) -> NDArray[np.float32]:
    """Signed distance (K,) at lattice corners (K, 3), m.

    A corner on the border of the occupied cells may belong to the cell beyond, which has no features: its value would
    jump. It is evaluated a hair inside one of its own voxels instead. A corner further out, as voxels have that do not
    divide the cells, is moved until it is inside, and the way is added to its distance.
    """
    points = corners.astype(np.float32) * np.float32(voxel_size)
    outside = ~_occupied(radar_map, points)
    # The voxel that a corner is moved into: of several the last. NumPy lets the last of equal indices count.
    owners = np.zeros(len(corners), np.int32)
    for part in _parts(len(voxels)):
        owners[voxel_corners[part].reshape(-1)] = np.repeat(
            np.arange(part.start, part.stop, dtype=np.int32), 8
        )
    moved = np.flatnonzero(outside)
    way_m = np.zeros(len(moved), np.float32)
    for part in _parts(len(moved)):
        corner = points[moved[part]]
        centres = (voxels[owners[moved[part]]].astype(np.float32) + np.float32(0.5)) * np.float32(voxel_size)
        place, left = corner.copy(), np.arange(len(corner))
        for share in (_INWARD, 0.25, 0.5, 0.75, 1.0):
            place[left] = corner[left] + np.float32(share) * (centres[left] - corner[left])
            left = left[~_occupied(radar_map, place[left])]
        points[moved[part]] = place
        way_m[part] = np.linalg.norm(place - corner, axis=1)
    values: NDArray[np.float32] = evaluate(
        radar_map.local_sdf, torch.from_numpy(points), description="mesh", progress=progress
    ).numpy()
    values[moved] += np.copysign(way_m, values[moved])
    return values


def _parts(count: int, numbers: int = 8) -> Iterator[slice]:
    """Slices of [0, count), of so many numbers for each, that are short enough for Ctrl-C not to wait for NumPy."""
    step = max(1, _PART // numbers)
    return (slice(first, min(first + step, count)) for first in range(0, count, step))


def _without_small_components(
    num_vertices: int, faces: NDArray[np.int32], min_triangles: int
) -> tuple[NDArray[np.bool_], NDArray[np.int32]]:
    """Which vertices (V,) the large components use, and their faces in the numbers of these vertices."""
    labels, sizes = mesh_components(faces, num_vertices)
    faces = faces[sizes[labels] >= min_triangles] if len(faces) else faces
    used = np.zeros(num_vertices, bool)
    used[faces] = True
    renumbered = np.cumsum(used, dtype=np.int32) - np.int32(1)
    return used, renumbered[faces]
