# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Adam (Kingma and Ba, ICLR 2015), on PyTorch's kernel but without its optimiser classes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import torch
from torch import Tensor

_BETAS = (0.9, 0.999)


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

    def __init__(self, parameters: Iterable[Tensor], learning_rate: float, epsilon: float) -> None:
        self.parameters = list(parameters)
        self.full_rate = self.learning_rate = learning_rate
        self._epsilon = epsilon
        self._means = [torch.zeros_like(p) for p in self.parameters]
        self._squares = [torch.zeros_like(p) for p in self.parameters]
        self._steps = [torch.zeros(()) for _ in self.parameters]

    def state(self) -> dict[str, Tensor]:
        """What the next steps depend on beside the parameters. Not copies."""
        lists = {"mean": self._means, "square": self._squares, "steps": self._steps}
        return {f"{name}.{i}": value for name, values in lists.items() for i, value in enumerate(values)}

    def restore(self, state: dict[str, Tensor]) -> None:
        """Go on as the optimiser of the same parameters that gave `state`."""
        for name, value in self.state().items():
            value.copy_(state[name])

    @torch.no_grad()
    def step(self, gradients: Sequence[Tensor]) -> None:
        """Move the parameters by their gradients, in the same order."""
        for count in self._steps:
            count.add_(1)
        torch._fused_adam_(  # the kernel has no public name
            self.parameters,
            list(gradients),
            self._means,
            self._squares,
            [],
            self._steps,
            lr=self.learning_rate,
            beta1=_BETAS[0],
            beta2=_BETAS[1],
            weight_decay=0.0,
            eps=self._epsilon,
            amsgrad=False,
            maximize=False,
        )
