# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""One thread's share of the work on a batch: its losses and their gradients."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from radarsdf import _core
from radarsdf.config import FitConfig
from radarsdf.field import kernels
from radarsdf.field.field import Field
from radarsdf.field.losses import intensity_loss, sdf_loss
from radarsdf.field.networks import IntensityNetwork
from radarsdf.fitting.optimiser import Touched
from radarsdf.fitting.sampling import Dropout, Samples


@dataclass(frozen=True)
class Gradients:
    """Of one thread's share of a batch. Its arrays are written again for the next."""

    losses: dict[str, float]
    """What each loss, "sdf" and "intensity", adds to that of the whole batch."""
    by_parameters: list[Tensor]
    """By features, where all of them move, SDF network and intensity network, as far as they learn."""
    touched: Touched | None
    """Where only the touched features move."""


class Shard:
    """Losses and gradients as :class:`~radarsdf.field.field.Field` and :mod:`~radarsdf.field.losses` define them.

    The core has them in one call. Only where the intensity network sees normals, which are themselves gradients, does
    PyTorch's autograd go through all of it.

    Parameters
    ----------
    field : Field
        Whose parameters stay where they are in memory.
    config : FitConfig
        Of the fit.
    dropout_scale : float
        Share of the configured dropout.
    generator : torch.Generator
        For dropout.
    parts : int
        Threads that share a batch.
    moves_rows : bool
        Whether only the touched features move.
    """

    def __init__(
        self,
        field: Field,
        config: FitConfig,
        dropout_scale: float,
        generator: torch.Generator,
        parts: int,
        *,
        moves_rows: bool,
    ) -> None:
        self._field = field
        self._config = config
        self._dropouts = [dropout_scale * share for share in (config.feature_dropout, config.fourier_dropout)]
        self._generator = generator
        self._parts = parts
        self._moves_rows = moves_rows
        fourier, network = field.fourier, field.intensity_network
        self._loss = _core.FieldLoss(
            table=field.cells.table,
            features=kernels.view(field.cells.features),
            frequencies=(fourier.half_width_m, fourier.first_frequency, fourier.num_frequencies),
            sdf=_layers(field.sdf_network),
            intensity=None if network is None or config.normals else _layers(network),
            sees=_sees(network),
            sigma_m=config.sigma_m,
            intensity_in_free_space=config.intensity_in_free_space,
        )
        self._by_sdf = [torch.from_numpy(gradient) for gradient in self._loss.sdf_gradients]
        self._by_intensity = [torch.from_numpy(gradient) for gradient in self._loss.intensity_gradients]

    def state(self) -> dict[str, Tensor]:
        """What its dropout depends on."""
        return {"generator": self._generator.get_state()}

    def restore(self, state: dict[str, Tensor]) -> None:
        self._generator.set_state(state["generator"])

    def geometry(self, samples: Samples) -> Gradients:
        """Of the SDF's loss alone."""
        touched = self._untouched(samples)
        sdf = self._loss.geometry(
            points=samples.points.numpy(),
            sdf_m=samples.sdf_m.numpy(),
            weight=1 / self._parts,
            located=touched.located.numpy(),
            interpolated_grad=touched.gradient.numpy(),
        )
        return self._with_features({"sdf": sdf / self._parts}, touched, self._by_sdf)

    def joint(self, samples: Samples) -> Gradients:
        """Of both losses."""
        if self._config.normals:
            return self._by_autograd(samples, frozen=False)
        touched, sdf_weight = self._untouched(samples), self._config.sdf_loss_weight
        sdf, intensity = self._loss.joint(
            **self._batch(samples),
            weights=(sdf_weight / self._parts, 1 / self._parts),
            located=touched.located.numpy(),
            interpolated_grad=touched.gradient.numpy(),
        )
        losses = {"sdf": sdf_weight * sdf / self._parts, "intensity": intensity / self._parts}
        return self._with_features(losses, touched, self._by_sdf + self._by_intensity)

    def reflectance(self, samples: Samples) -> Gradients:
        """Of the intensity's loss, by the intensity network: the geometry is frozen."""
        if self._config.normals:
            return self._by_autograd(samples, frozen=True)
        intensity = self._loss.reflectance(**self._batch(samples), weight=1 / self._parts)
        return Gradients({"intensity": intensity / self._parts}, list(self._by_intensity), None)

    def _batch(self, samples: Samples) -> dict[str, Any]:
        """What the core's losses of intensities take of samples."""
        dropouts = self._draw_dropouts(self._seen(samples))
        return {
            "points": samples.points.numpy(),
            "sdf_m": samples.sdf_m.numpy(),
            "rays": samples.of_ray.numpy(),
            "num_near": samples.num_near,
            "dropout": [(dropout.bytes.numpy(), dropout.keep) for dropout in dropouts],
        }

    def _untouched(self, samples: Samples) -> Touched:
        """For the core to fill."""
        cells, count = self._field.cells, len(samples.points)
        located = torch.empty((count, cells.table.num_levels), dtype=torch.int32)
        return Touched(samples.points, located, samples.points.new_empty((count, cells.interpolated_dim)))

    def _with_features(
        self, losses: dict[str, float], touched: Touched, by_networks: list[Tensor]
    ) -> Gradients:
        """With the gradient by all features, unless only those that are touched move."""
        if self._moves_rows:
            return Gradients(losses, list(by_networks), touched)
        table = self._field.cells.table
        by_features = kernels.scatter(table, touched.points, touched.located, None, touched.gradient)
        return Gradients(losses, [by_features, *by_networks], None)

    def _by_autograd(self, samples: Samples, *, frozen: bool) -> Gradients:
        field = self._field
        geometry = field.geometry(samples.points, frozen=frozen)
        count = self._seen(samples)
        labels = samples.intensities[:count].clone()
        labels[samples.num_near :] = 0  # no return is expected from free space (3QFPI)
        predicted = field.reflectance(
            geometry.first(count),
            samples.directions[:count],
            samples.ranges_m[:count] - samples.sdf_m[:count],
            encoding_factors=[dropout.factors for dropout in self._draw_dropouts(count)] or None,
        )
        losses = {"intensity": intensity_loss(predicted, labels) / self._parts}
        assert field.intensity_network is not None
        parameters = list(field.intensity_network.parameters())
        if not frozen:
            sdf = sdf_loss(geometry.logit, samples.sdf_m, self._config.sigma_m)
            losses["sdf"] = self._config.sdf_loss_weight * sdf / self._parts
            parameters = [*field.cells.parameters(), *field.sdf_network.parameters(), *parameters]
        by_parameters = list(torch.autograd.grad(torch.stack(list(losses.values())).sum(), parameters))
        return Gradients({name: float(loss.detach()) for name, loss in losses.items()}, by_parameters, None)

    def _seen(self, samples: Samples) -> int:
        """How many samples the intensity network sees."""
        return len(samples.points) if self._config.intensity_in_free_space else samples.num_near

    def _draw_dropouts(self, count: int) -> list[Dropout]:
        """Of the encoding of so many samples, which the SDF network is spared."""
        if not any(self._dropouts):
            return []
        dims = (self._field.cells.dim, self._field.fourier.dim)
        parts = [part for part in zip(dims, self._dropouts, strict=True) if part[0]]
        return [Dropout.draw(count, *part, self._generator) for part in parts]


def _layers(network: nn.Module) -> tuple[list[np.ndarray[Any, Any]], list[np.ndarray[Any, Any]]]:
    """Weights and biases of a network's layers, where they are."""
    values = [kernels.view(parameter) for parameter in network.parameters()]
    return values[::2], values[1::2]


def _sees(network: IntensityNetwork | None) -> tuple[bool, bool, bool]:
    """Whether it sees SDF, viewing direction and range."""
    return (False,) * 3 if network is None else (network.sdf_input, network.view_direction, network.log_range)
