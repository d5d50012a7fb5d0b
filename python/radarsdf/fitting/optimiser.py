# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Adam (Kingma and Ba, ICLR 2015): for networks on PyTorch's kernel, for features on the rows that a batch touches."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TypeVar

import torch
from torch import Tensor

from radarsdf._core import FEATURE_DIM
from radarsdf.field import kernels
from radarsdf.field.encodings import VertexFeatures
from radarsdf.fitting.gradients import Touched
from radarsdf.threads import Workers

_BETAS = (0.9, 0.999)
_EPSILON = 1e-15  # 3QFP
_Result = TypeVar("_Result")


class Adam:
    """Same bits as ``torch.optim.Adam(fused=True)``.

    Making one of those imports PyTorch's compiler and SymPy, 800 modules in a second: as long as a small fit takes.

    Attributes
    ----------
    parameters : list of Tensor
        What is optimised.
    learning_rate : float
        Of the next step; `full_rate` is the one at the start.
    """

    def __init__(self, parameters: Iterable[Tensor], learning_rate: float) -> None:
        self.parameters = list(parameters)
        self.full_rate = self.learning_rate = learning_rate
        self._means = [torch.zeros_like(p) for p in self.parameters]
        self._squares = [torch.zeros_like(p) for p in self.parameters]
        self._step = torch.zeros(())

    def state(self) -> dict[str, Tensor]:
        """What the next steps depend on beside the parameters. Not copies."""
        lists = {"mean": self._means, "square": self._squares}
        state = {f"{name}.{i}": value for name, values in lists.items() for i, value in enumerate(values)}
        return state | {"step": self._step}

    def restore(self, state: dict[str, Tensor]) -> None:
        """Go on as the optimiser of the same parameters that gave `state`."""
        for name, value in self.state().items():
            value.copy_(state[name])

    @torch.no_grad()
    def step(self, gradients: Sequence[Tensor]) -> None:
        """Move the parameters by their gradients, in the same order."""
        self._step.add_(1)
        torch._fused_adam_(  # the kernel has no public name
            self.parameters,
            list(gradients),
            self._means,
            self._squares,
            [],
            [self._step] * len(self.parameters),
            lr=self.learning_rate,
            beta1=_BETAS[0],
            beta2=_BETAS[1],
            weight_decay=0.0,
            eps=_EPSILON,
            amsgrad=False,
            maximize=False,
        )


class RowAdam:
    """Adam for the features of cells: a step costs the rows that its batch touches, not the map.

    An untouched row's mean and mean square fade as they would with gradients of zero, but it does not move: dense Adam
    would carry on in the direction of its last gradient for some thirty times the learning rate. Measured, that is no
    loss (see BENCHMARK.md).

    Attributes
    ----------
    learning_rate : float
        Of the next step; `full_rate` is the one at the start.
    """

    def __init__(self, cells: VertexFeatures, learning_rate: float) -> None:
        self.full_rate = self.learning_rate = learning_rate
        self.step_count = 0
        self._cells = cells
        rows, dtype = len(cells.features), cells.features.dtype
        self._memory = kernels.AdamMemory(
            moments=kernels.large_zeros(rows, 2 * FEATURE_DIM, dtype=dtype),
            marks=kernels.large_zeros(rows, 2, dtype=torch.int32),
        )
        self._decays = torch.zeros(0, 2, dtype=dtype)

    @property
    def features(self) -> Tensor:
        """What is optimised, (num_rows, 8)."""
        return self._cells.features

    def state(self) -> dict[str, Tensor]:
        """What the next steps depend on beside the features. Not copies."""
        memory = self._memory
        count = torch.tensor(self.step_count)
        return {"moments": memory.moments, "last_step": memory.marks[:, :1], "step_count": count}

    def restore(self, state: dict[str, Tensor]) -> None:
        """Go on as the optimiser of the same features that gave `state`."""
        count, last_step = int(state["step_count"]), state["last_step"]
        if count < 0 or (
            last_step.numel() and not 0 <= int(last_step.min()) <= int(last_step.max()) <= count
        ):
            msg = f"a row cannot have moved after step {count}"  # the core trusts it
            raise ValueError(msg)
        self._memory.moments.copy_(state["moments"])
        self._memory.marks[:, :1].copy_(last_step)
        self.step_count = count

    @torch.no_grad()
    def step(
        self,
        touched: Sequence[Touched],
        workers: Workers,
        meanwhile: Callable[[], _Result],
    ) -> _Result:
        """Move the rows that batches touched.

        The calling thread first does `meanwhile`, whose result it returns, and then its share of what the others left.
        """
        self.step_count += 1
        if self.step_count >= len(self._decays):
            powers = torch.arange(2 * self.step_count + 1022, dtype=torch.float64)[:, None]
            decays = torch.tensor([_BETAS], dtype=torch.float64) ** powers
            # Denormal numbers would be slow, and are nothing beside a gradient.
            self._decays = torch.where(decays < 1e-30, 0.0, decays).to(self._decays.dtype)
        move = kernels.adam_step(
            self._cells.table,
            [(t.points, t.located, t.gradient) for t in touched],
            self._cells.features,
            self._memory,
            self._decays,
            step=self.step_count,
            learning_rate=self.learning_rate,
            epsilon=_EPSILON,
        )

        def work(first: Callable[[], _Result] | None) -> _Result | None:
            result = None if first is None else first()
            move()
            return result

        result, *_ = workers.map(work, [meanwhile] + [None] * (workers.num_threads - 1))
        return result  # type: ignore[return-value]
