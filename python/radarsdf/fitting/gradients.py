# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The interface of the two back ends that compute losses and gradients, and their common code.

:mod:`radarsdf.fitting.autograd_gradients` is the reference. It differentiates the losses of
:class:`~radarsdf.field.field.Field` and :mod:`~radarsdf.field.losses` by PyTorch.
:mod:`radarsdf.fitting.core_gradients` calls the compiled core once. Tests check that the two are equal up to
rounding.
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
    """The samples of a batch, and the gradient of the loss with respect to their interpolated features.

    The features of cells that hold a sample are called touched.
    """

    points: Tensor
    """(N, 3) samples, local frame, m."""
    located: Tensor
    """(N, num_levels) int32, rows of the cells that hold them."""
    gradient: Tensor
    """(N, 8 · num_levels), with respect to the interpolated features."""


@dataclass(frozen=True)
class Gradients:
    """Losses and gradients of one thread's share of a batch. The next batch overwrites the arrays."""

    losses: dict[str, float]
    """The part of each loss, "sdf" and "intensity", that this share adds to the loss of the whole batch."""
    by_parameters: list[Tensor]
    """Gradients of those parameters that are trained: all features (unless `touched` is given), SDF network,
    intensity network."""
    touched: Touched | None
    """If only the touched features move: the gradient for these."""


@dataclass(frozen=True)
class Share:
    """How the back end of one thread takes part in a batch."""

    dropout_scale: float
    """Factor on the dropout of the configuration."""
    generator: torch.Generator
    """Random numbers of this thread's dropout."""


class GradientBackend(ABC):
    """Losses and gradients of one thread's share of each batch.

    The parameters of `field` must keep their memory: a back end may hold views of them.
    """

    def __init__(self, field: Field, config: FitConfig, share: Share) -> None:
        self._field = field
        self._config = config
        self._share = share
        self._moves_rows = config.moves_rows(field.intensity_network is not None)

    @abstractmethod
    def sdf(self, samples: Samples) -> Gradients:
        """Gradients of the sdf loss with respect to features and SDF network."""

    @abstractmethod
    def joint(self, samples: Samples) -> Gradients:
        """Gradients of the sum of both losses with respect to all parameters."""

    @abstractmethod
    def intensity(self, samples: Samples) -> Gradients:
        """Gradients of the intensity loss with respect to the intensity network. The others are frozen."""

    def state(self) -> dict[str, Tensor]:
        """The state of the random numbers of dropout."""
        return {"generator": self._share.generator.get_state()}

    def restore(self, state: dict[str, Tensor]) -> None:
        """Restores what :meth:`state` gave."""
        self._share.generator.set_state(state["generator"])

    def _num_seen(self, samples: Samples) -> int:
        """Number of samples, the first ones, that the intensity network sees."""
        in_free_space = self._config.training.intensity_in_free_space
        return len(samples.points) if in_free_space else samples.num_labelled

    def _seen_share(self, samples: Samples) -> float:
        """What the mean over them counts in that of the whole batch."""
        return samples.share if self._config.training.intensity_in_free_space else samples.labelled_share

    def _draw_dropouts(self, count: int) -> list[Dropout]:
        """Dropout of each part of the encoding of `count` samples, for the intensity network alone."""
        networks, scale = self._config.networks, self._share.dropout_scale
        shares = [scale * networks.feature_dropout, scale * networks.fourier_dropout]
        if not any(shares):
            return []
        widths = (cells_width(self._config), fourier_width(self._config))
        parts = [part for part in zip(widths, shares, strict=True) if part[0]]
        return [Dropout.draw(count, *part, self._share.generator) for part in parts]
