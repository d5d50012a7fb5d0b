"""Gradients of mesh vertices by the samples."""

import numpy as np
import pytest
import torch
from radarsdf import marching_cubes

from ..mesh_checks import cells_in_use, noise

PLACEMENT = {"spacing": (0.5, 2.0, 0.1), "origin": (-3.0, 1e3, 0.25)}


def off_the_level(seed, shape=(4, 5, 6)):
    """Samples of either sign, between 0.2 and 1 from 0, so that all vertices are far from the samples."""
    rng = np.random.default_rng(seed)
    return rng.uniform(0.2, 1, shape) * rng.choice([-1.0, 1.0], shape)


def gradient(volume, weights=None, dtype=None, **keywords):
    """Gradient by the volume of a weighted sum of all vertex coordinates."""
    samples = torch.tensor(volume, dtype=dtype, requires_grad=True)
    vertices, _ = marching_cubes(samples, **keywords)
    if weights is None:
        weights = torch.from_numpy(np.random.default_rng(5).normal(size=vertices.shape))
    (vertices * weights).sum().backward()
    return samples.grad.numpy()


def check_gradient(volume, **keywords):
    """Compare with differences: each vertex coordinate by each sample. Return the number of vertices."""
    samples = torch.tensor(volume, dtype=torch.float64, requires_grad=True)
    keywords = {**PLACEMENT, "num_threads": 1, **keywords}
    assert torch.autograd.gradcheck(
        lambda samples: marching_cubes(samples, **keywords)[0], samples, eps=1e-6, atol=1e-5, rtol=1e-5
    )
    return len(marching_cubes(samples, **keywords)[0])


def test_gradients_equal_finite_differences():
    assert check_gradient(off_the_level(0)) > 100
    assert check_gradient(off_the_level(1) + 0.3, level=0.3) > 100


def test_gradients_of_float32_equal_those_of_float64():
    volume = off_the_level(7)
    np.testing.assert_allclose(gradient(volume, dtype=torch.float32), gradient(volume), rtol=1e-4, atol=1e-4)


def test_gradients_under_a_mask_and_next_to_nan():
    volume = off_the_level(2)
    mask = np.ones(volume.shape, bool)
    mask[1, 2, 3] = mask[3, 4, 0] = False
    volume[2, 1, 5] = np.nan
    assert 30 < check_gradient(volume, mask=mask) < len(marching_cubes(off_the_level(2))[0])
    grad = gradient(volume, mask=mask)
    used = np.zeros(volume.shape, bool)
    for at in np.argwhere(cells_in_use(volume, mask)):
        used[tuple(slice(low, low + 2) for low in at)] = True
    assert (grad[~used] == 0).all()
    assert not used.all()
    assert (grad[used] != 0).sum() > 50


def test_vertices_kept_away_from_samples_have_no_gradient():
    volume = off_the_level(3)
    near = np.random.default_rng(3).random(volume.shape) < 0.5
    near &= np.indices(volume.shape).sum(axis=0) % 2 == 0  # none next to another
    volume[near] *= 1e-4  # closer to the level than vertices come, farther than the step of differences
    assert check_gradient(volume) > 100
    samples = torch.tensor(volume, requires_grad=True)
    vertices, _ = marching_cubes(samples)
    kept = torch.isclose((vertices - vertices.round()).abs().amax(1), torch.tensor(1e-3).double(), atol=1e-12)
    assert 20 < kept.sum() < len(vertices)
    infinite = vertices[kept].sum() + np.inf * vertices[kept].sum()
    (grad,) = torch.autograd.grad(infinite, samples, retain_graph=True)
    assert (grad == 0).all()
    (grad,) = torch.autograd.grad(vertices[~kept].sum(), samples)
    assert (grad.numpy()[near] == 0).all()
    assert (grad != 0).sum() > 30


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_threads_do_not_change_a_bit(dtype):
    volume = noise(6, (40, 33, 47))
    volume[3, 4, 5] = np.nan
    volume[::7, ::5, ::3] *= 1e-4
    found = {gradient(volume, dtype=dtype, num_threads=threads).tobytes() for threads in (1, 2, 7, 7)}
    assert len(found) == 1


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_arrays_give_arrays_with_the_tensors_bits(dtype):
    volume = noise(12, (20, 21, 40), dtype)
    volume[1, 2, 3], volume[4, 5, 6] = np.nan, np.inf
    mask = noise(13, volume.shape) > -2
    arrays = marching_cubes(volume, mask=mask, level=0.1, **PLACEMENT)
    for requires_grad in (False, True):
        samples = torch.tensor(volume, requires_grad=requires_grad)
        tensors = marching_cubes(samples, mask=mask, level=0.1, **PLACEMENT)
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
        assert not marching_cubes(samples, mask=mask)[0].requires_grad
