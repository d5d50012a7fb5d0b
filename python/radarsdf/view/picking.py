# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Where a ray meets a mesh first."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

_Floats = NDArray[np.float64]


def first_hit(
    vertices: _Floats, faces: NDArray[np.int32], ray_origin: ArrayLike, ray_direction: ArrayLike
) -> _Floats | None:
    """The first point of a triangle on a ray, by Möller and Trumbore's test.

    Parameters
    ----------
    vertices : (V, 3) ndarray
        m.
    faces : (F, 3) ndarray
        Rows of vertices.
    ray_origin, ray_direction : (3,) array_like
        In the frame of the vertices. The direction may have any length but zero.

    Returns
    -------
    (3,) ndarray or None
        None: the ray meets none.
    """
    origin, direction = np.asarray(ray_origin, np.float64), np.asarray(ray_direction, np.float64)
    direction = direction / np.linalg.norm(direction)
    faces = faces[_near(vertices, faces, origin, direction)]
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    p = np.cross(direction, c - a)
    with np.errstate(divide="ignore", invalid="ignore"):  # triangles along the ray
        inverse = 1 / np.einsum("ij,ij->i", b - a, p)
        u = np.einsum("ij,ij->i", origin - a, p) * inverse
        q = np.cross(origin - a, b - a)
        v = q @ direction * inverse
        distances_m = np.einsum("ij,ij->i", c - a, q) * inverse
        hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (distances_m > 0) & np.isfinite(distances_m)
    if not hit.any():
        return None
    point: _Floats = origin + distances_m[hit].min() * direction
    return point


def _near(
    vertices: _Floats, faces: NDArray[np.int32], origin: _Floats, direction: _Floats
) -> NDArray[np.bool_]:
    """(F,) triangles whose first corner is no further from the ray's line than their longest edge. Others cannot be hit."""
    if len(faces) == 0:
        return np.zeros(0, bool)
    offsets = vertices - origin
    distances_m = np.linalg.norm(offsets - np.outer(offsets @ direction, direction), axis=1)
    corners = vertices[faces]
    longest_m = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max()
    near: NDArray[np.bool_] = distances_m[faces[:, 0]] <= longest_m
    return near
