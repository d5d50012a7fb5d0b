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
        self._sdf = _Arrays.of(field.sdf_network)
        self._intensity = None if field.intensity_network is None else _Arrays.of(field.intensity_network)

    def state(self) -> dict[str, Tensor]:
        """What its dropout depends on."""
        return {"generator": self._generator.get_state()}

    def restore(self, state: dict[str, Tensor]) -> None:
        self._generator.set_state(state["generator"])

    def geometry(self, samples: Samples) -> Gradients:
        """Of the SDF's loss alone."""
        return self._by_core(samples, sdf_weight=1.0, intensity=None)

    def joint(self, samples: Samples) -> Gradients:
        """Of both losses."""
        if self._config.normals:
            return self._by_autograd(samples, frozen=False)
        return self._by_core(samples, sdf_weight=self._config.sdf_loss_weight, intensity=self._intensity)

    def reflectance(self, samples: Samples) -> Gradients:
        """Of the intensity's loss, by the intensity network: the geometry is frozen."""
        if self._config.normals:
            return self._by_autograd(samples, frozen=True)
        return self._by_core(samples, sdf_weight=None, intensity=self._intensity)

    def _by_core(self, samples: Samples, sdf_weight: float | None, intensity: _Arrays | None) -> Gradients:
        cells, fourier, network = self._field.cells, self._field.fourier, self._field.intensity_network
        count = 0 if intensity is None else self._seen(samples)
        dropouts = [] if intensity is None else self._draw_dropouts(count)
        located = torch.empty((len(samples.points), cells.table.num_levels), dtype=torch.int32)
        frozen = sdf_weight is None
        by_interpolated = None if frozen else samples.points.new_empty((len(located), cells.interpolated_dim))
        sdf, reflectance = _core.field_loss(
            table=cells.table,
            features=kernels.view(cells.features),
            frequencies=(fourier.half_width_m, fourier.first_frequency, fourier.num_frequencies),
            sdf=self._sdf.values,
            intensity=None if intensity is None else intensity.values,
            sees=_sees(network),
            points=samples.points.numpy(),
            sdf_m=samples.sdf_m.numpy(),
            rays=samples.of_ray.numpy(),
            num_near=samples.num_near,
            intensity_count=count,
            dropout=[(dropout.bytes.numpy(), dropout.keep) for dropout in dropouts],
            sigma_m=self._config.sigma_m,
            sdf_weight=(sdf_weight or 0.0) / self._parts,
            intensity_weight=1 / self._parts,
            sdf_grads=None if frozen else self._sdf.gradient_values,
            intensity_grads=None if intensity is None else intensity.gradient_values,
            located=located.numpy(),
            interpolated_grad=None if by_interpolated is None else by_interpolated.numpy(),
        )
        losses: dict[str, float] = {}
        by_parameters: list[Tensor] = []
        touched = None
        if sdf_weight is not None and by_interpolated is not None:
            losses["sdf"] = sdf_weight * sdf / self._parts
            if self._moves_rows:
                touched = Touched(samples.points, located, by_interpolated)
            else:
                by_features = kernels.scatter(cells.table, samples.points, located, None, by_interpolated)
                by_parameters.append(by_features)
            by_parameters += self._sdf.gradients
        if intensity is not None:
            losses["intensity"] = reflectance / self._parts
            by_parameters += intensity.gradients
        return Gradients(losses, by_parameters, touched)

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


@dataclass(frozen=True)
class _Arrays:
    """A network for the core."""

    values: tuple[list[np.ndarray[Any, Any]], list[np.ndarray[Any, Any]]]
    """Weights and biases of its layers."""
    gradients: list[Tensor]
    """By each of its parameters, in their order."""
    gradient_values: tuple[list[np.ndarray[Any, Any]], list[np.ndarray[Any, Any]]]
    """The same by weights and by biases."""

    @classmethod
    def of(cls, network: nn.Module) -> _Arrays:
        values = [kernels.view(parameter) for parameter in network.parameters()]
        gradients = [torch.empty_like(parameter) for parameter in network.parameters()]
        arrays = [gradient.numpy() for gradient in gradients]
        return cls((values[::2], values[1::2]), gradients, (arrays[::2], arrays[1::2]))


def _sees(network: IntensityNetwork | None) -> tuple[bool, bool, bool]:
    """Whether it sees SDF, viewing direction and range."""
    return (False,) * 3 if network is None else (network.sdf_input, network.view_direction, network.log_range)
