"""Autograd functions over the compiled core: interpolation in cells, Fourier encoding, multi-layer perceptrons.

They are :class:`torch.autograd.Function`, not ``torch.library`` operators. Measured at 16, 1024 and 8192
points, forward and backward of an operator take 10 to 17 µs more (at 16 points 40 to 47 instead of 30 µs).
An operator could also get the vertex table only through a global registry.

The core gets tensors as NumPy views of the same memory. Results are bit-identical with any number of threads.
"""

import functools
import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch import get_num_threads as threads
from torch.autograd.function import once_differentiable
from torch.nn import functional

from radarsdf import core
from radarsdf.core import FEATURE_DIM, NUM_SPHERICAL_HARMONICS, VertexTable

_CACHE_LINE = 64  # bytes
_Views = list[np.ndarray[Any, Any]]


def view(tensor: Tensor) -> np.ndarray[Any, Any]:
    """Return a NumPy view in C order, as the core expects. A tensor in another order is copied."""
    return tensor.detach().contiguous().numpy()


def rows_view(tensor: Tensor) -> np.ndarray[Any, Any]:
    """Return a view like :func:`view`, without copying a block of columns of a larger matrix."""
    tensor = tensor.detach()
    return (tensor if tensor.stride(1) == 1 and tensor.stride(0) > 0 else tensor.contiguous()).numpy()


def layer_views(parameters: Iterable[Tensor]) -> tuple[_Views, _Views]:
    """Return views of the weights and of the biases of linear layers, from both of each layer in turn."""
    views = [view(parameter) for parameter in parameters]
    return views[::2], views[1::2]


def large_zeros(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
    """Return zeros in huge memory pages, for random access."""
    # NumPy requests huge pages from 4 MB on. In PyTorch's small ones, a step of Adam on a million rows takes 1.5 times as long.
    like = torch.empty(0, dtype=dtype, device="cpu").numpy()
    numbers = np.zeros(math.prod(shape) + _CACHE_LINE, like.dtype)
    first = -numbers.ctypes.data % _CACHE_LINE // numbers.itemsize  # or a row would span two lines
    return torch.from_numpy(numbers[first : first + math.prod(shape)].reshape(shape))


class _Weights(NamedTuple):
    """Weights W of the features F at points x (N, 3), or with directions v (N, 3) their derivatives dW/dx · v.

    The core computes y = W F (interpolate), Wᵀ g (scatter) and d(y · g)/dx (coordinate_gradient). The derivatives of these have
    the same form, so they suffice for second derivatives.
    """

    table: VertexTable
    points: Tensor
    located: Tensor  # of the points, see :func:`locate`
    directions: Tensor | None = None

    @property
    def _places(self) -> tuple[Any, Any, Any]:
        directions = None if self.directions is None else view(self.directions)
        return view(self.points), self.located.numpy(), directions

    def interpolate(self, features: Tensor) -> Tensor:
        out = self.points.new_empty((self.points.shape[0], FEATURE_DIM * self.table.num_levels))
        self.table.interpolate(view(features), *self._places, out.numpy(), threads())
        return out

    def scatter(self, out_grad: Tensor) -> Tensor:
        features_grad = self.points.new_zeros((self.table.num_rows, FEATURE_DIM))
        self.table.scatter(*self._places, rows_view(out_grad), features_grad.numpy(), threads())
        return features_grad

    def coordinate_gradient(self, features: Tensor, out_grad: Tensor) -> Tensor:
        points_grad = torch.empty_like(self.points, memory_format=torch.contiguous_format)
        arrays = *self._places, rows_view(out_grad), points_grad.numpy()
        self.table.coordinate_gradient(view(features), *arrays, threads())
        return points_grad


class _Interpolate(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, features: Tensor, points: Tensor, table: VertexTable) -> Tensor:
        located = torch.empty((points.shape[0], table.num_levels), dtype=torch.int32, device="cpu")
        out = points.new_empty((points.shape[0], FEATURE_DIM * table.num_levels))
        table.encode(view(features), view(points), located.numpy(), out.numpy(), threads())
        ctx.save_for_backward(features, points, located)
        ctx.table = table
        return out

    @staticmethod
    def backward(ctx: Any, out_grad: Tensor) -> tuple[Tensor | None, Tensor | None, None]:
        features, points, located = ctx.saved_tensors
        wanted = ctx.needs_input_grad[:2]
        found = _InterpolateBackward.apply(out_grad, features, points, located, ctx.table, *wanted)  # type: ignore[no-untyped-call]
        return *found, None


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
        ctx.set_materialize_grads(False)  # unused gradients are None, not zeros to interpolate
        weights = _Weights(table, points, located)
        return (
            weights.scatter(out_grad) if needs_features else None,
            weights.coordinate_gradient(features, out_grad) if needs_points else None,
        )

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, a: Tensor | None, v: Tensor | None) -> tuple[Tensor | None, ...]:
        # The scalar differentiated here is  a . W(x)^T g  +  v . d(W(x) F . g)/dx.
        g, features, points, located = ctx.saved_tensors
        here = _Weights(ctx.table, points, located)
        along = here._replace(directions=v)
        needs_g, needs_features, needs_points = ctx.needs_input_grad[:3]
        of_each = ([] if a is None else [(here, a)]) + ([] if v is None else [(along, features)])
        g_grad = features_grad = points_grad = None
        if needs_g and of_each:
            g_grad = functools.reduce(torch.add, (weights.interpolate(f) for weights, f in of_each))
        if needs_features and v is not None:
            features_grad = along.scatter(g)
        if needs_points and of_each:
            terms = (weights.coordinate_gradient(f, g) for weights, f in of_each)
            points_grad = functools.reduce(torch.add, terms)
        return g_grad, features_grad, points_grad, None, None, None, None


class _Fourier(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, points: Tensor, half_width_m: float, first: int, count: int) -> Tensor:
        out = points.new_empty((points.shape[0], 6 * count))
        core.fourier(view(points), half_width_m, first, count, out.numpy(), threads())
        ctx.save_for_backward(out)
        ctx.frequencies = (half_width_m, first, count)
        return out

    @staticmethod
    def backward(ctx: Any, out_grad: Tensor) -> tuple[Tensor, None, None, None]:
        # PyTorch operations on the saved output, so that autograd can differentiate them again.
        (out,) = ctx.saved_tensors
        half_width_m, first, count = ctx.frequencies
        wave_numbers = [math.pi * 2**k / half_width_m for k in range(first, first + count)]
        scale = torch.tensor(wave_numbers, dtype=out.dtype, device="cpu")
        sine, cosine = out.view(-1, 2, count, 3).unbind(1)
        sine_grad, cosine_grad = out_grad.reshape(-1, 2, count, 3).unbind(1)
        return ((sine_grad * cosine - cosine_grad * sine) * scale[:, None]).sum(1), None, None, None


def interpolate(features: Tensor, points: Tensor, table: VertexTable) -> Tensor:
    """Interpolate features: bilinearly in each plane of a tri-quadtree, then summed (3QFP); trilinearly in an octree.

    From features (table.num_rows, 8), float32 or float64, at points (N, 3) of the same type, local frame, m, to
    (N, 8 · num_levels), finest level first. Zero at levels at which the point is in no occupied cell. Twice
    differentiable by features and points; the gradient by points is the one inside their cell.
    """
    return _Interpolate.apply(features, points, table)  # type: ignore[no-untyped-call]


def locate(points: Tensor, table: VertexTable) -> Tensor:
    """Return the rows (N, num_levels) int32, finest level first, of the occupied cells of points (N, 3), local, m; -1: none."""
    located = torch.empty((points.shape[0], table.num_levels), dtype=torch.int32, device="cpu")
    table.locate(view(points), located.numpy(), threads())
    return located


def fourier(points: Tensor, half_width_m: float, first_frequency: int, num_frequencies: int) -> Tensor:
    """Return sines, then cosines, of 2^k·π·points / half_width_m for k from `first_frequency` on: (N, 6 · num_frequencies)."""
    return _Fourier.apply(points, half_width_m, first_frequency, num_frequencies)  # type: ignore[no-untyped-call]


def spherical_harmonics(directions: Tensor) -> Tensor:
    """Return real spherical harmonics (N, 16) of degree 0 to 3 of unit vectors (N, 3). Not differentiable."""
    out = directions.new_empty((directions.shape[0], NUM_SPHERICAL_HARMONICS))
    core.spherical_harmonics(view(directions), out.numpy(), threads())
    return out


def mlp(inputs: Sequence[Tensor], layers: Sequence[tuple[Tensor, Tensor]]) -> Tensor:
    """Apply linear layers with ReLU between them, arbitrarily often differentiable: (N, outputs of the last layer).

    `inputs`: (N, width) each, concatenated to the input of the first layer. `layers`: weights (outputs, inputs) and biases
    (outputs,), like those of ``torch.nn.Linear``. The bits of a row do not depend on the other rows.
    """
    # The core processes a few rows at a time through all layers. PyTorch, layer by layer, takes 1.5 times as long, and
    # acquires the GIL in a dozen calls, so that two threads would train hardly faster than one.
    return _MLP.apply(len(layers), *(t for layer in layers for t in layer), *inputs)  # type: ignore[no-untyped-call]


class _MLP(torch.autograd.Function):
    # `tensors`: weight and bias of each layer, then the inputs.
    @staticmethod
    def forward(ctx: Any, num_layers: int, *tensors: Tensor) -> Tensor:
        layers, inputs = tensors[: 2 * num_layers], tensors[2 * num_layers :]
        out = inputs[0].new_empty((inputs[0].shape[0], layers[-1].shape[0]))
        keep = any(ctx.needs_input_grad)
        ctx.views = views = [rows_view(x) for x in inputs], *layer_views(layers)
        ctx.hidden = core.mlp(*views, out.numpy(), keep, threads())
        ctx.save_for_backward(*tensors)
        ctx.num_layers = num_layers
        return out

    @staticmethod
    def backward(ctx: Any, out_grad: Tensor) -> tuple[Tensor | None, ...]:
        tensors: tuple[Tensor, ...] = ctx.saved_tensors
        wanted: tuple[bool, ...] = ctx.needs_input_grad[1:]
        split = 2 * ctx.num_layers
        if torch.is_grad_enabled():  # the gradient may be differentiated again, which the core cannot do
            out = torch.cat(tensors[split:], 1)
            for i in range(0, split, 2):
                out = functional.linear(out if i == 0 else torch.relu(out), tensors[i], tensors[i + 1])
            chosen = [t for t, w in zip(tensors, wanted, strict=True) if w]
            found = iter(torch.autograd.grad(out, chosen, out_grad, create_graph=True))
            return None, *(next(found) if w else None for w in wanted)
        by_layers = any(wanted[:split])  # the core computes all layers, hardly slower than one
        computed = [w or (by_layers and i < split) for i, w in enumerate(wanted)]
        grads = [
            torch.empty_like(t, memory_format=torch.contiguous_format) if c else None
            for t, c in zip(tensors, computed, strict=True)
        ]
        views: list[Any] = [None if g is None else g.numpy() for g in grads]
        by_weights, by_biases = (views[:split:2], views[1:split:2]) if by_layers else (None, None)
        given: tuple[_Views, _Views, _Views] = ctx.views
        core.mlp_backward(
            *given, ctx.hidden, rows_view(out_grad), by_weights, by_biases, views[split:], threads()
        )
        return None, *(g if w else None for g, w in zip(grads, wanted, strict=True))
