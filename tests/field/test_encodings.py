# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The encodings as modules: what each block of numbers is, and where features are and are not."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from radarsdf._core import CellSet
from radarsdf.field import kernels
from radarsdf.field.encodings import Fourier, Octree, SphericalHarmonics, TriQuadtree

LEAF_M = 0.2


def leaf_keys(points):
    cells = CellSet(LEAF_M)
    cells.insert(np.ascontiguousarray(points, np.float32))
    return cells.sorted_keys()


def block_of_cells(low=-4, high=4):
    """Every leaf cell of a cube, by its centre."""
    axis = (np.arange(low, high) + 0.5) * LEAF_M
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)


def tensor(values):
    return torch.tensor(np.asarray(values), dtype=torch.float32)


def test_planes_are_summed_and_levels_concatenated():
    encoding = TriQuadtree(leaf_keys(block_of_cells()), LEAF_M, 3)
    torch.nn.init.ones_(encoding.features)
    out = encoding(tensor(np.random.default_rng(0).uniform(-0.8, 0.8, (100, 3))))
    assert out.shape == (100, 24)
    # Weights add up to one on each of three planes.
    np.testing.assert_allclose(out.detach(), 3.0, rtol=1e-6)


def test_levels_of_the_octree_are_summed():
    encoding = Octree(leaf_keys(block_of_cells()), LEAF_M, 4)
    torch.nn.init.ones_(encoding.features)
    out = encoding(tensor(np.random.default_rng(0).uniform(-0.8, 0.8, (100, 3))))
    assert out.shape == (100, 8)
    np.testing.assert_allclose(out.detach(), 4.0, rtol=1e-6)


def test_a_level_counts_where_its_own_cell_is_occupied():
    encoding = TriQuadtree(leaf_keys([[0.1, 0.1, 0.1]]), LEAF_M, 3)
    torch.nn.init.ones_(encoding.features)
    # In the leaf; beside it but in its parent; in its grandparent only; outside of all, in the leaf's column.
    points = tensor([[0.1, 0.1, 0.1], [0.3, 0.1, 0.1], [0.7, 0.1, 0.1], [0.1, 0.1, 0.9]])
    blocks = encoding(points).detach().view(4, 3, 8)
    assert torch.equal((blocks != 0).all(2).int(), torch.tensor([[1, 1, 1], [0, 1, 1], [0, 0, 1], [0, 0, 0]]))
    assert ((blocks == 0) | (blocks != 0).all(2, keepdim=True)).all()
    assert encoding.occupied(points).tolist() == [True, False, False, False]


@pytest.mark.parametrize("encoding_class", [TriQuadtree, Octree])
def test_features_are_continuous_across_the_faces_of_occupied_cells(encoding_class):
    encoding = encoding_class(leaf_keys(block_of_cells()), LEAF_M, 3)
    torch.nn.init.normal_(encoding.features, generator=torch.Generator().manual_seed(0))
    rng = np.random.default_rng(0)
    face = rng.uniform(-0.75, 0.75, (300, 3))
    axis = rng.integers(0, 3, 300)
    face[np.arange(300), axis] = rng.integers(-3, 4, 300) * LEAF_M
    step = 1e-5 * np.eye(3)[axis]
    jump = encoding(tensor(face + step)) - encoding(tensor(face - step))
    # A slope of a few units of feature a cell is 1e-3 over this step; a wrong neighbour would be of order 1.
    assert jump.abs().max() < 5e-3


def test_occupied_is_the_cell_of_the_point():
    rng = np.random.default_rng(0)
    inserted, queries = rng.uniform(-2, 2, (500, 3)), rng.uniform(-2.5, 2.5, (3000, 3))
    inserted, queries = inserted.astype(np.float32), queries.astype(np.float32)
    encoding = TriQuadtree(leaf_keys(inserted), LEAF_M, 2)
    inverse = np.float32(1 / LEAF_M)
    cells = {tuple(c) for c in np.floor(inserted * inverse).astype(int).tolist()}
    expected = [tuple(c) in cells for c in np.floor(queries * inverse).astype(int).tolist()]
    assert encoding.occupied(torch.from_numpy(queries)).tolist() == expected
    assert 0 < sum(expected) < len(expected)


def test_features_start_normal_and_are_the_only_parameters():
    encoding = TriQuadtree(leaf_keys(block_of_cells(-10, 10)), LEAF_M, 3)
    encoding.initialise(torch.Generator().manual_seed(0))
    assert [name for name, _ in encoding.named_parameters()] == ["features"]
    assert list(encoding.state_dict()) == ["features"]
    # Vertices of 20, 10 and 6 cells (-10 … 9 in fours: -3 … 2) a side, on each of three planes.
    assert encoding.features.shape == (3 * (21**2 + 11**2 + 7**2), 8)
    assert encoding.features.std().item() == pytest.approx(0.05, rel=0.03)
    assert abs(encoding.features.mean().item()) < 0.002


def test_each_plane_sees_its_own_two_coordinates():
    encoding = TriQuadtree(leaf_keys(block_of_cells()), LEAF_M, 1)
    torch.nn.init.normal_(encoding.features, generator=torch.Generator().manual_seed(0))
    rows = encoding.features.shape[0] // 3  # of a cube, each plane has as many
    point = torch.tensor([[0.11, -0.23, 0.37]])
    for plane, axes in enumerate([(0, 1), (0, 2), (1, 2)]):
        only = torch.zeros_like(encoding.features)
        only[plane * rows : (plane + 1) * rows] = encoding.features.detach()[
            plane * rows : (plane + 1) * rows
        ]
        with torch.no_grad():
            whole, encoding.features.data = encoding.features.data, only
            for axis in range(3):
                moved = point.clone()
                moved[0, axis] += 0.05
                assert torch.equal(encoding(moved), encoding(point)) == (axis not in axes)
            encoding.features.data = whole


def test_fourier_frequencies_are_those_asked_for():
    points = tensor(np.random.default_rng(0).uniform(-3, 3, (50, 3)))
    whole = Fourier(4.0, 6)(points).view(-1, 2, 6, 3)
    assert torch.equal(Fourier(4.0, 3)(points).view(-1, 2, 3, 3), whole[:, :, :3])
    part = kernels.fourier(points, 4.0, 2, 3)
    assert torch.equal(part.view(-1, 2, 3, 3), whole[:, :, 2:5])
    # Sines come first and are odd; the slowest wave is two half-widths long.
    assert torch.equal(Fourier(4.0, 6)(-points).view(-1, 2, 6, 3)[:, 0], -whole[:, 0])
    np.testing.assert_allclose(Fourier(4.0, 6)(points + 8.0).view(-1, 2, 6, 3), whole, atol=1e-4)
    assert Fourier(4.0, 0)(points).shape == (50, 0)


def test_spherical_harmonics_are_orthonormal():
    # Gauss-Legendre in z times even steps in azimuth integrate products of degree 3 exactly.
    z, weight = np.polynomial.legendre.leggauss(8)
    azimuth = np.arange(16) * 2 * np.pi / 16
    z, phi = (a.ravel() for a in np.meshgrid(z, azimuth, indexing="ij"))
    weight = np.repeat(weight, 16) * 2 * np.pi / 16
    directions = np.stack([np.sqrt(1 - z**2) * np.cos(phi), np.sqrt(1 - z**2) * np.sin(phi), z], 1)
    values = SphericalHarmonics()(torch.from_numpy(directions)).numpy()
    np.testing.assert_allclose(values.T @ (weight[:, None] * values), np.eye(16), atol=1e-12)
