# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Losses and gradients by a call of the compiled core."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor, nn

from radarsdf import _core
from radarsdf.config.fit_config import FitConfig
from radarsdf.field import kernels
from radarsdf.field.field import Field
from radarsdf.fitting.gradients import GradientBackend, Gradients, RandomDropout, Touched
from radarsdf.fitting.sampling import Batch
from radarsdf.threads import Workers

# Samples in a part. Smaller parts divide better among threads and fit the cache, but each prepares the networks again: of
# a joint batch of 4096 samples, 4, 8 and 16 parts took 1.02, 1.07 and 1.16 times as long as two.
_PART = 512
_MOST_PARTS = 64  # each keeps gradients of the networks
_Result = TypeVar("_Result")


class CoreGradients(GradientBackend):
    """Losses and gradients by the core's ``FieldLoss``.

    It checks the field's arrays once and reads their present values in each call. It has no normals: they are
    gradients, and it does not differentiate twice.
    """

    def __init__(self, field: Field, config: FitConfig, dropout: RandomDropout, workers: Workers) -> None:
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

    def sdf(self, batch: Batch, meanwhile: Callable[[], _Result]) -> tuple[Gradients, _Result]:
        touched = self._untouched(batch)
        self._loss.begin_sdf(
            points=batch.points.numpy(),
            sdf_m=batch.sdf_m.numpy(),
            parts=batch.parts,
            weight=1.0,
            located=touched.located.numpy(),
            interpolated_grad=touched.gradient.numpy(),
            crew=self._workers.crew,
        )
        (loss, _), result = self._finish(meanwhile)
        return self._with_features({"sdf": loss}, touched, self._by_sdf), result

    def joint(self, batch: Batch, meanwhile: Callable[[], _Result]) -> tuple[Gradients, _Result]:
        touched, sdf_weight = self._untouched(batch), self._config.training.sdf_loss_weight
        self._loss.begin_joint(
            **self._arguments(batch),
            weights=(sdf_weight, 1.0),
            located=touched.located.numpy(),
            interpolated_grad=touched.gradient.numpy(),
        )
        (sdf, intensity), result = self._finish(meanwhile)
        losses = {"sdf": sdf_weight * sdf, "intensity": intensity}
        return self._with_features(losses, touched, self._by_sdf + self._by_intensity), result

    def intensity(self, batch: Batch, meanwhile: Callable[[], _Result]) -> tuple[Gradients, _Result]:
        self._loss.begin_intensity(**self._arguments(batch), weight=1.0)
        (_, loss), result = self._finish(meanwhile)
        return Gradients({"intensity": loss}, list(self._by_intensity), None), result

    def _finish(self, meanwhile: Callable[[], _Result]) -> tuple[tuple[float, float], _Result]:
        """The losses of the batch that was begun."""
        try:
            result = meanwhile()
        finally:
            losses = self._loss.finish(self._workers.crew)
        return losses, result

    def _arguments(self, batch: Batch) -> dict[str, Any]:
        """What the core's joint and intensity losses are called with."""
        return {
            "points": batch.points.numpy(),
            "sdf_m": batch.sdf_m.numpy(),
            "parts": batch.parts,
            "rays": batch.of_ray.numpy(),
            "dropout": [(dropout.seed, dropout.keep) for _, dropout in self._draw_dropouts()],
            "crew": self._workers.crew,
        }

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
        self._field.cells.table.scatter(
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
