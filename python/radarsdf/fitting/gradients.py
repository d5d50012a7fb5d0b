# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Losses of a batch and their gradients: what both back ends answer, and what they share.

:mod:`radarsdf.fitting.autograd_gradients` is the reference: the losses as :class:`~radarsdf.field.field.Field` and
:mod:`~radarsdf.field.losses` define them, differentiated by PyTorch. :mod:`radarsdf.fitting.core_gradients` asks the
compiled core, in one call. Tests hold the two equal up to rounding.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from torch import Tensor

from radarsdf.config import FitConfig
from radarsdf.field.field import Field
from radarsdf.field.widths import cells_width, fourier_width
from radarsdf.fitting.sampling import Dropout, Samples


@dataclass(frozen=True)
class Touched:
    """What a batch took from the features of cells, and the loss's gradient by that."""

    points: Tensor
    """(N, 3), local frame, m."""
    located: Tensor
    """(N, num_levels) int32, the cells that hold them."""
    gradient: Tensor
    """(N, 8 · num_levels), by the interpolated features."""


@dataclass(frozen=True)
class Gradients:
    """Of one thread's share of a batch. The next batch overwrites its arrays."""

    losses: dict[str, float]
    """What each loss, "sdf" and "intensity", adds to that of the whole batch."""
    by_parameters: list[Tensor]
    """By features, where all of them move, SDF network and intensity network, as far as they learn."""
    touched: Touched | None
    """Where only the touched features move."""


@dataclass(frozen=True)
class Share:
    """What one thread's back end knows beside the field."""

    parts: int
    """Threads that share a batch."""
    dropout_scale: float
    """Share of the configured dropout."""
    generator: torch.Generator
    """For dropout."""


class GradientBackend(ABC):
    """Losses and gradients of one thread's share of each batch.

    The parameters of `field` stay where they are in memory.
    """

    def __init__(self, field: Field, config: FitConfig, share: Share) -> None:
        self._field = field
        self._config = config
        self._share = share
        self._moves_rows = config.moves_rows(field.intensity_network is not None)

    @abstractmethod
    def sdf(self, samples: Samples) -> Gradients:
        """Of the SDF's loss alone, by features and SDF network."""

    @abstractmethod
    def joint(self, samples: Samples) -> Gradients:
        """Of both losses, by all parameters."""

    @abstractmethod
    def intensity(self, samples: Samples) -> Gradients:
        """Of the intensity's loss, by the intensity network: features and SDF network are frozen."""

    def state(self) -> dict[str, Tensor]:
        """What its dropout depends on."""
        return {"generator": self._share.generator.get_state()}

    def restore(self, state: dict[str, Tensor]) -> None:
        """Go on as the back end that gave `state`."""
        self._share.generator.set_state(state["generator"])

    def _num_seen(self, samples: Samples) -> int:
        """How many samples the intensity network sees."""
        in_free_space = self._config.training.intensity_in_free_space
        return len(samples.points) if in_free_space else samples.num_near

    def _draw_dropouts(self, count: int) -> list[Dropout]:
        """Of the intensity network's view of so many encoded samples. The SDF network sees all."""
        networks, scale = self._config.networks, self._share.dropout_scale
        shares = [scale * networks.feature_dropout, scale * networks.fourier_dropout]
        if not any(shares):
            return []
        widths = (cells_width(self._config), fourier_width(self._config))
        parts = [part for part in zip(widths, shares, strict=True) if part[0]]
        return [Dropout.draw(count, *part, self._share.generator) for part in parts]
