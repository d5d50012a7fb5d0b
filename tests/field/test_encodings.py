# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What each block of numbers of an encoding is, and where features are and are not."""

import numpy as np
import pytest
import torch
from radarsdf._core import CellSet, Encoding
from radarsdf.field import kernels
from radarsdf.field.neural_field import VertexFeatures

LEAF_M = 0.2
ENCODINGS = [Encoding.TRI_QUADTREE, Encoding.OCTREE]


def cube_of_cells(encoding):
    """Features of every leaf cell of a cube."""
    axis = (np.arange(-4, 4) + 0.5) * LEAF_M
    cells = CellSet(LEAF_M)
    cells.insert(np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3).astype(np.float32))
    return VertexFeatures(cells.sorted_keys(), LEAF_M, 3, encoding)


def tensor(values):
    return torch.tensor(np.asarray(values), dtype=torch.float32)


@pytest.mark.parametrize(("encoding", "shape"), list(zip(ENCODINGS, [(100, 24), (100, 8)], strict=True)))
def test_planes_or_levels_are_summed(encoding, shape):
    cells = cube_of_cells(encoding)
    torch.nn.init.ones_(cells.features)
    out = cells(tensor(np.random.default_rng(0).uniform(-0.8, 0.8, (100, 3))))
    assert out.shape == shape
    # Weights add up to one on each of three planes, or on each of three levels.
    np.testing.assert_allclose(out.detach(), 3.0, rtol=1e-6)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_features_are_continuous_across_the_faces_of_occupied_cells(encoding):
    cells = cube_of_cells(encoding)
    torch.nn.init.normal_(cells.features, generator=torch.Generator().manual_seed(0))
    rng = np.random.default_rng(0)
    face = rng.uniform(-0.75, 0.75, (300, 3))
    axis = rng.integers(0, 3, 300)
    face[np.arange(300), axis] = rng.integers(-3, 4, 300) * LEAF_M
    step = 1e-5 * np.eye(3)[axis]
    jump = cells(tensor(face + step)) - cells(tensor(face - step))
    # A slope of a few units of feature a cell is 1e-3 over this step; a wrong neighbour would be of order 1.
    assert jump.abs().max() < 5e-3


def test_fourier_frequencies_are_those_asked_for():
    points = tensor(np.random.default_rng(0).uniform(-3, 3, (50, 3)))
    whole = kernels.fourier(points, 4.0, 0, 6).view(-1, 2, 6, 3)
    part = kernels.fourier(points, 4.0, 2, 3)
    assert torch.equal(part.view(-1, 2, 3, 3), whole[:, :, 2:5])
    # Sines come first and are odd; the slowest wave is two half-widths long.
    assert torch.equal(kernels.fourier(-points, 4.0, 0, 6).view(-1, 2, 6, 3)[:, 0], -whole[:, 0])
    np.testing.assert_allclose(kernels.fourier(points + 8.0, 4.0, 0, 6).view(-1, 2, 6, 3), whole, atol=1e-4)
    assert kernels.fourier(points, 4.0, 0, 0).shape == (50, 0)


def test_spherical_harmonics_are_orthonormal():
    # Gauss-Legendre in z times even steps in azimuth integrate products of degree 3 exactly.
    z, weight = np.polynomial.legendre.leggauss(8)
    azimuth = np.arange(16) * 2 * np.pi / 16
    z, phi = (a.ravel() for a in np.meshgrid(z, azimuth, indexing="ij"))
    weight = np.repeat(weight, 16) * 2 * np.pi / 16
    directions = np.stack([np.sqrt(1 - z**2) * np.cos(phi), np.sqrt(1 - z**2) * np.sin(phi), z], 1)
    values = kernels.spherical_harmonics(torch.from_numpy(directions)).numpy()
    np.testing.assert_allclose(values.T @ (weight[:, None] * values), np.eye(16), atol=1e-12)
