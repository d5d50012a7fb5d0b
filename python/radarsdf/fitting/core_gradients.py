# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Losses and gradients by a call of the compiled core."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from radarsdf import _core
from radarsdf.config import FitConfig
from radarsdf.field import kernels
from radarsdf.field.field import Field
from radarsdf.fitting.gradients import GradientBackend, Gradients, Share, Touched
from radarsdf.fitting.sampling import Samples


class CoreGradients(GradientBackend):
    """Losses and gradients by the core's ``FieldLoss``.

    It checks the field's arrays once and reads their present values in each call. It has no normals: they are
    gradients, and it does not differentiate twice.
    """

    def __init__(self, field: Field, config: FitConfig, share: Share) -> None:
        super().__init__(field, config, share)
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

    def sdf(self, samples: Samples) -> Gradients:
        touched, share = self._untouched(samples), samples.share
        loss = self._loss.sdf(
            points=samples.points.numpy(),
            sdf_m=samples.sdf_m.numpy(),
            weight=share,
            located=touched.located.numpy(),
            interpolated_grad=touched.gradient.numpy(),
        )
        return self._with_features({"sdf": loss * share}, touched, self._by_sdf)

    def joint(self, samples: Samples) -> Gradients:
        touched, seen_share = self._untouched(samples), self._seen_share(samples)
        sdf_weight = self._config.training.sdf_loss_weight * samples.share
        sdf, intensity = self._loss.joint(
            **self._batch(samples),
            weights=(sdf_weight, seen_share),
            located=touched.located.numpy(),
            interpolated_grad=touched.gradient.numpy(),
        )
        losses = {"sdf": sdf_weight * sdf, "intensity": intensity * seen_share}
        return self._with_features(losses, touched, self._by_sdf + self._by_intensity)

    def intensity(self, samples: Samples) -> Gradients:
        share = self._seen_share(samples)
        loss = self._loss.intensity(**self._batch(samples), weight=share)
        return Gradients({"intensity": loss * share}, list(self._by_intensity), None)

    def _batch(self, samples: Samples) -> dict[str, Any]:
        """The arguments of the core's joint and intensity losses that come from samples."""
        dropouts = self._draw_dropouts(self._num_seen(samples))
        return {
            "points": samples.points.numpy(),
            "sdf_m": samples.sdf_m.numpy(),
            "rays": samples.of_ray.numpy(),
            "num_labelled": samples.num_labelled,
            "dropout": [(dropout.bytes, dropout.keep) for dropout in dropouts],
        }

    def _untouched(self, samples: Samples) -> Touched:
        """Samples with arrays that the core fills."""
        cells, count = self._field.cells, len(samples.points)
        located = torch.empty((count, cells.table.num_levels), dtype=torch.int32, device="cpu")
        return Touched(samples.points, located, samples.points.new_empty((count, cells.interpolated_dim)))

    def _with_features(
        self, losses: dict[str, float], touched: Touched, by_networks: list[Tensor]
    ) -> Gradients:
        """Adds the gradient by features: of the touched ones if only these move, otherwise of all."""
        if self._moves_rows:
            return Gradients(losses, list(by_networks), touched)
        table = self._field.cells.table
        by_features = kernels.scatter(table, touched.points, touched.located, None, touched.gradient)
        return Gradients(losses, [by_features, *by_networks], None)


def _layers(network: nn.Module) -> tuple[list[np.ndarray[Any, Any]], list[np.ndarray[Any, Any]]]:
    """Weights and biases of a network's layers, as views of their memory."""
    values = [kernels.view(parameter) for parameter in network.parameters()]
    return values[::2], values[1::2]
