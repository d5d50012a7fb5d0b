"""Steps of the training: losses and gradients of a batch, by the compiled core or PyTorch's autograd, and optimisers.

:class:`AutogradGradients` is the reference: PyTorch differentiates the losses of this module. Only it supports
normals, which are gradients themselves. :class:`CoreGradients` calls the core once a batch and takes a third to half of
the time. Tests check that the two agree up to rounding.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import compress
from typing import Any, Literal, TypeVar

import numpy as np
import torch
from torch import Generator, Tensor
from torch.nn import functional

from radarsdf import core
from radarsdf.arrays import Array, Ints32
from radarsdf.checks import check
from radarsdf.config.fit_config import FitConfig
from radarsdf.field import kernels
from radarsdf.field.field import NeuralField, VertexFeatures, cells_width, fourier_width
from radarsdf.fitting.sampling import Batch, Dropout
from radarsdf.threads import ThreadPool

# Dropout of the features and of the Fourier encoding before the intensity network, times `Schedule.dropout_scale`.
FEATURE_DROPOUT, FOURIER_DROPOUT = 0.85, 0.25
# Samples in a part. Smaller parts balance better among threads and fit the cache, but each prepares the networks again:
# for a joint batch of 4096 samples, 4, 8 and 16 parts took 1.02, 1.07 and 1.16 times as long as two.
_PART = 512
_MOST_PARTS = 64  # each stores gradients of the networks
_Result = TypeVar("_Result")

Losses = Literal["sdf", "joint", "intensity"]
"""Losses to train: "sdf" for features and SDF network, "joint" for all parameters, "intensity" for its network alone."""


def sdf_loss(logit: Tensor, sdf_m: Tensor, sigma_m: float) -> Tensor:
    """Compute the binary cross-entropy of sigmoid(logit) against sigmoid(sdf / sigma), (B,) each (SHINE-Mapping).

    The sigmoid gives errors near the surface the most weight.
    """
    return functional.binary_cross_entropy_with_logits(logit, torch.sigmoid(sdf_m / sigma_m))


def intensity_loss(predicted: Tensor, label: Tensor) -> Tensor:
    """Compute the mean absolute error of scaled intensities (B,), robust to outliers (3QFPI); 0 where the label is NaN."""
    return functional.l1_loss(predicted, torch.where(label.isnan(), predicted.detach(), label))


@dataclass(frozen=True)
class Touched:
    """Samples of a batch, which touch the features of their cells, and the gradients of their interpolated features."""

    points: Array  # (N, 3) samples, local frame, m
    located: Ints32  # (N, num_levels) rows of the cells that contain them
    gradient: Array  # (N, 8 · num_levels) gradient of the interpolated features


@dataclass(frozen=True)
class Gradients:
    """Losses and gradients of a batch. The next batch overwrites the arrays."""

    losses: dict[str, float]  # "sdf", "intensity"
    by_parameters: list[Tensor]  # all features (without `touched`), SDF network, intensity network
    touched: Touched | None  # gradient of the touched features, if only these move


class GradientBackend(ABC):
    """Losses and gradients of batches.

    The parameters of `field` must keep their memory. Gradients of a batch's parts are summed in order, so results do not
    depend on the threads of `pool`.
    """

    def __init__(
        self, field: NeuralField, config: FitConfig, dropout: float, generator: Generator, pool: ThreadPool
    ) -> None:
        self._field, self._config, self._pool = field, config, pool
        self._dropout_scale, self._generator = dropout, generator

    @abstractmethod
    def num_parts(self, batch_size: int) -> int:
        """Return the best number of parts for a batch size."""

    @abstractmethod
    def of(self, losses: Losses, batch: Batch, meanwhile: Callable[[], _Result]) -> tuple[Gradients, _Result]:
        """Return gradients of `losses`, and the result of `meanwhile`, which the calling thread runs while others work."""

    def _draw_dropouts(self) -> list[tuple[int, Dropout]]:
        """Draw the dropout of each part of the encoding, with its width, for the intensity network alone."""
        if not self._config.networks.dropout or self._dropout_scale == 0:
            return []
        scale, generator = self._dropout_scale, self._generator
        widths = (cells_width(self._config), fourier_width(self._config))
        parts = zip(widths, (FEATURE_DROPOUT, FOURIER_DROPOUT), strict=True)
        return [(width, Dropout.draw(scale * share, generator)) for width, share in parts if width]


class CoreGradients(GradientBackend):
    def __init__(self, field: NeuralField, config: FitConfig, *others: Any) -> None:
        super().__init__(field, config, *others)
        network, networks = field.intensity_network, config.networks
        self._loss = core.FieldLoss(
            table=field.cells.table,
            features=kernels.view(field.cells.features),
            frequencies=(field.half_width_m, field.num_frequencies),
            sdf=kernels.layer_views(field.sdf_network.parameters()),
            intensity=None if network is None else kernels.layer_views(network.parameters()),
            sees=(networks.view_direction, networks.log_range),
            sigma_m=field.sigma_m,
            intensity_in_free_space=config.training.intensity_in_free_space,
        )
        self._located = np.zeros((0, field.cells.table.num_levels), np.int32)
        self._interpolated_grad = np.zeros((0, field.cells.interpolated_dim), np.float32)
        self._by_sdf = [torch.from_numpy(gradient) for gradient in self._loss.sdf_gradients]
        self._by_intensity = [torch.from_numpy(gradient) for gradient in self._loss.intensity_gradients]

    def num_parts(self, batch_size: int) -> int:
        return min(max(batch_size // _PART, 1), _MOST_PARTS)

    def of(self, losses: Losses, batch: Batch, meanwhile: Callable[[], _Result]) -> tuple[Gradients, _Result]:
        cells, pool, count = self._field.cells, self._pool.core_threads, len(batch.points)
        if len(self._located) != count:  # buffers, which the next batch of this size reuses
            self._located = np.empty((count, cells.table.num_levels), np.int32)
            self._interpolated_grad = np.empty((count, cells.interpolated_dim), batch.points.dtype)
        touched = Touched(batch.points, self._located, self._interpolated_grad)
        dropouts = [] if losses == "sdf" else self._draw_dropouts()
        self._loss.begin(
            points=batch.points,
            sdf_m=batch.sdf_m,
            parts=batch.parts,
            rays=None if losses == "sdf" else batch.of_ray,
            dropout=[(dropout.seed, dropout.keep) for _, dropout in dropouts],
            located=None if losses == "intensity" else touched.located,
            interpolated_grad=None if losses == "intensity" else touched.gradient,
            pool=pool,
        )
        try:
            result = meanwhile()
        finally:
            sdf, intensity = self._loss.finish(pool)
        if losses == "intensity":
            return Gradients({"intensity": intensity}, list(self._by_intensity), None), result
        found, networks = {"sdf": sdf}, list(self._by_sdf)
        if losses == "joint":
            found["intensity"] = intensity
            networks += self._by_intensity
        if self._config.moves_rows(self._field.intensity_network is not None):
            return Gradients(found, networks, touched), result
        by_features = torch.zeros_like(cells.features)
        cells.table.scatter(batch.points, touched.located, touched.gradient, by_features.numpy(), pool)
        return Gradients(found, [by_features, *networks], None), result


class AutogradGradients(GradientBackend):
    """Losses of the field, differentiated by PyTorch. One thread computes each part."""

    def num_parts(self, batch_size: int) -> int:
        return min(self._pool.num_threads, batch_size)

    def of(self, losses: Losses, batch: Batch, meanwhile: Callable[[], _Result]) -> tuple[Gradients, _Result]:
        sizes, labelled = map(list, zip(*batch.parts, strict=True))
        # The intensity network sees the leading samples of each part.
        seen = sizes if self._config.training.intensity_in_free_space else labelled
        dropouts = [] if losses == "sdf" else self._draw_dropouts()
        factors = [torch.split_with_sizes(kept.factors(sum(seen), width), seen) for width, kept in dropouts]
        arrays = map(torch.from_numpy, (batch.points, batch.sdf_m, batch.of_ray))
        columns = [torch.split_with_sizes(column, sizes) for column in arrays]

        def of_part(i: int) -> Gradients:
            # Parts may differ in size, and some of a small batch are empty. Each has its shares of the means of the batch.
            share, share_seen = (counts[i] / max(sum(counts), 1) for counts in (sizes, seen))
            points, sdf_m, of_ray = (column[i] for column in columns)
            field, found, parameters = self._field, {}, list[Tensor]()
            if losses == "sdf":
                logit = field.logit(points)
            else:
                assert field.intensity_network is not None
                geometry = field.geometry(points, frozen=losses == "intensity")
                logit, rays = geometry.logit, of_ray[: seen[i]]
                ranges_m = rays[:, core.RAY_RANGE] - sdf_m[: seen[i]]
                directions = rays[:, core.RAY_DIRECTION : core.RAY_RANGE]
                kept = geometry.first(seen[i], [of_encoding[i] for of_encoding in factors])
                predicted = field.intensity_network(kept, directions, ranges_m)
                labels = rays[:, core.RAY_INTENSITY].clone()
                labels[labelled[i] :] = 0  # free space returns nothing (3QFPI)
                # The mean of no samples would be NaN.
                found["intensity"] = (
                    intensity_loss(predicted, labels) * share_seen if seen[i] else predicted.sum()
                )
            if losses != "intensity":
                found["sdf"] = sdf_loss(logit, sdf_m, field.sigma_m) * share if len(logit) else logit.sum()
                parameters += [field.cells.features, *field.sdf_network.parameters()]
            if field.intensity_network is not None and "intensity" in found:
                parameters += field.intensity_network.parameters()
            gradients = list(torch.autograd.grad(torch.stack(list(found.values())).sum(), parameters))
            return Gradients({name: float(loss.detach()) for name, loss in found.items()}, gradients, None)

        parts = list(self._pool.map(of_part, range(len(sizes))))
        total = parts[0].by_parameters
        for part in parts[1:]:
            torch._foreach_add_(total, part.by_parameters)
        summed = {name: sum(part.losses[name] for part in parts) for name in parts[0].losses}
        return Gradients(summed, total, None), meanwhile()


_BETAS = (0.9, 0.999)
_EPSILON = 1e-15  # 3QFP
# Numbers in the state of a row of features, see the core's ``begin_adam_step``, and position of its last step.
_STATE_DIM, _LAST_STEP = 8, 5


class Adam:
    """Adam (Kingma and Ba, ICLR 2015), bit-identical to ``torch.optim.Adam(fused=True)``.

    That class imports PyTorch's compiler and SymPy: 800 modules, which take a second, as long as a small fit.
    """

    def __init__(self, parameters: Iterable[Tensor], learning_rate: float) -> None:
        self.parameters, self.learning_rate = list(parameters), learning_rate
        self._means = [torch.zeros_like(p) for p in self.parameters]
        self._squares = [torch.zeros_like(p) for p in self.parameters]

    def state(self) -> dict[str, Tensor]:
        """Return all that the next steps depend on, except the parameters, without copying."""
        lists = {"mean": self._means, "square": self._squares}
        return {f"{name}.{i}": value for name, values in lists.items() for i, value in enumerate(values)}

    @torch.no_grad()
    def step(self, gradients: Sequence[Tensor], number: int, share: float, pool: ThreadPool | None) -> None:  # noqa: ARG002
        """Take step `number`, from 1 on, by a `share` of the learning rate, on the threads of `pool` if it is idle."""
        steps = [torch.tensor(number, dtype=torch.float32, device="cpu")] * len(self.parameters)
        of_each = self.parameters, list(gradients), self._means, self._squares, list[Tensor](), steps
        rates = {"lr": share * self.learning_rate, "beta1": _BETAS[0], "beta2": _BETAS[1], "eps": _EPSILON}
        step: Any = torch._fused_adam_  # the kernel has no public name
        step(*of_each, **rates, weight_decay=0.0, amsgrad=False, maximize=False)


class Soap:
    """SOAP (Vyas et al., ICLR 2025) for weight matrices, and :class:`Adam` for the other parameters of a network.

    Adam scales each component of a gradient by itself, although the inputs of a layer are correlated. SOAP does so in a
    basis in which they hardly are. Measured: a network learns as much in a quarter to half of Adam's steps.
    """

    def __init__(self, parameters: Iterable[Tensor], learning_rate: float) -> None:
        self.parameters, self.learning_rate = list(parameters), learning_rate
        # A layer with one output has a weight vector: there is no basis to rotate.
        self._are_matrices = [p.ndim == 2 and min(p.shape) > 1 for p in self.parameters]
        self._are_others = [not is_matrix for is_matrix in self._are_matrices]
        self._adam = Adam(compress(self.parameters, self._are_others), learning_rate)
        matrices = list(compress(self.parameters, self._are_matrices))
        self._weights = [kernels.view(p) for p in matrices]
        self._memories = [p.new_zeros(core.soap_memory_size(*p.shape)) for p in matrices]

    def state(self) -> dict[str, Tensor]:
        state = {f"memory.{i}": memory for i, memory in enumerate(self._memories)}
        return state | {f"adam.{k}": v for k, v in self._adam.state().items()}

    def step(self, gradients: Sequence[Tensor], number: int, share: float, pool: ThreadPool | None) -> None:
        self._adam.step(list(compress(gradients, self._are_others)), number, share, None)
        core.soap_step(
            weights=self._weights,
            gradients=[g.numpy() for g in compress(gradients, self._are_matrices)],
            memories=[memory.numpy() for memory in self._memories],
            step=number,
            learning_rate=share * self.learning_rate,
            pool=None if pool is None else pool.core_threads,
        )


class RowAdam:
    """Sparse Adam for the features of cells. The cost of a step is proportional to the touched rows, not to the map.

    The moments of an untouched row decay as with a gradient of zero, but the row does not change. Adam would continue to
    move it along its last gradient, by up to thirty times the learning rate. Measured: the surface is as good without that,
    and a fit of `hugin` takes 4.2 s instead of 5.2. The features of a row share one mean square.
    """

    def __init__(self, cells: VertexFeatures, learning_rate: float) -> None:
        self._cells, self._learning_rate = cells, learning_rate
        self._states = kernels.large_zeros(len(cells.features), _STATE_DIM, dtype=torch.int32)
        self._arrays = kernels.view(cells.features), self._states.numpy()
        self._decays = torch.zeros(0, 2, dtype=torch.float32, device="cpu")

    def state(self) -> dict[str, Tensor]:
        return {"states": self._states}

    def check_state(self, steps: int) -> None:
        """Raise a ValueError if a row has moved after `steps`, which the core does not check."""
        last_step = self._states.numpy()[:, _LAST_STEP]
        fits = 0 <= last_step.min(initial=0) <= last_step.max(initial=0) <= steps
        check(fits, f"a row cannot have moved after step {steps}")
        self._states[:, _LAST_STEP + 1 :] = 0  # the core indexes by the next number

    @torch.no_grad()
    def step(
        self, touched: Touched, number: int, share: float, pool: ThreadPool, meanwhile: Callable[[], None]
    ) -> None:
        """Update the rows touched by a batch. The calling thread first runs `meanwhile`, then helps the others."""
        if number >= len(self._decays):
            powers = torch.arange(2 * number + 1022, dtype=torch.float64, device="cpu")[:, None]
            decays = torch.tensor([_BETAS], dtype=torch.float64, device="cpu") ** powers
            # Denormal numbers would be slow, and are negligible compared with a gradient.
            self._decays = torch.where(decays < 1e-30, 0.0, decays).to(self._decays.dtype)
        arrays = touched.points, touched.located, touched.gradient, *self._arrays, self._decays.numpy()
        rates = number, share * self._learning_rate, _EPSILON
        self._cells.table.begin_adam_step(*arrays, *rates, pool.core_threads)
        try:
            meanwhile()
        finally:
            pool.core_threads.finish()
