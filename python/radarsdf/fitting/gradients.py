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
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import torch
from torch import Tensor

from radarsdf.config.fit_config import FitConfig
from radarsdf.field.field import Field
from radarsdf.field.widths import cells_width, fourier_width
from radarsdf.fitting.sampling import Batch, Dropout
from radarsdf.threads import Workers

_Result = TypeVar("_Result")


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
    """What the dropout of a training is drawn from."""

    scale: float
    """Factor on the dropout of the configuration."""
    generator: torch.Generator
    """Random numbers."""


class GradientBackend(ABC):
    """Losses and gradients of batches.

    The parameters of `field` must keep their memory: a back end may hold views of them. Gradients of a batch's parts are
    added in their order, so the threads of `workers` change no bit.
    """

    def __init__(self, field: Field, config: FitConfig, dropout: RandomDropout, workers: Workers) -> None:
        self._field = field
        self._config = config
        self._dropout = dropout
        self._workers = workers
        self._moves_rows = config.moves_rows(field.intensity_network is not None)

    @abstractmethod
    def num_parts(self, batch_size: int) -> int:
        """The best number of parts of a batch with so many samples."""

    @abstractmethod
    def sdf(self, batch: Batch, meanwhile: Callable[[], _Result]) -> tuple[Gradients, _Result]:
        """Gradients of the sdf loss with respect to features and SDF network, and the result of `meanwhile`.

        The calling thread runs `meanwhile` while others already work on the batch.
        """

    @abstractmethod
    def joint(self, batch: Batch, meanwhile: Callable[[], _Result]) -> tuple[Gradients, _Result]:
        """The same of the sum of both losses with respect to all parameters."""

    @abstractmethod
    def intensity(self, batch: Batch, meanwhile: Callable[[], _Result]) -> tuple[Gradients, _Result]:
        """The same of the intensity loss with respect to the intensity network. The other parameters are frozen."""

    def state(self) -> dict[str, Tensor]:
        """The state of the random numbers of dropout."""
        return {"generator": self._dropout.generator.get_state()}

    def restore(self, state: dict[str, Tensor]) -> None:
        """Restores what :meth:`state` gave."""
        self._dropout.generator.set_state(state["generator"])

    def _draw_dropouts(self) -> list[tuple[int, Dropout]]:
        """Columns and dropout of each part of the encoding, for the intensity network alone."""
        networks, scale = self._config.networks, self._dropout.scale
        shares = [scale * networks.feature_dropout, scale * networks.fourier_dropout]
        if not any(shares):
            return []
        widths = (cells_width(self._config), fourier_width(self._config))
        return [
            (width, Dropout.draw(share, self._dropout.generator))
            for width, share in zip(widths, shares, strict=True)
            if width
        ]
