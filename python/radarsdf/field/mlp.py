# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Multi-layer perceptrons as an autograd function over the compiled core."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from radarsdf import _core
from radarsdf.field.kernels import rows_view, threads, view


def mlp(inputs: Sequence[Tensor], layers: Sequence[tuple[Tensor, Tensor]]) -> Tensor:
    """Linear layers with ReLU between them.

    The core takes a few rows at a time through all layers. PyTorch, which takes all rows through one layer
    after the other, needs 1.5 times as long. It also makes a dozen calls, each of which waits for the
    interpreter's lock, so two threads would train hardly faster than one.

    Parameters
    ----------
    inputs : sequence of Tensor
        (N, width) each. Side by side they are the input of the first layer.
    layers : sequence of (weight, bias)
        (outputs, inputs) and (outputs,) of each layer, like those of ``torch.nn.Linear``.

    Returns
    -------
    Tensor
        (N, outputs of the last layer). It can be differentiated any number of times. The bits of a row do not
        depend on the other rows. Gradients have the same bits with any number of threads.
    """
    return _MLP.apply(len(layers), *(t for layer in layers for t in layer), *inputs)  # type: ignore[no-any-return, no-untyped-call]


class _MLP(torch.autograd.Function):
    # `tensors` are weight and bias of each layer, then the inputs.
    @staticmethod
    def forward(ctx: Any, num_layers: int, *tensors: Tensor) -> Tensor:
        inputs = tensors[2 * num_layers :]
        out = inputs[0].new_empty((inputs[0].shape[0], tensors[2 * num_layers - 1].shape[0]))
        keep = any(ctx.needs_input_grad)
        views = _views(num_layers, tensors)
        ctx.hidden = _core.mlp(*views, out.numpy(), keep, threads())
        ctx.views = views
        ctx.save_for_backward(*tensors)
        ctx.num_layers = num_layers
        return out

    @staticmethod
    def backward(ctx: Any, out_grad: Tensor) -> tuple[Tensor | None, ...]:
        tensors: tuple[Tensor, ...] = ctx.saved_tensors
        wanted: tuple[bool, ...] = ctx.needs_input_grad[1:]
        if torch.is_grad_enabled():  # the gradient may be differentiated again, which the core cannot do
            chosen = [t for t, w in zip(tensors, wanted, strict=True) if w]
            found = iter(
                torch.autograd.grad(_plain(ctx.num_layers, tensors), chosen, out_grad, create_graph=True)
            )
            return None, *(next(found) if w else None for w in wanted)
        split = 2 * ctx.num_layers
        by_layers = any(wanted[:split])  # the core computes all of them: that takes little longer than one
        grads = [
            torch.empty_like(t, memory_format=torch.contiguous_format)
            if w or (by_layers and i < split)
            else None
            for i, (t, w) in enumerate(zip(tensors, wanted, strict=True))
        ]
        views: list[Any] = [None if g is None else g.numpy() for g in grads]
        given: tuple[list[Any], list[Any], list[Any]] = ctx.views
        _core.mlp_backward(
            *given,
            ctx.hidden,
            rows_view(out_grad),
            views[:split:2] if by_layers else None,
            views[1:split:2] if by_layers else None,
            views[split:],
            threads(),
        )
        return None, *(g if w else None for g, w in zip(grads, wanted, strict=True))


def _views(num_layers: int, tensors: Sequence[Tensor]) -> tuple[list[Any], list[Any], list[Any]]:
    """Inputs, weights and biases as the core takes them."""
    layers, inputs = tensors[: 2 * num_layers], tensors[2 * num_layers :]
    return [rows_view(x) for x in inputs], [view(w) for w in layers[::2]], [view(b) for b in layers[1::2]]


def _plain(num_layers: int, tensors: Sequence[Tensor]) -> Tensor:
    """The same network in PyTorch operations, which autograd can differentiate any number of times."""
    x = torch.cat(list(tensors[2 * num_layers :]), 1)
    for i in range(num_layers):
        x = functional.linear(x if i == 0 else torch.relu(x), tensors[2 * i], tensors[2 * i + 1])
    return x
