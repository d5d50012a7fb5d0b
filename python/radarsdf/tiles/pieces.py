# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The mesh of a tile: cut on the lattice of all tiles, so that those of neighbours fit to the bit."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from radarsdf.io.npz import arrays_of, check_arrays, write_arrays
from radarsdf.map.marching_cubes import extract_cells, sparse_lattice
from radarsdf.map.mesh import Surface, crossed, renumbered
from radarsdf.map.threshold import TALLY_NUMBERS
from radarsdf.threads import torch_threads
from radarsdf.tiles.blend import TileBlend
from radarsdf.tiles.grid import Tile, neighbours
from radarsdf.tiles.plan import folder_of, within

_FILES = "mesh-*.npz"
_ON_LATTICE = 1e-4  # voxels: vertices are at least 1e-3 from the corners of their edges


@dataclass(frozen=True)
class PieceSettings:
    """What the triangles of a tile depend on."""

    voxels_per_cell: int
    """Along the edge of a leaf cell."""
    box: tuple[tuple[float, ...], ...] | None
    """Lower and upper corner, world, m."""
    max_uncertainty: float
    """m. What else is left out of a mesh depends on the other tiles."""

    def to_json(self) -> str:
        """For arguments of tasks. :meth:`from_json` is its inverse."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> PieceSettings:
        """The settings that :meth:`to_json` wrote."""
        values: dict[str, Any] = json.loads(text)
        box = values.pop("box")
        return cls(box=None if box is None else tuple(map(tuple, box)), **values)


@dataclass(frozen=True)
class Piece:
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
    """(B, 4) the edge of the lattice that each of them is on: its lower corner, in voxels of the lattice, and its
    axis."""
    cells: NDArray[np.int64]
    """(2,) leaf cells, and those in which the surface can be."""
    tally: NDArray[np.float64]
    """:meth:`Tally.sums` of all surface of the tile."""

    @classmethod
    def load(cls, path: Path) -> Piece:
        """Reads what :func:`mesh_tile` wrote. Raises a ValueError if the file is damaged."""
        piece = cls(**_read(path, _ARRAYS))
        count, borders = len(piece.vertices), len(piece.border_rows)
        if (
            {count} != {len(piece.confidence), len(piece.uncertainty_m)}
            or len(piece.border_edges) != borders
            or not np.isfinite(piece.vertices).all()
            or not all(((rows >= 0) & (rows < count)).all() for rows in (piece.faces, piece.border_rows))
        ):
            msg = f"{path} is not a whole piece of a mesh: its arrays do not fit together"
            raise ValueError(msg)
        return piece


def tally_sums(path: Path) -> NDArray[np.float64]:
    """The `tally` of the piece in a file, of which nothing else is read. Raises as :meth:`Piece.load`."""
    return _read(path, ["tally"])["tally"]


def _read(path: Path, names: Iterable[str]) -> dict[str, NDArray[Any]]:
    arrays = arrays_of(path, names)
    try:
        check_arrays(arrays, {name: _ARRAYS[name] for name in names})
    except ValueError as error:
        msg = f"{path} is not a whole piece of a mesh: {error}"
        raise ValueError(msg) from error
    return arrays


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
"""Type and shape of each array of a `Piece`. None: any length."""


def piece_path(city: TileBlend, tile: Tile, settings: PieceSettings) -> Path:
    """The file of a piece. The same settings of the same plan give the same file."""
    text = settings.to_json() + str([other for other in neighbours(tile) if city.has(other)])
    key = hashlib.blake2b((city.plan.digest + text).encode(), digest_size=8).hexdigest()
    name = _FILES.replace("*", key)
    return within(city.folder, folder_of(city.folder, tile) / name)


def pieces_in(folder: Path) -> list[Path]:
    """The files of all pieces in the folder of a tile, of whatever settings."""
    return list(folder.glob(_FILES))


def mesh_tile(folder: str, name: str, settings: str, run: str = "") -> str:
    """Meshes the tile of this name, unless that is done. `settings` are :meth:`PieceSettings.to_json`.

    Returns the path of the piece. The other arguments are those of :func:`radarsdf.tiles.tile_fit.fit_tile`.
    """
    city = _opened(folder, run) if run else TileBlend(folder)
    with torch_threads(city.config.num_threads):
        return str(write_piece(city, name, PieceSettings.from_json(settings)))


@lru_cache(maxsize=1)
def _opened(folder: str, run: str) -> TileBlend:
    """One for all tasks of a run in a process: the next tile mostly needs the same neighbours in memory."""
    del run
    return TileBlend(folder)


def write_piece(city: TileBlend, name: str, settings: PieceSettings) -> Path:
    """Writes the piece of a tile, unless it is there. Gives its path."""
    (tile,) = (planned.tile for planned in city.plan.tiles if planned.name == name)
    path = piece_path(city, tile, settings)
    if not path.is_file():
        write_arrays(path, vars(piece_of(city, tile, settings)))
    return path


def piece_of(city: TileBlend, tile: Tile, settings: PieceSettings) -> Piece:
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
    return Piece(
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
    """(C, 3) leaf cells of a tile, as the lattice numbers them: those of its map, and of others that count there."""
    plan = city.plan
    parts = []
    for other in neighbours(tile):
        if city.has(other):
            cells = city.leaf_cells(other, within=tile)
            centres = plan.config.lattice.position(cells + 0.5)
            parts.append(cells[plan.grid.within_half_a_halo(other, centres)])
    found: NDArray[np.int64] = sparse_lattice(np.concatenate(parts))[0].astype(np.int64)
    return found


def _border(places: NDArray[np.float64], voxels_per_tile: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
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


def divides(voxel_m: float, leaf_size_m: float) -> int:
    """Voxels along the edge of a leaf cell. Raises a ValueError unless they fill it."""
    steps = round(leaf_size_m / voxel_m) if voxel_m <= leaf_size_m else 0
    if steps < 1 or not math.isclose(steps * voxel_m, leaf_size_m, rel_tol=1e-9):
        msg = f"voxels of {voxel_m:g} m do not divide leaf cells of {leaf_size_m:g} m, as those of tiles must: use {leaf_size_m / 2:g} or {leaf_size_m:g}"
        raise ValueError(msg)
    return steps
