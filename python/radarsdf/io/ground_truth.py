# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Ground truth from files of any kind: points of a lidar, or a surface."""

from __future__ import annotations

from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from radarsdf.checks import positions
from radarsdf.io.clouds.reading import CLOUD_SUFFIXES, read_points
from radarsdf.io.meshes import MESH_SUFFIXES, holds_mesh, read_mesh
from radarsdf.io.npz import arrays_of

_ARRAYS = ("lidar_points", "points", "xyz", "arr_0")  # of which the first that a file has counts
_SAMPLES = 1_000_000  # on a surface: a triangle of a building may be 20 m long


def read_ground_truth(path: str | PathLike[str]) -> NDArray[np.float64]:
    """Reads points of a lidar, or draws points evenly on the triangles of a surface.

    Parameters
    ----------
    path : path-like
        A file for :func:`read_points`; ``.npz`` with an array (M, 3) of one of the names lidar_points, points, xyz and
        arr_0; or a mesh, in PLY, OBJ, OFF, STL or GLB.

    Returns
    -------
    ndarray
        (M, 3) float64, world frame, m. The same file gives the same points.

    Raises
    ------
    ValueError
        If the file is damaged, of another kind, or holds no points.
    OSError
        If it cannot be read.
    ImportError
        If it takes a library that is not installed; the message says which.
    """
    file = Path(path)
    suffix = file.suffix.lower()
    if holds_mesh(file):
        return _on_surface(file)
    if suffix == ".npz":
        arrays = arrays_of(file, _ARRAYS)
        if not arrays:
            msg = f"{path} has no ground truth: it lacks an array {' or '.join(_ARRAYS)}"
            raise ValueError(msg)
        name, points = next(iter(arrays.items()))
        return positions(points, f"{path}: {name}")
    if suffix not in CLOUD_SUFFIXES:
        kinds = dict.fromkeys((*CLOUD_SUFFIXES, ".npz", *MESH_SUFFIXES))
        msg = f"{path} is no ground truth: that is a file that ends in {', '.join(kinds)}"
        raise ValueError(msg)
    return read_points(file)


def _on_surface(file: Path) -> NDArray[np.float64]:
    mesh = read_mesh(file)
    if not mesh.area > 0:  # NaN too
        msg = f"{file} has no surface"
        raise ValueError(msg)
    # By area, in the order of the triangles: a triangle has points wherever it is large.
    points, _ = mesh.sample(_SAMPLES, return_index=True, seed=0)
    found: NDArray[np.float64] = np.asarray(points, np.float64)
    return found
