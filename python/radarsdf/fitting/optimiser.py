"""Optimisers: Adam (Kingma and Ba, ICLR 2015) by PyTorch, sparse Adam for touched feature rows, SOAP for networks."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import torch
from torch import Tensor

from radarsdf import _core
from radarsdf.checks import check
from radarsdf.field.kernels import large_zeros, view
from radarsdf.field.neural_field import VertexFeatures
from radarsdf.fitting.gradients import Touched
from radarsdf.threads import ThreadPool

_BETAS = (0.9, 0.999)
_EPSILON = 1e-15  # 3QFP
# Numbers in the state of a row of features, see the core's ``begin_adam_step``, and position of its last step.
_STATE_DIM, _LAST_STEP = 8, 5


class Optimiser(ABC):
    """Base class. `learning_rate` applies to the next step, `full_rate` is the initial one.

    The method `state` returns all that the next steps depend on, except the parameters, without copying.
    """

    def __init__(self, parameters: Iterable[Tensor], learning_rate: float) -> None:
        self.parameters = list(parameters)
        self.full_rate = self.learning_rate = learning_rate

    @abstractmethod
    def step(self, gradients: Sequence[Tensor], pool: ThreadPool | None = None) -> None:
        """Update the parameters by `gradients`, in the same order, on the threads of `pool` if it is idle."""


class Adam(Optimiser):
    """Adam, bit-identical to ``torch.optim.Adam(fused=True)``.

    That class imports PyTorch's compiler and SymPy: 800 modules, which take a second, as long as a small fit.
    """

    def __init__(self, parameters: Iterable[Tensor], learning_rate: float) -> None:
        super().__init__(parameters, learning_rate)
        self._means = [torch.zeros_like(p) for p in self.parameters]
        self._squares = [torch.zeros_like(p) for p in self.parameters]
        self._step = torch.zeros((), dtype=torch.float32, device="cpu")

    def state(self) -> dict[str, Tensor]:
        lists = {"mean": self._means, "square": self._squares}
        state = {f"{name}.{i}": value for name, values in lists.items() for i, value in enumerate(values)}
        return state | {"step": self._step}

    def restore(self, state: dict[str, Tensor]) -> None:
        for name, value in self.state().items():
            value.copy_(state[name])

    @torch.no_grad()
    def step(self, gradients: Sequence[Tensor], pool: ThreadPool | None = None) -> None:  # noqa: ARG002
        self._step.add_(1)
        steps, (beta1, beta2) = [self._step] * len(self.parameters), _BETAS
        of_each = self.parameters, list(gradients), self._means, self._squares, list[Tensor](), steps
        rates = {"lr": self.learning_rate, "beta1": beta1, "beta2": beta2, "eps": _EPSILON}
        step: Any = torch._fused_adam_  # the kernel has no public name
        step(*of_each, **rates, weight_decay=0.0, amsgrad=False, maximize=False)


class Soap(Optimiser):
    """SOAP (Vyas et al., ICLR 2025) for weight matrices, and :class:`Adam` for the other parameters of a network.

    Adam scales each component of a gradient by itself, although the inputs of a layer are correlated. SOAP does so in a
    basis in which they hardly are. Measured: a network learns as much in a quarter to half of Adam's steps.
    """

    def __init__(self, parameters: Iterable[Tensor], learning_rate: float) -> None:
        super().__init__(parameters, learning_rate)
        self.step_count = 0
        # A layer with one output has a weight vector: there is no basis to rotate.
        self._matrices = [i for i, p in enumerate(self.parameters) if p.ndim == 2 and min(p.shape) > 1]
        self._others = [i for i in range(len(self.parameters)) if i not in self._matrices]
        self._adam = Adam(_at(self._others, self.parameters), learning_rate)
        matrices = _at(self._matrices, self.parameters)
        self._weights = [view(p) for p in matrices]
        self._memories = [p.new_zeros(_core.soap_memory_size(*p.shape)) for p in matrices]
        self._memory_views = [memory.numpy() for memory in self._memories]

    def state(self) -> dict[str, Tensor]:
        state = {f"memory.{i}": memory for i, memory in enumerate(self._memories)}
        count = torch.tensor(self.step_count, dtype=torch.int64, device="cpu")
        return state | {f"adam.{k}": v for k, v in self._adam.state().items()} | {"step_count": count}

    def restore(self, state: dict[str, Tensor]) -> None:
        count = int(state["step_count"])
        check(count >= 0, f"an optimiser cannot have made {count} steps")
        for i, memory in enumerate(self._memories):
            memory.copy_(state[f"memory.{i}"])
        self._adam.restore({k: state[f"adam.{k}"] for k in self._adam.state()})
        self.step_count = count

    def step(self, gradients: Sequence[Tensor], pool: ThreadPool | None = None) -> None:
        self.step_count += 1
        self._adam.learning_rate = self.learning_rate
        self._adam.step(_at(self._others, gradients))
        _core.soap_step(
            weights=self._weights,
            gradients=[g.numpy() for g in _at(self._matrices, gradients)],
            memories=self._memory_views,
            step=self.step_count,
            learning_rate=self.learning_rate,
            pool=None if pool is None else pool.core_threads,
        )


def _at(places: Sequence[int], tensors: Sequence[Tensor]) -> list[Tensor]:
    return [tensors[i] for i in places]


class RowAdam:
    """Sparse Adam for the features of cells. The cost of a step is proportional to the touched rows, not to the map.

    The moments of an untouched row decay as with a gradient of zero, but the row does not change. Adam would continue to
    move it along its last gradient, by up to thirty times the learning rate. Measured: the surface is as good without that,
    and a fit of `hugin` takes 4.2 s instead of 5.2. The features of a row share one mean square.
    """

    def __init__(self, cells: VertexFeatures, learning_rate: float) -> None:
        self.full_rate = self.learning_rate = learning_rate
        self.step_count = 0
        self._cells = cells
        self._states = large_zeros(len(cells.features), _STATE_DIM, dtype=torch.int32)
        self._arrays = view(cells.features), self._states.numpy()
        self._decays = torch.zeros(0, 2, dtype=torch.float32, device="cpu")

    def state(self) -> dict[str, Tensor]:
        count = torch.tensor(self.step_count, dtype=torch.int64, device="cpu")
        return {"states": self._states, "step_count": count}

    def restore(self, state: dict[str, Tensor]) -> None:
        count, last_step = int(state["step_count"]), state["states"][:, _LAST_STEP]
        first, last = (int(last_step.min()), int(last_step.max())) if last_step.numel() else (0, 0)
        # The core does not check it.
        check(0 <= first <= last <= count, f"a row cannot have moved after step {count}")
        self._states.copy_(state["states"])
        self._states[:, _LAST_STEP + 1 :] = 0  # the core indexes by the next number
        self.step_count = count

    @torch.no_grad()
    def step(self, touched: Touched, pool: ThreadPool, meanwhile: Callable[[], None]) -> None:
        """Update the rows touched by a batch. The calling thread first runs `meanwhile`, then helps the others."""
        self.step_count += 1
        if self.step_count >= len(self._decays):
            powers = torch.arange(2 * self.step_count + 1022, dtype=torch.float64, device="cpu")[:, None]
            decays = torch.tensor([_BETAS], dtype=torch.float64, device="cpu") ** powers
            # Denormal numbers would be slow, and are negligible compared with a gradient.
            self._decays = torch.where(decays < 1e-30, 0.0, decays).to(self._decays.dtype)
        of_batch = touched.points, touched.located, touched.gradient
        rates = self.step_count, self.learning_rate, _EPSILON
        self._cells.table.begin_adam_step(
            *of_batch, *self._arrays, self._decays.numpy(), *rates, pool.core_threads
        )
        try:
            meanwhile()
        finally:
            pool.core_threads.finish()
