# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Losses and gradients of a batch, by the compiled core or by PyTorch's autograd.

:class:`AutogradGradients` is the reference: it differentiates the losses of :mod:`~radarsdf.field.losses` by PyTorch. Only it
has normals, which are gradients themselves. :class:`CoreGradients` calls the core once a batch and takes a half to a third of
the time. Tests check that the two are equal up to rounding.
"""

from __future__ import annotations

import functools
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor, nn

from radarsdf import _core
from radarsdf.config.fit_config import FitConfig
from radarsdf.field import kernels
from radarsdf.field.losses import intensity_loss, sdf_loss
from radarsdf.field.neural_field import Geometry, NeuralField, cells_width, fourier_width
from radarsdf.fitting.sampling import Batch, Dropout, Samples
from radarsdf.threads import Workers

# Dropout of the features and of the Fourier encoding before the intensity network. If the training uses each sample n times,
# they are multiplied by n / (n + 2.5): the more often a sample is used, the more easily the network memorises it.
FEATURE_DROPOUT, FOURIER_DROPOUT = 0.85, 0.25
# Samples in a part. Smaller parts divide better among threads and fit the cache, but each prepares the networks again: of
# a joint batch of 4096 samples, 4, 8 and 16 parts took 1.02, 1.07 and 1.16 times as long as two.
_PART = 512
_MOST_PARTS = 64  # each keeps gradients of the networks
_Result = TypeVar("_Result")


@dataclass(frozen=True)
class Touched:
    """Samples of a batch, and the gradient of the loss with respect to their interpolated features.

    The features of cells that hold a sample are touched.
    """

    points: Tensor
    """(N, 3) samples, local frame, m."""
    located: Tensor
    """(N, num_levels) int32, rows of the cells that hold them."""
    gradient: Tensor
    """(N, 8 · num_levels), with respect to the interpolated features."""


@dataclass(frozen=True)
class Gradients:
    """Losses and gradients of a batch. The next batch overwrites the arrays."""

    losses: dict[str, float]
    """Each loss, "sdf" and "intensity"."""
    by_parameters: list[Tensor]
    """Gradients of those parameters that are trained: all features (unless `touched` is given), SDF network,
    intensity network."""
    touched: list[Touched] | None
    """If only the touched features move: the gradient for these, perhaps in parts."""


@dataclass(frozen=True)
class RandomDropout:
    """Factor on the usual dropout, and the random numbers that it is drawn from."""

    scale: float
    generator: torch.Generator


class GradientBackend(ABC):
    """Losses and gradients of batches.

    The parameters of `field` must keep their memory. Gradients of a batch's parts are added in their order, so the threads
    of `workers` change no bit. The calling thread runs `meanwhile` while others work on the batch; its result is returned.
    """

    def __init__(
        self, field: NeuralField, config: FitConfig, dropout: RandomDropout, workers: Workers
    ) -> None:
        self._field, self._config, self._dropout, self._workers = field, config, dropout, workers
        self._moves_rows = config.moves_rows(field.intensity_network is not None)

    def sdf(self, batch: Batch, meanwhile: Callable[[], _Result]) -> tuple[Gradients, _Result]:
        """Gradients of the sdf loss with respect to features and SDF network."""
        return self._of("sdf", batch, meanwhile)

    def joint(self, batch: Batch, meanwhile: Callable[[], _Result]) -> tuple[Gradients, _Result]:
        """Gradients of the sum of both losses with respect to all parameters."""
        return self._of("joint", batch, meanwhile)

    def intensity(self, batch: Batch, meanwhile: Callable[[], _Result]) -> tuple[Gradients, _Result]:
        """Gradients of the intensity loss with respect to the intensity network. The other parameters are frozen."""
        return self._of("intensity", batch, meanwhile)

    @abstractmethod
    def num_parts(self, batch_size: int) -> int:
        """The best number of parts of a batch with so many samples."""

    @abstractmethod
    def _of(
        self, losses: str, batch: Batch, meanwhile: Callable[[], _Result]
    ) -> tuple[Gradients, _Result]: ...

    def state(self) -> dict[str, Tensor]:
        """The state of the random numbers of dropout."""
        return {"generator": self._dropout.generator.get_state()}

    def restore(self, state: dict[str, Tensor]) -> None:
        """Restores what :meth:`state` gave."""
        self._dropout.generator.set_state(state["generator"])

    def _draw_dropouts(self) -> list[tuple[int, Dropout]]:
        """Columns and dropout of each part of the encoding, for the intensity network alone."""
        if not self._config.networks.dropout or self._dropout.scale == 0:
            return []
        shares = (self._dropout.scale * FEATURE_DROPOUT, self._dropout.scale * FOURIER_DROPOUT)
        widths = (cells_width(self._config), fourier_width(self._config))
        return [
            (width, Dropout.draw(share, self._dropout.generator))
            for width, share in zip(widths, shares, strict=True)
            if width
        ]


class CoreGradients(GradientBackend):
    """Losses and gradients by the core's ``FieldLoss``, which checks the field's arrays once and reads them in each call."""

    def __init__(
        self, field: NeuralField, config: FitConfig, dropout: RandomDropout, workers: Workers
    ) -> None:
        super().__init__(field, config, dropout, workers)
        fourier, network, sees = field.fourier, field.intensity_network, config.networks
        self._loss = _core.FieldLoss(
            table=field.cells.table,
            features=kernels.view(field.cells.features),
            frequencies=(fourier.half_width_m, 0, fourier.num_frequencies),
            sdf=_layers(field.sdf_network),
            intensity=None if network is None else _layers(network),
            sees=(sees.sdf_input, sees.view_direction, sees.log_range),
            sigma_m=field.sigma_m,
            intensity_in_free_space=config.training.intensity_in_free_space,
        )
        self._by_sdf = [torch.from_numpy(gradient) for gradient in self._loss.sdf_gradients]
        self._by_intensity = [torch.from_numpy(gradient) for gradient in self._loss.intensity_gradients]

    def num_parts(self, batch_size: int) -> int:
        return min(max(batch_size // _PART, 1), _MOST_PARTS)

    def _of(self, losses: str, batch: Batch, meanwhile: Callable[[], _Result]) -> tuple[Gradients, _Result]:
        crew, sdf_weight = self._workers.crew, self._config.training.sdf_loss_weight
        arguments: dict[str, Any] = {"points": batch.points.numpy(), "sdf_m": batch.sdf_m.numpy()}
        arguments |= {"parts": batch.parts, "crew": crew}
        touched = self._untouched(batch)
        if losses != "intensity":
            arguments["located"] = touched.located.numpy()
            arguments["interpolated_grad"] = touched.gradient.numpy()
        if losses != "sdf":
            arguments["rays"] = batch.of_ray.numpy()
            arguments["dropout"] = [(dropout.seed, dropout.keep) for _, dropout in self._draw_dropouts()]
        if losses == "sdf":
            self._loss.begin_sdf(**arguments, weight=1.0)
        elif losses == "joint":
            self._loss.begin_joint(**arguments, weights=(sdf_weight, 1.0))
        else:
            self._loss.begin_intensity(**arguments, weight=1.0)
        try:
            result = meanwhile()
        finally:
            sdf, intensity = self._loss.finish(crew)
        if losses == "intensity":
            return Gradients({"intensity": intensity}, list(self._by_intensity), None), result
        if losses == "sdf":
            return self._with_features({"sdf": sdf}, touched, self._by_sdf), result
        both = {"sdf": sdf_weight * sdf, "intensity": intensity}
        return self._with_features(both, touched, self._by_sdf + self._by_intensity), result

    def _untouched(self, batch: Batch) -> Touched:
        """Samples with arrays that the core fills."""
        cells, count = self._field.cells, len(batch.points)
        located = torch.empty((count, cells.table.num_levels), dtype=torch.int32, device="cpu")
        return Touched(batch.points, located, batch.points.new_empty((count, cells.interpolated_dim)))

    def _with_features(
        self, losses: dict[str, float], touched: Touched, by_networks: list[Tensor]
    ) -> Gradients:
        """Adds the gradient by features: of the touched ones if only these move, otherwise of all."""
        if self._moves_rows:
            return Gradients(losses, list(by_networks), [touched])
        by_features = torch.zeros_like(self._field.cells.features)
        self._field.table.scatter(
            touched.points.numpy(),
            touched.located.numpy(),
            touched.gradient.numpy(),
            by_features.numpy(),
            self._workers.crew,
        )
        return Gradients(losses, [by_features, *by_networks], None)


def _layers(network: nn.Module) -> tuple[list[np.ndarray[Any, Any]], list[np.ndarray[Any, Any]]]:
    """Weights and biases of a network's layers, as views of their memory."""
    values = [kernels.view(parameter) for parameter in network.parameters()]
    return values[::2], values[1::2]


@dataclass(frozen=True)
class _Part:
    """The work of one thread."""

    samples: Samples
    dropout_factors: list[Tensor] | None
    """What each part of the encoding of the samples that are seen is multiplied by."""


class AutogradGradients(GradientBackend):
    """Losses of the field, differentiated by PyTorch."""

    def num_parts(self, batch_size: int) -> int:
        return min(self._workers.num_threads, batch_size)

    def _of(self, losses: str, batch: Batch, meanwhile: Callable[[], _Result]) -> tuple[Gradients, _Result]:
        parts = [_Part(samples, None) for samples in batch.split()] if losses == "sdf" else self._parts(batch)
        of_part = functools.partial(self._of_part, losses)
        return _sum(list(self._workers.map(of_part, parts))), meanwhile()

    def _parts(self, batch: Batch) -> list[_Part]:
        parts = batch.split()
        seen = [self._num_seen(samples) for samples in parts]
        of_encodings = [
            torch.split_with_sizes(dropout.factors(sum(seen), columns, batch.points.dtype), seen)
            for columns, dropout in self._draw_dropouts()
        ]
        return [
            _Part(samples, [factors[i] for factors in of_encodings] or None)
            for i, samples in enumerate(parts)
        ]

    def _num_seen(self, samples: Samples) -> int:
        """Number of samples, the first ones, that the intensity network sees."""
        in_free_space = self._config.training.intensity_in_free_space
        return len(samples.points) if in_free_space else samples.num_labelled

    def _of_part(self, losses: str, part: _Part) -> Gradients:
        field, samples = self._field, part.samples
        if losses == "intensity":
            geometry = field.geometry(samples.points)
            return self._gradients({"intensity": self._intensity_loss(geometry, part)}, None, frozen=True)
        touched = self._touched(samples)
        interpolated = None if touched is None else touched.gradient
        if losses == "sdf":
            logit = field.logit(samples.points, interpolated)
            return self._gradients({"sdf": self._sdf_loss(logit, samples)}, touched)
        geometry = field.geometry(samples.points, frozen=False, interpolated=interpolated)
        sdf_weight = self._config.training.sdf_loss_weight
        both = {
            "intensity": self._intensity_loss(geometry, part),
            "sdf": sdf_weight * self._sdf_loss(geometry.logit, samples),
        }
        return self._gradients(both, touched)

    def _touched(self, samples: Samples) -> Touched | None:
        """If only touched features move: the samples, with interpolated features, which autograd differentiates by."""
        if not self._moves_rows:
            return None
        cells = self._field.cells
        interpolated, located = kernels.encode(cells.features, samples.points, cells.table)
        return Touched(samples.points, located, interpolated.requires_grad_())

    def _sdf_loss(self, logit: Tensor, samples: Samples) -> Tensor:
        if len(logit) == 0:  # whose mean is not a number
            return logit.sum()
        return sdf_loss(logit, samples.sdf_m, self._field.sigma_m) * samples.share

    def _intensity_loss(self, geometry: Geometry, part: _Part) -> Tensor:
        samples = part.samples
        count = self._num_seen(samples)
        labels = samples.intensities[:count].clone()
        labels[samples.num_labelled :] = 0  # free space returns nothing (3QFPI)
        predicted = self._field.intensity_of(
            geometry.first(count),
            samples.directions[:count],
            samples.ranges_m[:count] - samples.sdf_m[:count],
            encoding_factors=part.dropout_factors,
        )
        if count == 0:
            return predicted.sum()
        # What the mean over these counts in that of the whole batch.
        in_free_space = self._config.training.intensity_in_free_space
        share = samples.share if in_free_space else samples.labelled_share
        return intensity_loss(predicted, labels) * share

    def _gradients(
        self, losses: dict[str, Tensor], touched: Touched | None, *, frozen: bool = False
    ) -> Gradients:
        field = self._field
        parameters: list[Tensor] = []
        if not frozen:
            parameters += [field.cells.features if touched is None else touched.gradient]
            parameters += field.sdf_network.parameters()
        if "intensity" in losses:
            assert field.intensity_network is not None
            parameters += field.intensity_network.parameters()
        found = list(torch.autograd.grad(torch.stack(list(losses.values())).sum(), parameters))
        of_rows = None
        if touched is not None:
            of_rows = [Touched(touched.points, touched.located, found.pop(0))]
        return Gradients({name: float(loss.detach()) for name, loss in losses.items()}, found, of_rows)


def _sum(parts: Sequence[Gradients]) -> Gradients:
    """Losses and gradients of all parts. Changes the first part's."""
    first, *others = parts
    for part in others:
        torch._foreach_add_(first.by_parameters, part.by_parameters)
    losses = {name: sum(part.losses[name] for part in parts) for name in first.losses}
    touched = None if first.touched is None else [t for part in parts for t in part.touched or ()]
    return Gradients(losses, first.by_parameters, touched)
