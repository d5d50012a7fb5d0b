# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Rasterisation of triangles: visibility, barycentric weights, normals and contours."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_Floats = NDArray[np.float64]
_Integers = NDArray[np.int64]

PIXELS_AT_ONCE = 1 << 21  # bounds the memory
_CREASE = np.cos(np.deg2rad(40.0))  # edges with a larger angle are drawn sharp, others are shaded smoothly


def project(seen: _Floats, faces: _Integers, size: tuple[int, int]) -> tuple[_Floats, _Floats, _Floats]:
    """Column, row and 1 / depth (V,) of vertices (V, 3) along right, up and forward of the eye, zoomed to fill the picture.

    1 / depth is NaN behind the viewer. `size`: height and width, pixels.
    """
    depth = seen[:, 2]
    depth = np.where(depth > 1e-3 * np.abs(depth).max(), depth, np.nan)
    u, v = seen[:, 0] / depth, -seen[:, 1] / depth
    used = np.unique(faces)
    wide = np.hypot(u[used], v[used]) > 1.5  # more than 56° from the axis: the zoom ignores these vertices
    used = used[np.isfinite(depth[used]) & ~wide]
    if len(used) == 0:
        return u, v, np.full(len(u), np.nan)
    screen = np.stack([u[used], v[used]])
    low, high = np.percentile(screen, [2, 98], axis=1)
    reach = 0.2 * (high - low)  # all of a compact scene, yet a few stray triangles must not make it small
    low, high = np.maximum(low - reach, screen.min(axis=1)), np.minimum(high + reach, screen.max(axis=1))
    focal = 0.93 * float(np.min(np.array(size[::-1]) / np.maximum(high - low, 1e-9)))
    middle = 0.5 * (low + high)
    return (u - middle[0]) * focal + size[1] / 2, (v - middle[1]) * focal + size[0] / 2, 1.0 / depth


def rasterise(x: _Floats, y: _Floats, nearness: _Floats, size: tuple[int, int]) -> tuple[_Integers, _Floats]:
    """Index of the nearest triangle at the centre of each pixel (height, width), else -1, and its 1 / depth, else 0.

    `x`, `y`, `nearness` (F, 3): column, row and 1 / depth of the corners. Scan-line conversion: each line of pixel
    centres enters a triangle through one edge and leaves it through another. Both triangles at an edge compute the same
    crossing, and a pixel on it belongs to the triangle on the right, so there are no gaps and no overlaps.
    """
    height, width = size
    ids, nearest = np.full(height * width, -1, dtype=np.int64), np.zeros(height * width)
    first = np.clip(np.ceil(y.min(axis=1) - 0.5), 0, height).astype(np.int64)
    lines = np.clip(np.ceil(y.max(axis=1) - 0.5), 0, height).astype(np.int64) - first
    face, offset = _expand(lines)
    row = first[face] + offset
    left, right = np.full(len(face), np.inf), np.full(len(face), -np.inf)
    for i, j in ((0, 1), (1, 2), (2, 0)):
        swap = y[:, i] > y[:, j]
        (x0, x1), (y0, y1) = (
            (np.where(swap, a[:, j], a[:, i])[face], np.where(swap, a[:, i], a[:, j])[face]) for a in (x, y)
        )
        crosses = (y0 <= row + 0.5) & (row + 0.5 < y1)
        at = x0 + (row + 0.5 - y0) / np.where(crosses, y1 - y0, 1.0) * (x1 - x0)
        left = np.where(crosses, np.minimum(left, at), left)
        right = np.where(crosses, np.maximum(right, at), right)
    begin = np.clip(np.ceil(left - 0.5), 0, width).astype(np.int64)
    count = np.maximum(np.clip(np.ceil(right - 0.5), 0, width).astype(np.int64) - begin, 0)
    ends = np.cumsum(count)
    for lower in range(0, int(ends[-1]) if len(ends) else 0, PIXELS_AT_ONCE):
        part = slice(*np.searchsorted(ends, [lower, lower + PIXELS_AT_ONCE], side="right"))
        span, offset = _expand(count[part])
        f, r, column = face[part][span], row[part][span], begin[part][span] + offset
        weight = barycentric(x[f], y[f], column, r)
        near = np.einsum("ni,ni->n", weight, nearness[f])
        pixel = r * width + column
        np.maximum.at(nearest, pixel, near)
        wins = near == nearest[pixel]
        ids[pixel[wins]] = f[wins]
    return ids.reshape(size), nearest.reshape(size)


def _expand(counts: _Integers) -> tuple[_Integers, _Integers]:
    """Owner of each item, and its number within the owner: of counts 2, 0, 3, these are 0 0 2 2 2 and 0 1 0 1 2."""
    owner = np.repeat(np.arange(len(counts)), counts)
    return owner, np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)


def barycentric(x: _Floats, y: _Floats, column: _Integers, row: _Integers) -> _Floats:
    """Barycentric weights (N, 3) of the corners at pixel centres, clipped: rounding can put a centre outside thin triangles."""
    px, py = column + 0.5, row + 0.5
    a = (x[:, 1] - px) * (y[:, 2] - py) - (x[:, 2] - px) * (y[:, 1] - py)
    b = (x[:, 2] - px) * (y[:, 0] - py) - (x[:, 0] - px) * (y[:, 2] - py)
    c = (x[:, 0] - px) * (y[:, 1] - py) - (x[:, 1] - px) * (y[:, 0] - py)
    area = a + b + c
    weight = np.clip(np.stack([a, b, c], axis=1) / np.where(area == 0, 1.0, area)[:, None], 0.0, 1.0) + 1e-12
    return np.asarray(weight / weight.sum(axis=1, keepdims=True), dtype=np.float64)


def corner_normals(vertices: _Floats, faces: _Integers) -> _Floats:
    """Normals (F, 3, 3) at the corners of triangles: the vertex normal on smooth surfaces, else the face normal."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    own = np.cross(b - a, c - a)
    shared = np.zeros_like(vertices)
    for axis in range(3):
        shared[:, axis] = np.bincount(faces.ravel(), np.repeat(own[:, axis], 3), len(vertices))
    own /= np.maximum(np.linalg.norm(own, axis=1, keepdims=True), 1e-300)
    shared /= np.maximum(np.linalg.norm(shared, axis=1, keepdims=True), 1e-300)
    smooth = np.einsum("fij,fj->fi", shared[faces], own) > _CREASE
    return np.where(smooth[..., None], shared[faces], own[:, None])


def contours(nearness: _Floats, step: int) -> NDArray[np.float32]:
    """Brightness factors (height, width) of eye-dome lighting: a pixel is darker if those `step` pixels away are nearer."""
    far = -np.log(np.where(nearness > 0, nearness, np.nan)).astype(np.float32)
    far[np.isnan(far)] = np.inf
    padded = np.pad(far, step, constant_values=np.inf)
    hidden = np.zeros_like(far)
    for dy, dx in ((0, 1), (1, 0), (1, 2), (2, 1), (0, 0), (0, 2), (2, 0), (2, 2)):
        neighbour = padded[dy * step : dy * step + far.shape[0], dx * step : dx * step + far.shape[1]]
        with np.errstate(invalid="ignore"):
            hidden += np.nan_to_num(np.maximum(far - neighbour, 0.0), nan=0.0, posinf=0.0)
    return np.exp(-6.0 * np.minimum(hidden / 8, 0.12)).astype(np.float32)
