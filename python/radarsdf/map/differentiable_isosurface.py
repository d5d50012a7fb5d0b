# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Marching cubes on tensors, as autograd functions over the compiled core.

A vertex lies on an edge between two samples a and b of different signs, at (level - a) / (b - a) of the way.
It moves along this edge when a or b changes, and depends on no other sample. Triangles have no gradient: they
change only where a sample changes its sign.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from radarsdf import _core

_SMALL_INTEGERS = 2  # bytes: float32 holds all of them


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
    rest = mask, spacing, origin, level, num_threads
    return _mesh(
        volume,
        lambda samples: _core.marching_cubes_dense(samples, *rest),
        lambda samples: _core.marching_cubes_dense_with_edges(samples, *rest),
        lambda volume, edges, grad, into: _core.marching_cubes_dense_backward(
            volume, edges, grad, spacing, level, into, num_threads
        ),
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
    rest = cells, spacing, origin, level, num_threads
    return _mesh(
        values,
        lambda samples: _core.marching_cubes_sparse(corners, samples, *rest),
        lambda samples: _core.marching_cubes_sparse_with_edges(corners, samples, *rest),
        lambda values, edges, uppers, grad, into: _core.marching_cubes_sparse_backward(
            values, edges, uppers, grad, spacing, level, into, num_threads
        ),
    )


def _mesh(
    samples: Tensor,
    plain: Callable[[NDArray[Any]], tuple[NDArray[Any], ...]],
    with_edges: Callable[[NDArray[Any]], tuple[NDArray[Any], ...]],
    pull_back: Callable[..., None],
) -> tuple[Tensor, Tensor]:
    """Vertices and faces by one of two calls of the core, and their gradient by the third, which keeps what it names alone."""
    if samples.requires_grad and torch.is_grad_enabled():
        mesh: tuple[Tensor, Tensor] = _OfSamples.apply(samples, with_edges, pull_back)  # type: ignore[no-untyped-call]
        return mesh
    vertices, faces = plain(samples.detach().numpy())
    return torch.from_numpy(vertices), torch.from_numpy(faces)


class _OfSamples(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        samples: Tensor,
        with_edges: Callable[[NDArray[Any]], tuple[NDArray[Any], ...]],
        pull_back: Callable[..., None],
    ) -> tuple[Tensor, Tensor]:
        vertices, faces, *edges = map(torch.from_numpy, with_edges(samples.detach().numpy()))
        ctx.save_for_backward(samples, *edges)
        ctx.pull_back = pull_back
        ctx.mark_non_differentiable(faces)
        ctx.set_materialize_grads(False)  # or the faces' gradient would be zeros of their size
        return vertices, faces

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, vertices_grad: Tensor | None, _: Tensor | None
    ) -> tuple[Tensor | None, None, None]:
        if vertices_grad is None:
            return None, None, None
        samples, *edges = (saved.detach().numpy() for saved in ctx.saved_tensors)
        # The core fills it. NumPy asks for huge pages, as PyTorch does not.
        grad = np.empty(samples.shape, samples.dtype)
        ctx.pull_back(samples, *edges, vertices_grad.contiguous().numpy(), grad)
        return torch.from_numpy(grad), None, None
