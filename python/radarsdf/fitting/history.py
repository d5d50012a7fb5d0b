# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""How the losses fell: their mean in each of some equal spans of the iterations."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

_MOST_SPANS = 200  # of each loss: enough for a plot, little in the file of a map


class LossHistory:
    """The losses of a training.

    Parameters
    ----------
    iterations
        Iterations that will be done for each loss, "sdf" and "intensity".
    """

    def __init__(self, iterations: Mapping[str, int]) -> None:
        self._iterations = dict(iterations)
        # A row for each span: iterations done, sum of their losses, seconds of training at their end.
        self._spans: dict[str, NDArray[np.float64]] = {
            name: np.zeros((min(count, _MOST_SPANS), 3)) for name, count in iterations.items()
        }
        self._started_s = time.perf_counter()

    def start(self) -> None:
        """The training begins, or goes on."""
        before_s = max((float(spans[:, 2].max(initial=0.0)) for spans in self._spans.values()), default=0.0)
        self._started_s = time.perf_counter() - before_s

    def add(self, losses: Mapping[str, float], done: Mapping[str, int]) -> None:
        """Add the losses of an iteration, after which so many are `done` for each loss."""
        now_s = time.perf_counter() - self._started_s
        for name, loss in losses.items():
            spans = self._spans[name]
            span = spans[(done[name] - 1) * len(spans) // self._iterations[name]]
            span += (1, loss, 0)
            span[2] = now_s

    def to_report(self) -> dict[str, dict[str, list[Any]]]:
        """Of each loss, for each span: the iterations that were done at its end, the mean loss, the seconds of training."""
        found = {}
        for name, spans in self._spans.items():
            begun = spans[spans[:, 0] > 0]
            if len(begun):
                found[name] = {
                    "iterations": np.cumsum(begun[:, 0]).astype(int).tolist(),
                    "losses": (begun[:, 1] / begun[:, 0]).tolist(),
                    "seconds": begun[:, 2].tolist(),
                }
        return found

    def state(self) -> dict[str, Tensor]:
        """For a checkpoint. Not copied."""
        return {name: torch.from_numpy(spans) for name, spans in self._spans.items()}

    def restore(self, state: dict[str, Tensor]) -> None:
        """Restores what :meth:`state` of the same fit gave."""
        for name, spans in self._spans.items():
            spans[:] = state[name].numpy()
