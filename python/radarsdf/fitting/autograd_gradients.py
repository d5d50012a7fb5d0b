# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Losses and gradients by PyTorch's autograd: the reference that the compiled core is tested against."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import torch
from torch import Tensor

from radarsdf.field import kernels
from radarsdf.field.field import Geometry
from radarsdf.field.losses import intensity_loss, sdf_loss
from radarsdf.fitting.gradients import GradientBackend, Gradients, Touched
from radarsdf.fitting.sampling import Batch, Samples

_Result = TypeVar("_Result")


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

    def sdf(self, batch: Batch, meanwhile: Callable[[], _Result]) -> tuple[Gradients, _Result]:
        return _sum(list(self._workers.map(self._sdf, batch.split()))), meanwhile()

    def joint(self, batch: Batch, meanwhile: Callable[[], _Result]) -> tuple[Gradients, _Result]:
        return _sum(list(self._workers.map(self._joint, self._parts(batch)))), meanwhile()

    def intensity(self, batch: Batch, meanwhile: Callable[[], _Result]) -> tuple[Gradients, _Result]:
        return _sum(list(self._workers.map(self._intensity, self._parts(batch)))), meanwhile()

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

    def _sdf(self, samples: Samples) -> Gradients:
        touched = self._touched(samples)
        logit = self._field.logit(samples.points, None if touched is None else touched.gradient)
        return self._gradients({"sdf": self._sdf_loss(logit, samples)}, touched)

    def _joint(self, part: _Part) -> Gradients:
        samples = part.samples
        touched = self._touched(samples)
        interpolated = None if touched is None else touched.gradient
        geometry = self._field.geometry(samples.points, frozen=False, interpolated=interpolated)
        losses = {
            "intensity": self._intensity_loss(geometry, part),
            "sdf": self._config.training.sdf_loss_weight * self._sdf_loss(geometry.logit, samples),
        }
        return self._gradients(losses, touched)

    def _intensity(self, part: _Part) -> Gradients:
        geometry = self._field.geometry(part.samples.points)
        return self._gradients({"intensity": self._intensity_loss(geometry, part)}, None, frozen=True)

    def _touched(self, samples: Samples) -> Touched | None:
        """If only touched features move: the samples, with interpolated features in place of the gradient.

        These are the leaves that autograd differentiates with respect to. :meth:`_gradients` puts in the
        gradient.
        """
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
        predicted = self._field.intensity(
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
