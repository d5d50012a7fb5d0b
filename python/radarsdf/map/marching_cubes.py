"""Marching cubes: triangle meshes of level sets of sampled fields, differentiable for tensors.

A cell is a cube of eight neighbouring samples; corner ``4 * dx + 2 * dy + dz`` has the offset ``(dx, dy, dz)`` from the
lower one. A vertex lies on an edge between two samples a and b of different signs, at (level - a) / (b - a) of its length, so
it depends on no other sample. Triangles have no gradient: they change only where a sample changes sign.
"""

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from radarsdf import core
from radarsdf.arrays import Array, ArrayLike, Bools, Ints32
from radarsdf.checks import check, real_array, refuse_masked


def marching_cubes(
    volume: ArrayLike | Tensor,
    level: float = 0.0,
    *,
    spacing: ArrayLike = (1.0, 1.0, 1.0),
    origin: ArrayLike = (0.0, 0.0, 0.0),
    mask: ArrayLike | None = None,
    num_threads: int = 0,
) -> tuple[Any, Any]:
    """Triangulate the surface on which a volume crosses a level.

    A sample is positive if it is greater than `level`. Triangle normals point to the positive side. The mesh is closed and
    manifold except at the border of the volume or of the mask, and at NaN samples. No triangle has zero area: vertices keep a
    distance of 0.1 % of an edge's length from samples.

    For a tensor, the vertices are once differentiable by the samples; the gradient is zero where a vertex is clamped away from
    a sample, and where a sample is infinite. For a gradient by the level, subtract the level from the samples.

    Parameters
    ----------
    volume : array_like or Tensor, shape (nx, ny, nz)
        Samples. Only the sign of an infinite one matters. Types other than float32 and float64 are converted to the smaller
        of these that represents all values of the type; 64-bit integers are rounded to float64.
    level : float
        Value of the field on the surface.
    spacing : array_like, shape (3,)
        Distance between samples along each axis, positive and finite, in world units.
    origin : array_like, shape (3,)
        Position of sample (0, 0, 0), in world units.
    mask : array_like of bool, shape (nx, ny, nz), optional
        True for valid samples, by default all. A cell is triangulated if its eight samples are valid and none is NaN.
    num_threads : int
        Number of threads. 0: that of OpenMP.

    Returns
    -------
    vertices : ndarray of float64, shape (V, 3)
        Positions in world units: index * `spacing` + `origin`. A Tensor if `volume` is one.
    faces : ndarray of int32, shape (F, 3)
        Rows of `vertices`, counter-clockwise seen from the positive side. A Tensor if `volume` is one.

    Raises
    ------
    TypeError
        If `volume` is not real or `mask` is not boolean.
    ValueError
        If shapes do not match, `spacing`, `origin` or `level` is out of range, or there are too many vertices for int32.

    Examples
    --------
    A sphere of radius 0.5 about the origin:

    >>> import numpy as np
    >>> x, y, z = np.meshgrid(*[np.linspace(-1, 1, 41)] * 3, indexing="ij")
    >>> vertices, faces = marching_cubes(np.sqrt(x**2 + y**2 + z**2), 0.5, spacing=[0.05] * 3, origin=[-1] * 3)
    >>> bool(np.allclose(np.linalg.norm(vertices, axis=1), 0.5, atol=1e-3))
    True

    A gradient by the samples:

    >>> import torch
    >>> points = torch.stack(torch.meshgrid(*[torch.linspace(-1, 1, 21)] * 3, indexing="ij"))
    >>> samples = (points.norm(dim=0) - 0.52).requires_grad_()
    >>> vertices, _ = marching_cubes(samples, spacing=[0.1] * 3, origin=[-1] * 3)
    >>> vertices.norm(dim=1).mean().backward()  # where samples grow, the sphere shrinks
    >>> bool(samples.grad.sum() < 0)
    True
    """
    samples = _as_tensor(volume) if isinstance(volume, Tensor) else _as_samples(volume)
    check(samples.ndim == 3, f"volume must have three axes, not {samples.ndim}")
    shape = tuple(samples.shape)
    usable = None if mask is None else _as_mask(mask, shape)
    iso = real_array(level, "level")
    check(iso.shape == () and np.isfinite(iso), f"level must be a finite number, not {level!r:.50}")
    rest = usable, *_as_placement(spacing, origin, shape), float(iso), num_threads
    if not isinstance(samples, Tensor):
        return core.marching_cubes_dense(samples, *rest)
    if samples.requires_grad and torch.is_grad_enabled():
        return _MarchingCubes.apply(samples, *rest)  # type: ignore[no-untyped-call]
    vertices, faces = core.marching_cubes_dense(samples.detach().numpy(), *rest)
    return torch.from_numpy(vertices), torch.from_numpy(faces)


def sparse_lattice(cells: Array, *, num_threads: int = 0) -> tuple[Ints32, Ints32, Ints32]:
    """Return the sorted unique cells (M', 3) of lower corners (M, 3), their sorted corners (K, 3), and rows of these (M', 8)."""
    return core.sparse_lattice(np.ascontiguousarray(cells, np.int32), num_threads)


class _MarchingCubes(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, samples: Tensor, *placement: Any) -> tuple[Tensor, Tensor]:
        found = core.marching_cubes_dense_with_edges(samples.detach().numpy(), *placement)
        vertices, faces, edges = map(torch.from_numpy, found)
        _mask, spacing, _origin, level, num_threads = placement
        ctx.save_for_backward(samples, edges)
        ctx.placement = spacing, level, num_threads
        ctx.mark_non_differentiable(faces)
        ctx.set_materialize_grads(False)  # or zeros would be allocated for the faces' gradient
        return vertices, faces

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, vertices_grad: Tensor | None, _: Tensor | None) -> tuple[Tensor | None, ...]:
        if vertices_grad is None:
            return (None,) * 6
        samples, edges = (saved.detach().numpy() for saved in ctx.saved_tensors)
        spacing, level, num_threads = ctx.placement
        # The core fills it. NumPy requests huge pages, PyTorch does not.
        grad = np.empty(samples.shape, samples.dtype)
        upstream = vertices_grad.contiguous().numpy()
        core.marching_cubes_dense_backward(samples, edges, upstream, spacing, level, grad, num_threads)
        return torch.from_numpy(grad), *(None,) * 5


def _as_tensor(volume: Tensor) -> Tensor:
    """Convert `volume` to C order, as float32 or float64 by the rule for arrays."""
    kind = volume.dtype
    check(not kind.is_complex, f"volume must be real numbers, not {kind}", TypeError)
    small = kind.is_floating_point or kind.itemsize <= 2  # bytes: float32 holds all integers of these
    return volume.to(torch.float32 if small and kind != torch.float64 else torch.float64).contiguous()


def _as_samples(volume: ArrayLike) -> Array:
    """Convert `volume` to C order, as float32 if that represents every value of the type, else float64."""
    refuse_masked(volume, "volume")
    array = np.asarray(volume)
    if array.dtype.kind in "biuf" and np.can_cast(array.dtype, np.float32, "safe"):
        return np.ascontiguousarray(array, np.float32)
    return np.ascontiguousarray(real_array(array, "volume"))


def _as_mask(mask: ArrayLike, shape: tuple[int, ...]) -> Bools:
    refuse_masked(mask, "mask")
    array = np.asarray(mask)
    wanted, is_bool = f"boolean and have the shape of volume, {shape}", array.dtype == np.bool_
    wrong = f"mask must be {wanted}, not {array.dtype} {array.shape}"
    check(is_bool and array.shape == shape, wrong, ValueError if is_bool else TypeError)
    return np.ascontiguousarray(array)


def _as_placement(
    spacing: ArrayLike, origin: ArrayLike, extent: tuple[float, ...]
) -> tuple[list[float], list[float]]:
    step, start = real_array(spacing, "spacing"), real_array(origin, "origin")
    for name, values, fits in (("spacing", step, step > 0), ("origin", start, start < np.inf)):
        three = values.shape == (3,) and (fits & np.isfinite(values)).all()
        check(three, f"{name} must be three finite numbers, positive for spacing, not {values}")
    with np.errstate(over="ignore"):
        within = np.isfinite(np.abs(start) + step * extent).all()
    check(within, f"the lattice with spacing {spacing!r} ends beyond float64")
    return step.tolist(), start.tolist()
