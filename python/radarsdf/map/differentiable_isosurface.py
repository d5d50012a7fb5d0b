# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Marching cubes on tensors, as autograd functions over the compiled core.

A vertex lies on an edge between two samples a and b of different signs, at (level - a) / (b - a) of the way.
It moves along this edge when a or b changes, and depends on no other sample. Triangles have no gradient: they
change only where a sample changes its sign.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from radarsdf import _core

_SMALL_INTEGERS = 2  # bytes: float32 holds all of them
_Gradients = tuple[Tensor | None, ...]


def as_samples(values: Tensor, name: str) -> Tensor:
    """`values` in C order as float32 or float64, whichever the array functions would take for this type."""
    kind = values.dtype
    if kind.is_complex:
        msg = f"{name} must be real numbers, not {kind}"
        raise TypeError(msg)
    small = kind.is_floating_point or kind.itemsize <= _SMALL_INTEGERS
    return values.to(torch.float32 if small and kind != torch.float64 else torch.float64).contiguous()


def volume_mesh(
    volume: Tensor,
    mask: NDArray[np.bool_] | None,
    spacing: Sequence[float],
    origin: Sequence[float],
    level: float,
    num_threads: int,
) -> tuple[Tensor, Tensor]:
    """Vertices and faces of a volume, of arguments that `marching_cubes` has checked."""
    if volume.requires_grad and torch.is_grad_enabled():
        mesh: tuple[Tensor, Tensor] = _OfVolume.apply(  # type: ignore[no-untyped-call]
            volume, mask, spacing, origin, level, num_threads
        )
        return mesh
    return _tensors(
        *_core.marching_cubes_dense(volume.detach().numpy(), mask, spacing, origin, level, num_threads)
    )


def cells_mesh(
    corners: NDArray[np.int32],
    values: Tensor,
    cells: NDArray[np.int32],
    spacing: Sequence[float],
    origin: Sequence[float],
    level: float,
    num_threads: int,
) -> tuple[Tensor, Tensor]:
    """Vertices and faces of some cells, of arguments that `extract_cells` has checked."""
    if values.requires_grad and torch.is_grad_enabled():
        mesh: tuple[Tensor, Tensor] = _OfCells.apply(  # type: ignore[no-untyped-call]
            values, corners, cells, spacing, origin, level, num_threads
        )
        return mesh
    return _tensors(
        *_core.marching_cubes_sparse(
            corners, values.detach().numpy(), cells, spacing, origin, level, num_threads
        )
    )


def _tensors(vertices: NDArray[np.float64], faces: NDArray[np.int32]) -> tuple[Tensor, Tensor]:
    return torch.from_numpy(vertices), torch.from_numpy(faces)


class _OfVolume(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        volume: Tensor,
        mask: NDArray[np.bool_] | None,
        spacing: Sequence[float],
        origin: Sequence[float],
        level: float,
        num_threads: int,
    ) -> tuple[Tensor, Tensor]:
        vertices, faces, edges = _core.marching_cubes_dense_with_edges(
            volume.detach().numpy(), mask, spacing, origin, level, num_threads
        )
        ctx.save_for_backward(volume, torch.from_numpy(edges))
        ctx.rest = spacing, level, num_threads
        return _mark(ctx, *_tensors(vertices, faces))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, vertices_grad: Tensor | None, _: Tensor | None) -> _Gradients:
        if vertices_grad is None:
            return (None,) * 6
        volume, edges = (saved.detach().numpy() for saved in ctx.saved_tensors)
        spacing, level, num_threads = ctx.rest
        grad = _unset_like(volume)
        _core.marching_cubes_dense_backward(
            volume, edges, vertices_grad.contiguous().numpy(), spacing, level, grad, num_threads
        )
        return torch.from_numpy(grad), *(None,) * 5


class _OfCells(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        values: Tensor,
        corners: NDArray[np.int32],
        cells: NDArray[np.int32],
        spacing: Sequence[float],
        origin: Sequence[float],
        level: float,
        num_threads: int,
    ) -> tuple[Tensor, Tensor]:
        vertices, faces, *edges = _core.marching_cubes_sparse_with_edges(
            corners, values.detach().numpy(), cells, spacing, origin, level, num_threads
        )
        ctx.save_for_backward(values, *(torch.from_numpy(array) for array in edges))
        ctx.rest = spacing, level, num_threads
        return _mark(ctx, *_tensors(vertices, faces))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, vertices_grad: Tensor | None, _: Tensor | None) -> _Gradients:
        if vertices_grad is None:
            return (None,) * 7
        values, edges, uppers = (saved.detach().numpy() for saved in ctx.saved_tensors)
        spacing, level, num_threads = ctx.rest
        grad = _unset_like(values)
        _core.marching_cubes_sparse_backward(
            values, edges, uppers, vertices_grad.contiguous().numpy(), spacing, level, grad, num_threads
        )
        return torch.from_numpy(grad), *(None,) * 6


def _unset_like(samples: NDArray[Any]) -> NDArray[Any]:
    # The core fills it. NumPy asks for huge pages, as PyTorch does not.
    return np.empty(samples.shape, samples.dtype)


def _mark(ctx: Any, vertices: Tensor, faces: Tensor) -> tuple[Tensor, Tensor]:
    ctx.mark_non_differentiable(faces)
    ctx.set_materialize_grads(False)  # or the faces' gradient would be zeros of their size
    return vertices, faces
