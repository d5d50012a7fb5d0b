"""Optimisers: Adam (Kingma and Ba, ICLR 2015) by PyTorch, sparse Adam for touched feature rows, SOAP for networks."""

from collections.abc import Callable, Iterable, Sequence
from itertools import compress
from typing import Any

import torch
from torch import Tensor

from radarsdf import _core
from radarsdf.checks import check
from radarsdf.field.field import VertexFeatures
from radarsdf.field.kernels import large_zeros, view
from radarsdf.fitting.gradients import Touched
from radarsdf.threads import ThreadPool

_BETAS = (0.9, 0.999)
_EPSILON = 1e-15  # 3QFP
# Numbers in the state of a row of features, see the core's ``begin_adam_step``, and position of its last step.
_STATE_DIM, _LAST_STEP = 8, 5


class Adam:
    """Adam, bit-identical to ``torch.optim.Adam(fused=True)``.

    That class imports PyTorch's compiler and SymPy: 800 modules, which take a second, as long as a small fit.
    """

    def __init__(self, parameters: Iterable[Tensor], learning_rate: float) -> None:
        self.parameters, self.learning_rate = list(parameters), learning_rate
        self._means = [torch.zeros_like(p) for p in self.parameters]
        self._squares = [torch.zeros_like(p) for p in self.parameters]

    def state(self) -> dict[str, Tensor]:
        """Return all that the next steps depend on, except the parameters, without copying."""
        lists = {"mean": self._means, "square": self._squares}
        return {f"{name}.{i}": value for name, values in lists.items() for i, value in enumerate(values)}

    @torch.no_grad()
    def step(self, gradients: Sequence[Tensor], number: int, share: float, pool: ThreadPool | None) -> None:  # noqa: ARG002
        """Take step `number`, from 1 on, by a `share` of the learning rate, on the threads of `pool` if it is idle."""
        steps = [torch.tensor(number, dtype=torch.float32, device="cpu")] * len(self.parameters)
        of_each = self.parameters, list(gradients), self._means, self._squares, list[Tensor](), steps
        rates = {"lr": share * self.learning_rate, "beta1": _BETAS[0], "beta2": _BETAS[1], "eps": _EPSILON}
        step: Any = torch._fused_adam_  # the kernel has no public name
        step(*of_each, **rates, weight_decay=0.0, amsgrad=False, maximize=False)


class Soap:
    """SOAP (Vyas et al., ICLR 2025) for weight matrices, and :class:`Adam` for the other parameters of a network.

    Adam scales each component of a gradient by itself, although the inputs of a layer are correlated. SOAP does so in a
    basis in which they hardly are. Measured: a network learns as much in a quarter to half of Adam's steps.
    """

    def __init__(self, parameters: Iterable[Tensor], learning_rate: float) -> None:
        self.parameters, self.learning_rate = list(parameters), learning_rate
        # A layer with one output has a weight vector: there is no basis to rotate.
        self._are_matrices = [p.ndim == 2 and min(p.shape) > 1 for p in self.parameters]
        self._are_others = [not is_matrix for is_matrix in self._are_matrices]
        self._adam = Adam(compress(self.parameters, self._are_others), learning_rate)
        matrices = list(compress(self.parameters, self._are_matrices))
        self._weights = [view(p) for p in matrices]
        self._memories = [p.new_zeros(_core.soap_memory_size(*p.shape)) for p in matrices]

    def state(self) -> dict[str, Tensor]:
        state = {f"memory.{i}": memory for i, memory in enumerate(self._memories)}
        return state | {f"adam.{k}": v for k, v in self._adam.state().items()}

    def step(self, gradients: Sequence[Tensor], number: int, share: float, pool: ThreadPool | None) -> None:
        self._adam.step(list(compress(gradients, self._are_others)), number, share, None)
        _core.soap_step(
            weights=self._weights,
            gradients=[g.numpy() for g in compress(gradients, self._are_matrices)],
            memories=[memory.numpy() for memory in self._memories],
            step=number,
            learning_rate=share * self.learning_rate,
            pool=None if pool is None else pool.core_threads,
        )


Optimiser = Adam | Soap


class RowAdam:
    """Sparse Adam for the features of cells. The cost of a step is proportional to the touched rows, not to the map.

    The moments of an untouched row decay as with a gradient of zero, but the row does not change. Adam would continue to
    move it along its last gradient, by up to thirty times the learning rate. Measured: the surface is as good without that,
    and a fit of `hugin` takes 4.2 s instead of 5.2. The features of a row share one mean square.
    """

    def __init__(self, cells: VertexFeatures, learning_rate: float) -> None:
        self._cells, self._learning_rate = cells, learning_rate
        self._states = large_zeros(len(cells.features), _STATE_DIM, dtype=torch.int32)
        self._arrays = view(cells.features), self._states.numpy()
        self._decays = torch.zeros(0, 2, dtype=torch.float32, device="cpu")

    def state(self) -> dict[str, Tensor]:
        return {"states": self._states}

    def check_state(self, steps: int) -> None:
        """Raise a ValueError if a row has moved after `steps`, which the core does not check."""
        last_step = self._states.numpy()[:, _LAST_STEP]
        fits = 0 <= last_step.min(initial=0) <= last_step.max(initial=0) <= steps
        check(fits, f"a row cannot have moved after step {steps}")
        self._states[:, _LAST_STEP + 1 :] = 0  # the core indexes by the next number

    @torch.no_grad()
    def step(
        self, touched: Touched, number: int, share: float, pool: ThreadPool, meanwhile: Callable[[], None]
    ) -> None:
        """Update the rows touched by a batch. The calling thread first runs `meanwhile`, then helps the others."""
        if number >= len(self._decays):
            powers = torch.arange(2 * number + 1022, dtype=torch.float64, device="cpu")[:, None]
            decays = torch.tensor([_BETAS], dtype=torch.float64, device="cpu") ** powers
            # Denormal numbers would be slow, and are negligible compared with a gradient.
            self._decays = torch.where(decays < 1e-30, 0.0, decays).to(self._decays.dtype)
        of_batch = touched.points, touched.located, touched.gradient
        rates = number, share * self._learning_rate, _EPSILON
        self._cells.table.begin_adam_step(
            *of_batch, *self._arrays, self._decays.numpy(), *rates, pool.core_threads
        )
        try:
            meanwhile()
        finally:
            pool.core_threads.finish()
