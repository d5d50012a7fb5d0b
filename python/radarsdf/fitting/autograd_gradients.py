# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Losses and gradients by PyTorch's autograd: the reference that the compiled core is tested against."""

from __future__ import annotations

import torch
from torch import Tensor

from radarsdf.field import kernels
from radarsdf.field.field import Geometry
from radarsdf.field.losses import intensity_loss, sdf_loss
from radarsdf.fitting.gradients import GradientBackend, Gradients, Touched
from radarsdf.fitting.sampling import Samples


class AutogradGradients(GradientBackend):
    """Losses of the field, differentiated by PyTorch."""

    def sdf(self, samples: Samples) -> Gradients:
        touched = self._touched(samples)
        logit = self._field.logit(samples.points, None if touched is None else touched.gradient)
        return self._gradients({"sdf": self._sdf_loss(logit, samples)}, touched)

    def joint(self, samples: Samples) -> Gradients:
        touched = self._touched(samples)
        interpolated = None if touched is None else touched.gradient
        geometry = self._field.geometry(samples.points, frozen=False, interpolated=interpolated)
        losses = {
            "intensity": self._intensity_loss(geometry, samples),
            "sdf": self._config.training.sdf_loss_weight * self._sdf_loss(geometry.logit, samples),
        }
        return self._gradients(losses, touched)

    def intensity(self, samples: Samples) -> Gradients:
        geometry = self._field.geometry(samples.points)
        return self._gradients({"intensity": self._intensity_loss(geometry, samples)}, None, frozen=True)

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

    def _intensity_loss(self, geometry: Geometry, samples: Samples) -> Tensor:
        count = self._num_seen(samples)
        labels = samples.intensities[:count].clone()
        labels[samples.num_labelled :] = 0  # free space returns nothing (3QFPI)
        predicted = self._field.intensity(
            geometry.first(count),
            samples.directions[:count],
            samples.ranges_m[:count] - samples.sdf_m[:count],
            encoding_factors=[drawn.factors_of(labels.dtype) for drawn in self._draw_dropouts(count)] or None,
        )
        if count == 0:
            return predicted.sum()
        return intensity_loss(predicted, labels) * self._seen_share(samples)

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
        if touched is not None:
            touched = Touched(touched.points, touched.located, found.pop(0))
        return Gradients({name: float(loss.detach()) for name, loss in losses.items()}, found, touched)
