# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Rounding errors of the compiled kernels, against float64 in NumPy."""

from __future__ import annotations

import functools
import math
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from radarsdf import _core
from radarsdf.field import kernels

from .reference_interpolation import Reference

Array = NDArray[Any]
LEAF_M = 0.2
NUM_LEVELS = 3
ENCODINGS = {"tri-quadtree": _core.Encoding.TRI_QUADTREE, "octree": _core.Encoding.OCTREE}
_SURFACE_POINTS = 8000
_EXTENT_M = 8.0
_LAST_M = ((1 << 20) - (1 << 12) - 1) * LEAF_M  # in the last cell that the lattice has at all levels
OFFSETS_M = {"500 m away": 500.0, "last cells": _LAST_M}
PLACES = ("anywhere", "on borders", "500 m away", "last cells")


def points_of(place: str, count: int, dtype: Any, seed: int = 0) -> Array:
    """Points (count, 3), m, in and beside occupied cells, at one of `PLACES` or in "one cell"."""
    rng = np.random.default_rng([seed, count])
    points = surface(rng, count, offset_m=OFFSETS_M.get(place, 0.0)).astype(dtype)
    if place == "last cells":
        points = np.minimum(points, dtype(_LAST_M))
    if place == "on borders":
        near = np.round(points / LEAF_M) * LEAF_M
        kind = rng.integers(4, size=points.shape)
        beside = np.nextafter(near.astype(dtype), np.where(kind == 1, -np.inf, np.inf).astype(dtype))
        points = np.where(kind == 0, near, np.where(kind < 3, beside, points)).astype(dtype)
        points[points == 0] = -0.0
    elif place == "one cell":
        points = rng.uniform(0, LEAF_M, (count, 3)).astype(dtype)
    return points


def surface(rng: np.random.Generator, count: int, offset_m: float = 0.0) -> Array:
    """Points (count, 3) near a wavy surface, m."""
    xy = rng.uniform(-_EXTENT_M, _EXTENT_M, (count, 2))
    z = np.sin(xy[:, 0]) + rng.uniform(-0.3, 0.3, count)
    return np.column_stack([xy, z]) + offset_m


@functools.cache
def table_and_reference(place: str, dtype: Any, encoding: Any) -> tuple[_core.VertexTable, Reference]:
    """Table of the cells of `points_of` for the place, and its reference."""
    cells = _core.CellSet(LEAF_M)
    cells.insert(np.ascontiguousarray(points_of(place, _SURFACE_POINTS, dtype, seed=1)))
    table = _core.VertexTable(cells.sorted_keys(), LEAF_M, NUM_LEVELS, encoding)
    return table, Reference(table.leaf_cells(), LEAF_M, NUM_LEVELS, encoding)


def relative_error(got: Array, exact: tuple[Array, Array]) -> float:
    """Largest |error| / Σ|terms|. Where there are no terms, the result must be zero."""
    value, scale = exact
    error = np.abs(got.astype(np.float64) - value)
    assert not error[scale == 0].any()
    return float((error[scale > 0] / scale[scale > 0]).max(initial=0.0))


class InterpolationCase(NamedTuple):
    """Arguments of the kernels, and what the reference makes of them."""

    table: _core.VertexTable
    points: Array
    features: Array
    g: Array
    directions: dict[str, Array | None]
    """By what is added to the names of the errors: none, and those of derivatives along v."""
    exact: dict[str, tuple[Array, Array]]
    """By the names of the errors."""


def interpolation_case(place: str, count: int, dtype: Any, encoding: Any) -> InterpolationCase:
    """The case of `count` points at one of `PLACES`: it takes much longer than the kernels do."""
    table, reference = table_and_reference(place, dtype, encoding)
    assert table.num_rows == reference.num_rows
    rng = np.random.default_rng(count)
    points = points_of(place, count, dtype)
    features = rng.normal(size=(table.num_rows, 8)).astype(dtype)
    g = rng.normal(size=(count, 8 * NUM_LEVELS)).astype(dtype)
    directions = {"": None, " along v": rng.normal(size=(count, 3)).astype(dtype)}
    exact = {}
    for name, v in directions.items():
        exact["y" + name] = reference.interpolate(features, points, v)
        exact["dF" + name] = reference.scatter(g, points, v)
        exact["dx" + name] = reference.coordinate_gradient(features, g, points, v)
    return InterpolationCase(table, points, features, g, directions, exact)


def interpolation_errors(case: InterpolationCase) -> dict[str, float]:
    """Largest relative error of the features y and of their gradients dF and dx; the same of derivatives along v."""
    table, points, features, g = case[:4]
    located = np.zeros((len(points), NUM_LEVELS), np.int32)
    table.locate(points, located)
    found: dict[str, Array] = {}
    for name, v in case.directions.items():
        # The core must write every number of these two.
        out, points_grad = np.full_like(g, np.nan), np.full_like(points, np.nan)
        features_grad = np.zeros_like(features)
        table.interpolate(features, points, located, v, out)
        table.scatter(points, located, v, g, features_grad)
        table.coordinate_gradient(features, points, located, v, g, points_grad)
        found |= {"y" + name: out, "dF" + name: features_grad, "dx" + name: points_grad}
    return {name: relative_error(got, case.exact[name]) for name, got in found.items()}


def fourier_error(count: int, dtype: Any) -> dict[str, float]:
    """Largest absolute error of sines and cosines, and largest relative error of the first and second derivative.

    The reference starts with the position in units of the half width, rounded as in the kernel. The error is that of
    everything after that.
    """
    half_width_m, frequencies = 409.6, 16
    rng = np.random.default_rng(count)
    points = rng.uniform(-500, 500, (count, 3)).astype(dtype)
    points[: count // 8] = np.round(points[: count // 8])
    scaled = (points * dtype(1.0 / half_width_m)).astype(np.float64)
    turns = scaled[:, None, :] * 2.0 ** np.arange(frequencies)[:, None]
    angle = np.pi * (turns - 2 * np.round(turns / 2))  # exact up to the last product
    x = torch.tensor(points, requires_grad=True)
    y = kernels.fourier(x, half_width_m, 0, frequencies)
    exact = np.concatenate(
        [np.sin(angle).reshape(count, 3 * frequencies), np.cos(angle).reshape(count, 3 * frequencies)], 1
    )
    g = torch.tensor(rng.normal(size=tuple(y.shape)).astype(dtype))
    (first,) = torch.autograd.grad(y, x, g, create_graph=True)
    v = torch.tensor(rng.normal(size=(count, 3)).astype(dtype))
    (second,) = torch.autograd.grad(first, x, v)
    w = np.pi * 2.0 ** np.arange(frequencies)[:, None] / half_width_m
    sine_g, cosine_g = np.moveaxis(g.double().numpy().reshape(count, 2, frequencies, 3), 1, 0)
    terms = [sine_g * np.cos(angle) * w, -cosine_g * np.sin(angle) * w]
    terms2 = [-sine_g * np.sin(angle) * w**2, -cosine_g * np.cos(angle) * w**2]

    def sums(parts: list[Array], factor: Array | float = 1.0) -> tuple[Array, Array]:
        # The scale has the largest possible value of each term, because a sine near zero has no relative accuracy.
        size = (np.abs(sine_g) + np.abs(cosine_g)) * (w if parts is terms else w**2)
        return sum(parts).sum(1) * factor, size.sum(1) * np.abs(factor)  # type: ignore[union-attr]

    return {
        "y": float(np.abs(y.detach().double().numpy() - exact).max(initial=0.0)),
        "dx": relative_error(first.detach().numpy(), sums(terms)),
        "dx along v": relative_error(second.numpy(), sums(terms2, v.double().numpy())),
    }


def harmonics_error(count: int, dtype: Any) -> float:
    """Largest absolute error of the spherical harmonics of unit vectors. Their largest value is about 1."""
    directions = np.random.default_rng(count).normal(size=(count, 3))
    rounded = (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(dtype)
    got = kernels.spherical_harmonics(torch.from_numpy(rounded)).double().numpy()
    return float(np.abs(got - harmonics(rounded.astype(np.longdouble))).max(initial=0.0))


def harmonics(directions: Array) -> Array:
    """Real spherical harmonics (N, 16) of degree 0 to 3 from their definition with Legendre functions, long double."""
    x, y, z = directions.T
    rho, azimuth = np.hypot(x, y), np.arctan2(y, x)
    legendre = {
        (0, 0): np.ones_like(z), (1, 0): z, (1, 1): rho,
        (2, 0): (2 * z * z - rho * rho) / 2, (2, 1): 3 * z * rho, (2, 2): 3 * rho * rho,
        (3, 0): z * (2 * z * z - 3 * rho * rho) / 2, (3, 1): 1.5 * rho * (4 * z * z - rho * rho),
        (3, 2): 15 * z * rho * rho, (3, 3): 15 * rho**3,
    }  # fmt: skip
    columns = []
    for degree in range(4):
        for order in range(-degree, degree + 1):
            m = abs(order)
            norm = math.sqrt(
                (2 * degree + 1) / (4 * math.pi) * math.factorial(degree - m) / math.factorial(degree + m)
            )
            angle = np.cos(m * azimuth) if order >= 0 else np.sin(m * azimuth)
            columns.append((math.sqrt(2) if m else 1) * norm * legendre[degree, m] * angle)
    return np.stack(columns, 1)


def one_row_error(count: int, dtype: Any, *, same_sign: bool) -> float:
    """Largest relative error of the gradients if all points of a batch are in one cell."""
    table, reference = table_and_reference("one cell", dtype, _core.Encoding.TRI_QUADTREE)
    rng = np.random.default_rng(count)
    points = points_of("one cell", count, dtype)
    points = np.clip(points, dtype(1e-4), dtype(LEAF_M - 1e-4))
    shape = (count, 8 * NUM_LEVELS)
    g = (rng.uniform(0.5, 1.5, shape) if same_sign else rng.normal(size=shape)).astype(dtype)
    located = np.zeros((count, NUM_LEVELS), np.int32)
    table.locate(points, located)
    got = np.zeros((table.num_rows, 8), dtype)
    table.scatter(points, located, None, g, got)
    return relative_error(got, reference.scatter(g, points, None))
