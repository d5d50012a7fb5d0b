# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Exceptions of a fit that ends early, which carry the map so far, and what tells that a training has diverged."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from radarsdf.config.fit_config import FitConfig
from radarsdf.map.radar_map import RadarMap

_KEPT = 0.99  # of the sums, in each iteration: they are of about the last hundred
_WORST = {
    "sdf": "more than if all distances had the wrong sign",
    "intensity": "more than the whole range of intensities",
}


class Interrupted(KeyboardInterrupt):
    """Ctrl-C during a fit.

    Attributes
    ----------
    radar_map : RadarMap or None
        The map so far, which can be used like any other. None if the training had not begun. In its
        ``report``, ``iterations_done`` is less than ``iterations``.
    """

    def __init__(self, radar_map: RadarMap | None = None) -> None:
        super().__init__("interrupted while training" if radar_map else "interrupted before the training")
        self.radar_map = radar_map


class Diverged(FloatingPointError):
    """A loss or a parameter is not finite, or a loss is worse than any answer of the right size.

    The message names it, the stage and the iteration.

    Attributes
    ----------
    radar_map : RadarMap or None
        The last state that was checked and good, at most 100 iterations before.
    """

    radar_map: RadarMap | None = None


class DivergenceWatch:
    """Compares the losses of a training with those of the worst answers of the right size.

    Distances with the wrong sign have a cross-entropy of less than 1 + distance / sigma, and intensities from 0 to 1 an
    absolute error of at most 1. Where losses are larger, the answers are far from all that was asked for. Their means
    over about a hundred iterations decide, since trainings get over a few bad ones.
    """

    def __init__(self, config: FitConfig) -> None:
        self._sigma_m, self._joint_weight = config.sigma_m, config.training.sdf_loss_weight
        # A row for each loss: iterations, their losses, and those of the worst answers.
        self._sums = np.zeros((len(_WORST), 3))

    def add(self, losses: Mapping[str, float], sdf_m: Tensor) -> None:
        """The losses of an iteration whose samples have these signed distances (B,), m."""
        of_sdf = 1 + float(sdf_m.abs().mean()) / self._sigma_m
        worst = {"sdf": of_sdf * (self._joint_weight if len(losses) > 1 else 1), "intensity": 1.0}
        self._sums *= _KEPT
        for row, name in enumerate(_WORST):
            if name in losses:
                self._sums[row] += (1, losses[name], worst[name])

    def fault(self) -> str | None:
        """What is wrong with the losses so far. None: nothing."""
        for (count, loss, worst), (name, words) in zip(self._sums, _WORST.items(), strict=True):
            if loss > worst:
                return f"the {name} loss is {loss / count:.3g}, {words},"
        return None

    def state(self) -> Tensor:
        """For a checkpoint. Not copied."""
        return torch.from_numpy(self._sums)

    def restore(self, state: Tensor) -> None:
        """Restores what :meth:`state` of the same fit gave."""
        self._sums[:] = state.numpy()
