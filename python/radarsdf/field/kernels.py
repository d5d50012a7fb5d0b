# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Autograd functions over the compiled core.

Each is a :class:`torch.autograd.Function` rather than a ``torch.library`` operator: measured at 16, 1024 and 8192
points, forward and backward through an operator cost 10 to 17 µs more a call (30 against 40 to 47 µs at 16 points),
and an operator could not take the vertex table as an argument without a global registry of handles.

Tensors cross to the core as NumPy views of the same memory. Results are the same bits for any number of threads.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from radarsdf._core import FEATURE_DIM, NUM_SPHERICAL_HARMONICS, TaskQueue, VertexTable
from radarsdf._core import fourier as _fourier
from radarsdf._core import spherical_harmonics as _spherical_harmonics

_CACHE_LINE = 64  # bytes


@dataclass(frozen=True)
class AdamMemory:
    """What :func:`adam_step` keeps between steps, for every row."""

    moments: Tensor
    """(num_rows, 16): mean and mean square of each row's gradients."""
    marks: Tensor
    """(num_rows, 2) int32: the step in which a row last moved, or 0, and a 0 that only means something within a step."""


def view(tensor: Tensor) -> np.ndarray[Any, Any]:
    """What the core takes: a NumPy view in C order."""
    return tensor.detach().contiguous().numpy()


def rows_view(tensor: Tensor) -> np.ndarray[Any, Any]:
    """Like :func:`view`, but leaves a block of columns of a larger matrix where it is."""
    tensor = tensor.detach()
    return (tensor if tensor.stride(1) == 1 and tensor.stride(0) > 0 else tensor.contiguous()).numpy()


def large_zeros(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
    """Zeros for what is then read and written all over.

    NumPy asks for huge pages (from 4 MB on), PyTorch does not: with small ones, a step of Adam on a map of a million rows
    takes half as long again.
    """
    like = torch.empty(0, dtype=dtype, device="cpu").numpy()
    numbers = np.zeros(math.prod(shape) + _CACHE_LINE, like.dtype)
    first = -numbers.ctypes.data % _CACHE_LINE // numbers.itemsize  # or rows would lie across two lines
    return torch.from_numpy(numbers[first : first + math.prod(shape)].reshape(shape))


def threads() -> int:
    """How many the core is to use: as many as PyTorch would."""
    return torch.get_num_threads()


def _interpolate(
    table: VertexTable, features: Tensor, points: Tensor, located: Tensor, directions: Tensor | None
) -> Tensor:
    out = points.new_empty((points.shape[0], FEATURE_DIM * table.num_levels))
    table.interpolate(
        view(features),
        view(points),
        located.numpy(),
        None if directions is None else view(directions),
        out.numpy(),
        threads(),
    )
    return out


def scatter(
    table: VertexTable, points: Tensor, located: Tensor, directions: Tensor | None, out_grad: Tensor
) -> Tensor:
    """Gradient (num_rows, 8) by the features, of (interpolated . out_grad); along `directions`, of its derivative."""
    features_grad = points.new_zeros((table.num_rows, FEATURE_DIM))
    table.scatter(
        view(points),
        located.numpy(),
        None if directions is None else view(directions),
        rows_view(out_grad),
        features_grad.numpy(),
        threads(),
    )
    return features_grad


def _coordinate_gradient(
    table: VertexTable,
    features: Tensor,
    points: Tensor,
    located: Tensor,
    directions: Tensor | None,
    out_grad: Tensor,
) -> Tensor:
    points_grad = torch.empty_like(points, memory_format=torch.contiguous_format)
    table.coordinate_gradient(
        view(features),
        view(points),
        located.numpy(),
        None if directions is None else view(directions),
        rows_view(out_grad),
        points_grad.numpy(),
        threads(),
    )
    return points_grad


# With y = W(x) F (interpolate), the core's other two sums are W(x)^T g (scatter) and d(y . g)/dx (coordinate_gradient).
# Given a direction v in place of nothing, W becomes dW/dx . v in all three, and that closes them under differentiation.
class _Interpolate(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, features: Tensor, points: Tensor, table: VertexTable) -> Tensor:
        out, located = encode(features, points, table)
        ctx.save_for_backward(features, points, located)
        ctx.table = table
        return out

    @staticmethod
    def backward(ctx: Any, out_grad: Tensor) -> tuple[Tensor | None, Tensor | None, None]:
        features, points, located = ctx.saved_tensors
        return (
            *_InterpolateBackward.apply(  # type: ignore[no-untyped-call]
                out_grad,
                features,
                points,
                located,
                ctx.table,
                ctx.needs_input_grad[0],
                ctx.needs_input_grad[1],
            ),
            None,
        )


class _InterpolateBackward(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        out_grad: Tensor,
        features: Tensor,
        points: Tensor,
        located: Tensor,
        table: VertexTable,
        needs_features: bool,
        needs_points: bool,
    ) -> tuple[Tensor | None, Tensor | None]:
        ctx.save_for_backward(out_grad, features, points, located)
        ctx.table = table
        ctx.set_materialize_grads(
            False
        )  # an unused gradient is None, not a matrix of zeros to be interpolated
        return (
            scatter(table, points, located, None, out_grad) if needs_features else None,
            _coordinate_gradient(table, features, points, located, None, out_grad) if needs_points else None,
        )

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, a: Tensor | None, v: Tensor | None) -> tuple[Tensor | None, ...]:
        # The scalar differentiated here is  a . W(x)^T g  +  v . d(W(x) F . g)/dx.
        g, features, points, located = ctx.saved_tensors
        table = ctx.table
        needs_g, needs_features, needs_points = ctx.needs_input_grad[:3]

        def total(*terms: Tensor | None) -> Tensor | None:
            present = [term for term in terms if term is not None]
            return sum(present[1:], present[0]) if present else None

        g_grad = features_grad = points_grad = None
        if needs_g:
            g_grad = total(
                None if a is None else _interpolate(table, a, points, located, None),
                None if v is None else _interpolate(table, features, points, located, v),
            )
        if needs_features and v is not None:
            features_grad = scatter(table, points, located, v, g)
        if needs_points:
            points_grad = total(
                None if a is None else _coordinate_gradient(table, a, points, located, None, g),
                None if v is None else _coordinate_gradient(table, features, points, located, v, g),
            )
        return g_grad, features_grad, points_grad, None, None, None, None


class _Fourier(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, points: Tensor, half_width_m: float, first: int, count: int) -> Tensor:
        out = points.new_empty((points.shape[0], 6 * count))
        _fourier(view(points), half_width_m, first, count, out.numpy(), threads())
        ctx.save_for_backward(out)
        ctx.frequencies = (half_width_m, first, count)
        return out

    @staticmethod
    def backward(ctx: Any, out_grad: Tensor) -> tuple[Tensor, None, None, None]:
        # Differentiable torch operations on the saved output, so that autograd can differentiate them again.
        (out,) = ctx.saved_tensors
        half_width_m, first, count = ctx.frequencies
        scale = torch.tensor(
            [math.pi * 2**k / half_width_m for k in range(first, first + count)], dtype=out.dtype
        )
        sine, cosine = out.view(-1, 2, count, 3).unbind(1)
        sine_grad, cosine_grad = out_grad.reshape(-1, 2, count, 3).unbind(1)
        return ((sine_grad * cosine - cosine_grad * sine) * scale[:, None]).sum(1), None, None, None


def interpolate(features: Tensor, points: Tensor, table: VertexTable) -> Tensor:
    """Features at points, bilinear on each plane of each level (method: tri-quadtree encoding of 3QFP).

    Parameters
    ----------
    features : Tensor
        (table.num_rows, 8), float32 or float64.
    points : Tensor
        (N, 3), the dtype of `features`, local frame, m.
    table : VertexTable
        Which rows belong to which cell.

    Returns
    -------
    Tensor
        (N, 8 · num_levels), finest level first; zero at the levels where the point's cell is not occupied.
        Differentiable twice, by features and points. The gradient by points is that inside the cell.
    """
    return _Interpolate.apply(features, points, table)  # type: ignore[no-any-return, no-untyped-call]


def encode(features: Tensor, points: Tensor, table: VertexTable) -> tuple[Tensor, Tensor]:
    """:func:`interpolate` without a gradient, and the cells (N, num_levels) int32 of :func:`locate`."""
    located = torch.empty((points.shape[0], table.num_levels), dtype=torch.int32)
    out = points.new_empty((points.shape[0], FEATURE_DIM * table.num_levels))
    table.encode(view(features), view(points), located.numpy(), out.numpy(), threads())
    return out, located


def adam_step(
    table: VertexTable,
    batches: Sequence[tuple[Tensor, Tensor, Tensor]],
    features: Tensor,
    memory: AdamMemory,
    decays: Tensor,
    *,
    step: int,
    learning_rate: float,
    epsilon: float,
) -> Callable[[], None]:
    """One step of Adam on the rows that batches touch, in place; the others stay as they are.

    Parameters
    ----------
    table : VertexTable
        Of the features.
    batches : sequence of (points, located, gradient)
        (N, 3), (N, num_levels) int32 and (N, 8 · num_levels): where, and the loss's gradient by the interpolated features.
    features : Tensor
        (num_rows, 8).
    memory : AdamMemory
        What the step remembers of earlier ones.
    decays : Tensor
        (more than `step`, 2): both betas to the powers 0, 1, …
    step : int
        Number of this step, from 1 on.
    learning_rate, epsilon : float
        Adam's.

    Returns
    -------
    callable
        That does what of the step no other call of it has begun: threads share it by all calling it.
    """
    return functools.partial(
        table.adam_step,
        [(view(points), located.numpy(), rows_view(grad)) for points, located, grad in batches],
        view(features),
        memory.moments.numpy(),
        memory.marks.numpy(),
        decays.numpy(),
        step,
        learning_rate,
        epsilon,
        TaskQueue(),
    )


def locate(points: Tensor, table: VertexTable) -> Tensor:
    """Occupied cell that holds each point (N, 3), local frame, m: (N, num_levels) int32, finest first, -1 where none."""
    located = torch.empty((points.shape[0], table.num_levels), dtype=torch.int32)
    table.locate(view(points), located.numpy(), threads())
    return located


def fourier(points: Tensor, half_width_m: float, first_frequency: int, num_frequencies: int) -> Tensor:
    """Sines, then cosines, of 2^k·π·points / half_width_m for k = first_frequency, …: (N, 6 · num_frequencies)."""
    return _Fourier.apply(points, half_width_m, first_frequency, num_frequencies)  # type: ignore[no-any-return, no-untyped-call]


def spherical_harmonics(directions: Tensor) -> Tensor:
    """Real spherical harmonics of degree 0 to 3 of unit vectors (N, 3): (N, 16). Directions are data: no gradient."""
    if directions.requires_grad:
        msg = "spherical_harmonics has no gradient by the directions"
        raise NotImplementedError(msg)
    out = directions.new_empty((directions.shape[0], NUM_SPHERICAL_HARMONICS))
    _spherical_harmonics(view(directions), out.numpy(), threads())
    return out
