# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Gradients of a mesh's vertices by the samples."""

from __future__ import annotations

import gc
import itertools
import warnings

import numpy as np
import pytest
import torch
from radarsdf import _core
from radarsdf.map.marching_cubes import extract_cells, marching_cubes, sparse_lattice

from ..mesh_checks import cells_in_use, noise, sphere

PLACEMENT = {"spacing": (0.5, 2.0, 0.1), "origin": (-3.0, 1e3, 0.25)}
FUNCTIONS = ("dense", "sparse")


def off_the_level(seed, shape=(4, 5, 6)):
    """Samples of either sign, between 0.2 and 1 from 0, so that all vertices are far from the samples."""
    rng = np.random.default_rng(seed)
    return rng.uniform(0.2, 1, shape) * rng.choice([-1.0, 1.0], shape)


def mesh_of(function, samples, mask=None, **placement):
    """Vertices and faces of a volume, by either function: the second takes the cells in use alone."""
    if function == "dense":
        return marching_cubes(samples, mask=mask, **placement)
    numbers = samples.detach().numpy() if isinstance(samples, torch.Tensor) else samples
    _, corners, cells = sparse_lattice(np.argwhere(cells_in_use(numbers, mask)))
    return extract_cells(corners, samples[tuple(corners.T)], cells, **placement)


def gradient(function, volume, weights=None, dtype=None, **keywords):
    """Of a weighted sum over all coordinates of the vertices, by the volume."""
    samples = torch.tensor(volume, dtype=dtype, requires_grad=True)
    vertices, _ = mesh_of(function, samples, **keywords)
    if weights is None:
        weights = torch.from_numpy(np.random.default_rng(5).normal(size=vertices.shape))
    (vertices * weights).sum().backward()
    return samples.grad.numpy()


def check_gradient(function, volume, **keywords):
    """Compare with differences: each vertex coordinate by each sample. Return the number of vertices."""
    samples = torch.tensor(volume, dtype=torch.float64, requires_grad=True)
    keywords = {**PLACEMENT, "num_threads": 1, **keywords}
    assert torch.autograd.gradcheck(
        lambda samples: mesh_of(function, samples, **keywords)[0], samples, eps=1e-6, atol=1e-5, rtol=1e-5
    )
    vertices, _ = mesh_of(function, samples, **keywords)
    return len(vertices)


@pytest.mark.parametrize("function", FUNCTIONS)
@pytest.mark.parametrize("seed", [0, 1])
def test_gradients_are_those_of_differences(function, seed):
    assert check_gradient(function, off_the_level(seed)) > 100
    assert check_gradient(function, off_the_level(seed) + 0.3, level=0.3) > 100


@pytest.mark.parametrize("function", FUNCTIONS)
def test_gradients_under_a_mask_and_beside_nan(function):
    volume = off_the_level(2)
    mask = np.ones(volume.shape, bool)
    mask[1, 2, 3] = mask[3, 4, 0] = False
    volume[2, 1, 5] = np.nan
    assert 30 < check_gradient(function, volume, mask=mask) < len(marching_cubes(off_the_level(2))[0])
    grad = gradient(function, volume, mask=mask)
    used = np.zeros(volume.shape, bool)
    for at in np.argwhere(cells_in_use(volume, mask)):
        used[tuple(slice(low, low + 2) for low in at)] = True
    assert (grad[~used] == 0).all()
    assert not used.all()
    assert (grad[used] != 0).sum() > 50


@pytest.mark.parametrize("function", FUNCTIONS)
def test_vertices_kept_away_from_samples_have_no_gradient(function):
    volume = off_the_level(3)
    near = np.random.default_rng(3).random(volume.shape) < 0.5
    near &= np.indices(volume.shape).sum(axis=0) % 2 == 0  # none beside another
    volume[near] *= 1e-4  # closer to the level than a vertex comes, further than the differences' step
    assert check_gradient(function, volume) > 100
    samples = torch.tensor(volume, requires_grad=True)
    vertices, _ = mesh_of(function, samples)
    kept = torch.isclose((vertices - vertices.round()).abs().amax(1), torch.tensor(1e-3).double(), atol=1e-12)
    assert 20 < kept.sum() < len(vertices)
    (grad,) = torch.autograd.grad(
        vertices[kept].sum() + np.inf * vertices[kept].sum(), samples, retain_graph=True
    )
    assert (grad == 0).all()
    (grad,) = torch.autograd.grad(vertices[~kept].sum(), samples)
    assert (grad.numpy()[near] == 0).all()
    assert (grad != 0).sum() > 30


@pytest.mark.parametrize("function", FUNCTIONS)
def test_vertices_beside_infinite_samples_have_no_gradient(function):
    volume = off_the_level(4)
    rng = np.random.default_rng(4)
    infinite = rng.random(volume.shape) < 0.3
    volume[infinite] *= np.inf
    samples = torch.tensor(volume, requires_grad=True)
    vertices, _ = mesh_of(function, samples)
    # Beside one infinite sample a vertex is kept away from the other, between two it stays in the middle.
    vertices.sum().backward()
    grad = samples.grad.numpy()
    assert (grad[infinite] == 0).all()
    assert np.isfinite(grad).all()
    assert (grad[~infinite] != 0).sum() > 20
    # Not even an infinite gradient of the vertices reaches them, which times 0 would be NaN.
    vertices, _ = mesh_of(function, samples)
    (grad_of_inf,) = torch.autograd.grad(vertices, samples, torch.full_like(vertices, torch.inf))
    assert (grad_of_inf.numpy()[infinite] == 0).all()
    # As if the infinite ones were so large that their derivative is nothing.
    large = gradient(function, np.where(infinite, np.sign(volume) * 1e300, volume), torch.ones(()))
    np.testing.assert_allclose(grad, large, rtol=1e-12, atol=1e-290)


@pytest.mark.parametrize("function", FUNCTIONS)
def test_extreme_samples_have_finite_gradients(function):
    volume = np.where(sphere(9) > 0, 1.7e308, -1.7e308)
    assert (
        gradient(function, volume) == 0
    ).all()  # their differences overflow, the vertices are kept at one end
    # Differences so small that their inverse overflows. A gradient of zero stays zero.
    small = torch.tensor(np.where(sphere(9) > 0, 1e-320, -1e-320), requires_grad=True)
    vertices, _ = mesh_of(function, small)
    (0 * vertices).sum().backward()
    assert (small.grad == 0).all()


@pytest.mark.parametrize("function", FUNCTIONS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_planes_vertices_follow_its_offset(function, dtype):
    """Of n . x - d, a vertex on an edge along axis a moves by 1 / n[a] as d grows: n[a] * dx[a] = dd."""
    normal = np.array([0.48, 0.6, 0.64])
    shape, spacing = (7, 8, 9), np.array([0.5, 0.25, 0.125])
    points = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), -1) * spacing
    volume = torch.from_numpy(points @ normal).to(dtype)
    offset = torch.tensor(1.2345, dtype=dtype, requires_grad=True)
    vertices, _ = mesh_of(function, volume - offset, spacing=spacing)
    along = (
        np.abs(vertices.detach().numpy() / spacing % 1 - 0.5) < 0.498
    )  # the edge's axis, no lattice coordinate
    free = along.sum(axis=1) == 1
    assert free.sum() > 100
    axes = along.argmax(axis=1)
    for vertex, axis in itertools.islice(zip(vertices[free], axes[free], strict=True), 0, None, 7):
        (found,) = torch.autograd.grad(vertex[int(axis)], offset, retain_graph=True)
        assert float(found) == pytest.approx(1 / normal[axis], rel=1e-4 if dtype == torch.float32 else 1e-9)
        # The way along the normal is the offset's own.
        (found,) = torch.autograd.grad((vertex * torch.from_numpy(normal)).sum(), offset, retain_graph=True)
        assert float(found) == pytest.approx(1, rel=1e-4 if dtype == torch.float32 else 1e-9)


@pytest.mark.parametrize("function", FUNCTIONS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_threads_do_not_change_a_bit(function, dtype):
    volume = noise(6, (40, 33, 47))
    volume[3, 4, 5] = np.nan
    volume[::7, ::5, ::3] *= 1e-4
    samples = torch.tensor(volume, dtype=dtype)
    if function == "sparse":
        _, corners, cells = sparse_lattice(np.argwhere(cells_in_use(volume)))
        assert len(corners) > 3 * (1 << 14)  # several blocks
        samples = samples[tuple(corners.T)].clone()
    found = set()
    for threads in (1, 2, 3, 7, 1, 7):
        leaf = samples.clone().requires_grad_()
        vertices, _ = (
            marching_cubes(leaf, num_threads=threads)
            if function == "dense"
            else extract_cells(corners, leaf, cells, num_threads=threads)
        )
        (vertices * torch.from_numpy(np.random.default_rng(7).normal(size=vertices.shape))).sum().backward()
        assert (leaf.grad != 0).sum() > 10_000
        found.add(leaf.grad.numpy().tobytes())
    assert len(found) == 1


@pytest.mark.parametrize("function", FUNCTIONS)
def test_float32_samples_have_the_gradient_of_their_values(function):
    volume = noise(8, (12, 13, 14))
    volume[np.abs(volume) < 0.05] = 0.5
    found = gradient(function, volume)
    expected = gradient(function, volume.astype(np.float64))
    assert found.dtype == np.float32
    assert expected.dtype == np.float64
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5 * np.abs(expected).max())


def test_dense_and_sparse_have_the_same_gradient():
    volume = noise(9, (12, 13, 40), np.float64)
    mask = noise(10, volume.shape) > -2
    weights = torch.tensor([1.0, -2.0, 3.0], dtype=torch.float64)  # whatever the vertices' order
    dense, sparse = (gradient(function, volume, weights, mask=mask) for function in FUNCTIONS)
    np.testing.assert_allclose(dense, sparse, rtol=1e-12, atol=1e-12 * np.abs(dense).max())
    assert np.abs(dense).max() > 1


@pytest.mark.parametrize("order", [[0, 1, 2], [2, 1, 0], None])
def test_corners_may_come_in_any_order(order):
    volume = off_the_level(11)
    _, corners, cells = sparse_lattice(np.argwhere(cells_in_use(volume)))
    rows = np.lexsort(corners.T[order]) if order else np.random.default_rng(0).permutation(len(corners))
    place = np.argsort(rows).astype(np.int32)
    weights = torch.tensor([1.0, -2.0, 3.0], dtype=torch.float64)
    leaf = torch.tensor(volume, requires_grad=True)
    vertices, _ = extract_cells(corners[rows], leaf[tuple(corners[rows].T)], place[cells], **PLACEMENT)
    (vertices * weights).sum().backward()
    np.testing.assert_allclose(leaf.grad, gradient("sparse", volume, weights, **PLACEMENT), rtol=1e-12)


@pytest.mark.parametrize("function", FUNCTIONS)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_arrays_give_arrays_with_the_tensors_bits(function, dtype):
    volume = noise(12, (20, 21, 40), dtype)
    volume[1, 2, 3], volume[4, 5, 6] = np.nan, np.inf
    mask = noise(13, volume.shape) > -2
    arrays = mesh_of(function, volume, mask, level=0.1, **PLACEMENT)
    for requires_grad in (False, True):
        samples = torch.tensor(volume, requires_grad=requires_grad)
        tensors = mesh_of(function, samples, mask, level=0.1, **PLACEMENT)
        for array, tensor in zip(arrays, tensors, strict=True):
            assert type(array) is np.ndarray
            assert type(tensor) is torch.Tensor
            assert array.tobytes() == tensor.detach().numpy().tobytes()
        vertices, faces = tensors
        assert vertices.dtype == torch.float64
        assert faces.dtype == torch.int32
        assert vertices.requires_grad == requires_grad
        assert not faces.requires_grad
    with torch.no_grad():
        assert not mesh_of(function, samples, mask)[0].requires_grad


def test_edges_are_stored_only_for_a_gradient(monkeypatch):
    def fail(*_):
        raise AssertionError

    monkeypatch.setattr(_core, "marching_cubes_dense_with_edges", fail)
    monkeypatch.setattr(_core, "marching_cubes_sparse_with_edges", fail)
    samples = torch.tensor(sphere(9), requires_grad=True)
    for function in FUNCTIONS:
        mesh_of(function, samples.detach())
        with torch.no_grad():
            mesh_of(function, samples)
        with pytest.raises(AssertionError):
            mesh_of(function, samples)


@pytest.mark.parametrize(
    ("dtype", "kept"),
    [(torch.float16, torch.float32), (torch.bfloat16, torch.float32), (torch.float32, torch.float32)],
)
def test_small_floats_have_a_gradient_of_their_own_type(dtype, kept):
    volume = torch.tensor(off_the_level(14)).to(dtype)
    leaf = volume.clone().requires_grad_()
    marching_cubes(leaf)[0].sum().backward()
    assert leaf.grad.dtype == dtype
    wide = volume.to(kept).requires_grad_()
    marching_cubes(wide)[0].sum().backward()
    assert torch.equal(leaf.grad, wide.grad.to(dtype))
    assert (leaf.grad != 0).sum() > 50


@pytest.mark.parametrize(
    ("dtype", "kept"),
    [
        (torch.int8, np.float32),
        (torch.uint16, np.float32),
        (torch.bool, np.float32),
        (torch.int32, np.float64),
        (torch.int64, np.float64),
    ],
)
def test_whole_numbers_are_taken_as_in_arrays(dtype, kept):
    volume = np.random.default_rng(15).integers(0, 2, (6, 7, 8))
    vertices, faces = marching_cubes(torch.tensor(volume).to(dtype), 0.25)
    expected = marching_cubes(volume.astype(kept), 0.25)
    assert np.array_equal(vertices, expected[0])
    assert np.array_equal(faces, expected[1])
    assert len(faces) > 100


def test_views_of_other_layouts():
    volume = off_the_level(16, (6, 7, 8))
    expected = gradient("dense", volume)
    weights = torch.from_numpy(np.random.default_rng(5).normal(size=marching_cubes(volume)[0].shape))
    for view, back in (
        (torch.tensor(volume.transpose(2, 0, 1).copy()), lambda t: t.permute(1, 2, 0)),
        (torch.tensor(np.repeat(volume, 2, axis=2)), lambda t: t[:, :, ::2]),
        (torch.tensor(volume[::-1].copy()), lambda t: t.flip(0)),
    ):
        leaf = view.requires_grad_()
        vertices, _ = marching_cubes(back(leaf))
        (vertices * weights).sum().backward()
        np.testing.assert_array_equal(back(leaf.grad), expected)
    # Nor need the vertices' gradient be in C order.
    leaf = torch.tensor(volume, requires_grad=True)
    vertices, _ = marching_cubes(leaf)
    vertices.backward(weights.T.contiguous().T)
    np.testing.assert_array_equal(leaf.grad, expected)


@pytest.mark.parametrize("shape", [(0, 0, 0), (1, 4, 4), (4, 4, 1), (3, 3, 3)])
def test_empty_meshes_have_a_gradient_of_zero(shape):
    leaf = torch.ones(shape, requires_grad=True)
    vertices, faces = marching_cubes(leaf)
    assert vertices.shape == faces.shape == (0, 3)
    vertices.sum().backward()
    assert leaf.grad.shape == shape
    assert (leaf.grad == 0).all()
    values = torch.ones(0, requires_grad=True)
    extract_cells(np.zeros((0, 3), np.int32), values, np.zeros((0, 8), np.int32))[0].sum().backward()
    assert values.grad.shape == (0,)


@pytest.mark.parametrize("function", FUNCTIONS)
def test_a_change_of_the_samples_before_the_gradient_is_noticed(function):
    volume = sphere(9)
    _, corners, cells = sparse_lattice(np.argwhere(cells_in_use(volume)))
    samples = torch.tensor(volume, requires_grad=True) * 1
    if function == "dense":
        vertices, _ = marching_cubes(samples)
    else:
        samples = samples[tuple(corners.T)]
        vertices, _ = extract_cells(corners, samples, cells)
    samples += 1
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        vertices.sum().backward()


@pytest.mark.parametrize("function", FUNCTIONS)
def test_second_derivatives_are_refused(function):
    samples = torch.tensor(sphere(9), requires_grad=True)
    vertices, _ = mesh_of(function, samples)
    (grad,) = torch.autograd.grad(vertices.square().sum(), samples, create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        grad.sum().backward()


def test_what_has_no_gradient_is_refused():
    samples = torch.tensor(sphere(9))
    needed = torch.tensor(1.0, requires_grad=True)
    for keywords in ({"level": needed}, {"spacing": needed.expand(3)}, {"origin": needed.expand(3)}):
        with pytest.raises(TypeError, match="grad"):
            marching_cubes(samples, **keywords)
    with pytest.raises(TypeError, match="real"):
        marching_cubes(samples.to(torch.complex64))
    with pytest.raises(ValueError, match="three axes"):
        marching_cubes(samples[0])
    with pytest.raises(ValueError, match=r"mask.*\(9, 9, 9\)"):
        marching_cubes(samples, mask=np.ones((9, 9, 8), bool))
    with pytest.raises(ValueError, match="level"):
        marching_cubes(samples, np.nan)
    with pytest.raises(ValueError, match="values must have shape"):
        extract_cells(np.zeros((1, 3), np.int32), samples, np.zeros((0, 8), np.int32))


def test_masks_and_placements_may_be_tensors():
    volume = noise(17)
    mask = noise(18) > -2
    expected = marching_cubes(volume, 0.1, mask=mask, **PLACEMENT)
    placement = {name: torch.tensor(value, dtype=torch.float64) for name, value in PLACEMENT.items()}
    found = marching_cubes(
        torch.tensor(volume), torch.tensor(0.1, dtype=torch.float64), mask=torch.tensor(mask), **placement
    )
    for array, tensor in zip(expected, found, strict=True):
        assert np.array_equal(array, tensor)


def test_meshes_own_their_memory():
    samples = torch.tensor(sphere(20), requires_grad=True)
    vertices, faces = marching_cubes(samples)
    copies = vertices.detach().clone(), faces.clone()
    (grad,) = torch.autograd.grad(vertices.sum(), samples)
    grad_copy = grad.clone()
    del samples
    vertices = vertices.detach()
    gc.collect()
    for _ in range(5):
        marching_cubes(noise(19))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        grad += 0.0  # writable
    assert torch.equal(vertices, copies[0])
    assert torch.equal(faces, copies[1])
    assert torch.equal(grad, grad_copy)


def test_the_core_refuses_edges_of_other_samples():
    volume = sphere(9)
    vertices, _, edges = _core.marching_cubes_dense_with_edges(volume, None, [1] * 3, [0] * 3, 0.0)
    rest = [1] * 3, 0.0, np.zeros_like(volume)
    for wrong in (edges + 3 * 9**3, edges - 3 * 9**3, edges[::-1].copy(), np.full_like(edges, 3 * 9**3 - 1)):
        with pytest.raises(ValueError, match="edges"):
            _core.marching_cubes_dense_backward(volume, wrong, vertices, *rest)
    with pytest.raises(ValueError, match="edges"):
        _core.marching_cubes_dense_backward(volume, edges[1:], vertices, *rest)
    with pytest.raises(ValueError, match="vertices_grad"):
        _core.marching_cubes_dense_backward(volume, edges, vertices[:, :2].copy(), *rest)
    _, corners, cells = sparse_lattice(np.argwhere(cells_in_use(volume)))
    values = volume[tuple(corners.T)]
    vertices, _, edges, uppers = _core.marching_cubes_sparse_with_edges(
        corners, values, cells, [1] * 3, [0] * 3, 0.0
    )
    for wrong_edges, wrong_uppers in (
        (edges + 3 * 9**3, uppers),
        (edges - 3 * 9**3, uppers),
        (edges[::-1].copy(), uppers),
        (edges, uppers + 9**3),
        (edges, -uppers - 1),
        (edges, np.full_like(uppers, 5)),  # an edge along each axis can end there, not more
        (edges, uppers[1:]),
    ):
        with pytest.raises(ValueError, match="edges"):
            _core.marching_cubes_sparse_backward(
                values, wrong_edges, wrong_uppers, vertices, [1] * 3, 0.0, values
            )
