# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The training loop: the stages sdf and intensity."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NoReturn

import torch
from torch import Tensor
from tqdm import tqdm

from radarsdf.budget.schedule import Schedule
from radarsdf.config.fit_config import FitConfig
from radarsdf.field.field import Field
from radarsdf.fitting.autograd_gradients import AutogradGradients
from radarsdf.fitting.checkpoint import Checkpoint
from radarsdf.fitting.core_gradients import CoreGradients
from radarsdf.fitting.gradients import GradientBackend, Gradients, RandomDropout
from radarsdf.fitting.history import LossHistory
from radarsdf.fitting.optimiser import Adam, Optimiser, RowAdam, Soap
from radarsdf.fitting.sampling import Batch, RaySampler
from radarsdf.fitting.stopping import Diverged, DivergenceWatch
from radarsdf.interrupts import deferred_interrupts
from radarsdf.progress import hides_bar
from radarsdf.returns.intensities import IntensityScale
from radarsdf.returns.rays import Rays
from radarsdf.threads import Workers

_OPTIMISERS: dict[str, type[Optimiser]] = {"adam": Adam, "soap": Soap}
_GENERATORS = 2  # random generators of a fit: for samples, for dropout
_CHECK_EVERY = 100  # iterations. To check and copy all parameters in each would take a tenth of its time


class _Draws:
    """Draws the batches of both stages: first from the `surface`, then from all `returns` if those are others.

    Ghosts are not part of the surface, but the sensor will see them again, so their intensities are learnt. A sampler has
    its own copy of the rays: there is one at a time.
    """

    def __init__(
        self,
        surface: Rays,
        returns: Rays | None,
        sampler: Callable[[Rays, torch.Generator], RaySampler],
        generator: torch.Generator,
    ) -> None:
        self._generator = generator
        self._returns = returns
        """None: those of the surface, or all already."""
        self._make = sampler
        self.sampler = sampler(surface, generator)

    def turn_to_returns(self) -> None:
        """Draw from all returns from now on."""
        if self._returns is not None:
            del self.sampler
            self.sampler, self._returns = self._make(self._returns, self._generator), None

    def state(self) -> dict[str, Tensor]:
        """All that the next batches depend on."""
        turned = torch.tensor(self._returns is None, dtype=torch.int64, device="cpu")
        return self.sampler.state() | {"turned": turned, "generator": self._generator.get_state()}

    def restore(self, state: dict[str, Tensor]) -> None:
        """Restore what :meth:`state` of the same fit gave."""
        if state["turned"]:
            self.turn_to_returns()
        self.sampler.restore(state)
        self._generator.set_state(state["generator"])  # last, because the sampler changes it


@dataclass(frozen=True)
class _Pauses:
    """What is updated or asked between iterations."""

    bar: Any
    """Progress bar of tqdm."""
    interrupted: Callable[[], bool]
    """Tells whether Ctrl-C was pressed."""
    checkpoint: Checkpoint | None


@dataclass(frozen=True)
class _Stage:
    """A stage of the training."""

    name: str
    """ "sdf" or "intensity"."""
    iterations: int
    """Number of iterations of this stage."""
    iterations_before: int
    """Joint iterations of the sdf stage that count as iterations of this stage too."""
    counts: tuple[str, ...]
    """The stages that an iteration counts for. Joint iterations count for both."""
    optimisers: list[Optimiser]
    """Of the parameters that are trained, in the order of their gradients."""
    rows: RowAdam | None
    """Optimiser of the features if only the touched ones move."""
    draw: Callable[[], Batch]
    """Draws a batch."""
    gradients_of: Callable[[Batch, Callable[[], Batch | None]], tuple[Gradients, Batch | None]]
    """Computes losses and gradients of a batch, and the result of what it runs meanwhile."""


class Training:
    """Trains `field` in place: the sdf stage on `surface`, then the intensity stage on all `returns`.

    Without a `scale` there are no intensities.
    """

    def __init__(
        self,
        field: Field,
        surface: Rays,
        returns: Rays,
        scale: IntensityScale | None,
        schedule: Schedule,
        config: FitConfig,
        workers: Workers,
    ) -> None:
        self._field = field
        self._schedule = schedule
        self._config = config
        self._workers = workers
        self.iterations = schedule.iterations
        self._backend = _backend(field, config, schedule, workers)
        self._draws: _Draws | None = None  # not made without iterations, because it sorts the returns
        if any(self.iterations.values()):

            def sampler(rays: Rays, generator: torch.Generator) -> RaySampler:
                unit = None
                if scale is not None and rays.intensities is not None:
                    unit = torch.from_numpy(scale.to_unit(rays.intensities))
                size, neighbours = schedule.batch_size, schedule.neighbours
                return RaySampler(rays, config, size, generator, neighbours, unit, workers.num_threads)

            others = None if returns is surface or scale is None else returns
            generator = torch.Generator("cpu").manual_seed(config.seed * _GENERATORS)
            self._draws = _Draws(surface, others, sampler, generator)
        self.iterations_done = {"sdf": 0, "intensity": 0}
        self.losses: dict[str, float] = {}
        self.history = LossHistory(self.iterations)
        self._watch = DivergenceWatch(config)
        self._rows = None
        self._optimisers: dict[str, Optimiser] = {}
        rate, of_network = config.training.learning_rate, _OPTIMISERS[config.training.optimiser]
        if config.moves_rows(scale is not None):
            self._rows = RowAdam(field.cells, rate)
        else:
            self._optimisers["features"] = Adam(field.cells.parameters(), rate)
        self._optimisers["sdf"] = of_network(field.sdf_network.parameters(), rate)
        if field.intensity_network is not None:
            self._optimisers["intensity"] = of_network(
                field.intensity_network.parameters(), config.training.intensity_learning_rate
            )

    def state(self) -> dict[str, Tensor]:
        """All that the rest of the training depends on, between two iterations. Tensors are not copied."""
        losses = [self.losses.get(name, 0.0) for name in self.iterations_done]
        state = {
            "done": torch.tensor(list(self.iterations_done.values()), dtype=torch.int64, device="cpu"),
            "losses": torch.tensor(losses, dtype=torch.float64, device="cpu"),
            "watch": self._watch.state(),
        }
        state |= {f"history.{name}": spans for name, spans in self.history.state().items()}
        state |= {f"field.{name}": p.detach() for name, p in self._field.named_parameters()}
        for name, optimiser in self._optimisers.items():
            state |= {f"optimiser.{name}.{k}": v for k, v in optimiser.state().items()}
        if self._rows is not None:
            state |= {f"rows.{k}": v for k, v in self._rows.state().items()}
        if self._draws is not None:
            state |= {f"draws.{k}": v for k, v in self._draws.state().items()}
        return state | {f"backend.{k}": v for k, v in self._backend.state().items()}

    def restore(self, state: dict[str, Tensor]) -> None:
        """Restores what :meth:`state` of the same fit gave. Raises a ValueError if it is impossible."""
        done = dict(zip(self.iterations_done, state["done"].tolist(), strict=True))
        if not all(0 <= done[name] <= self.iterations[name] for name in done):
            msg = f"{done} iterations of {self.iterations}"
            raise ValueError(msg)
        self.iterations_done.update(done)
        losses = zip(done, state["losses"].tolist(), strict=True)
        self.losses.update({name: loss for name, loss in losses if done[name]})
        self.history.restore(_part(state, "history"))
        self._watch.restore(state["watch"])
        for name, parameter in self._field.named_parameters():
            parameter.data.copy_(state[f"field.{name}"])
        for name, optimiser in self._optimisers.items():
            optimiser.restore(_part(state, f"optimiser.{name}"))
        if self._rows is not None:
            self._rows.restore(_part(state, "rows"))
        if self._draws is not None:
            self._draws.restore(_part(state, "draws"))
        self._backend.restore(_part(state, "backend"))

    def report(self) -> dict[str, Any]:
        """What the map's report says of the training."""
        return {
            "iterations": self.iterations,
            "iterations_done": self.iterations_done,
            "losses": self.losses,
            "loss_history": self.history.to_report(),
        }

    def run(self, progress: bool | None, checkpoint: Checkpoint | None = None) -> None:
        """Runs all iterations that are left.

        Raises
        ------
        Diverged
            If a loss or a parameter is not finite, or a loss is worse than any answer of the right size. The
            field then has the last parameters that were checked and good.
        KeyboardInterrupt
            After Ctrl-C, between two iterations.
        """
        field = self._field
        stages = self._stages()
        self.history.start()
        with (
            tqdm(
                total=sum(stage.iterations for stage in stages),
                initial=sum(self._done(stage) for stage in stages),
                desc="fit",
                unit="it",
                disable=hides_bar(progress),
            ) as bar,
            deferred_interrupts() as interrupted,
        ):
            pauses = _Pauses(bar, interrupted, checkpoint)
            for stage in stages:
                if stage.name == "intensity":
                    field.cells.requires_grad_(False)
                    field.sdf_network.requires_grad_(False)
                self._run_stage(stage, pauses)
            if checkpoint is not None:
                checkpoint.write(self.state())
            if interrupted():  # the training is done, but the program that called the fit should stop too
                raise KeyboardInterrupt

    def _stages(self) -> list[_Stage]:
        """The sdf stage, then the intensity stage, as far as they have iterations."""
        stages: list[_Stage] = []
        sdf_iterations, intensity_iterations = self.iterations["sdf"], self.iterations["intensity"]
        of_surface = [o for name, o in self._optimisers.items() if name != "intensity"]
        of_intensity = [o for name, o in self._optimisers.items() if name == "intensity"]
        joint = sdf_iterations if of_intensity and self._config.training.joint else 0
        if sdf_iterations:
            stages.append(
                _Stage(
                    name="sdf",
                    iterations=sdf_iterations,
                    iterations_before=0,
                    counts=("sdf", "intensity") if joint else ("sdf",),
                    optimisers=of_surface + of_intensity if joint else of_surface,
                    rows=self._rows,
                    draw=self._batch,
                    gradients_of=self._backend.joint if joint else self._backend.sdf,
                )
            )
        if of_intensity and intensity_iterations > joint:
            stages.append(
                _Stage(
                    name="intensity",
                    iterations=intensity_iterations - joint,
                    iterations_before=joint,
                    counts=("intensity",),
                    optimisers=of_intensity,
                    rows=None,
                    draw=self._labelled_batch,
                    gradients_of=self._backend.intensity,
                )
            )
        return stages

    def _batch(self) -> Batch:
        """A batch of the sdf stage."""
        assert self._draws is not None
        return self._draws.sampler.batch(self._backend.num_parts(self._schedule.batch_size))

    def _labelled_batch(self) -> Batch:
        """A batch of the intensity stage, after the last one of the sdf stage."""
        assert self._draws is not None
        self._draws.turn_to_returns()
        if self._config.training.intensity_in_free_space:
            return self._batch()
        count = self._schedule.intensity_batch_size
        return self._draws.sampler.spread(count, self._backend.num_parts(count))

    def _done(self, stage: _Stage) -> int:
        """Iterations of this stage that are done, without joint ones of an earlier stage."""
        return max(0, self.iterations_done[stage.name] - stage.iterations_before)

    def _run_stage(self, stage: _Stage, pauses: _Pauses) -> None:
        rows, iterations = stage.rows, stage.iterations
        parameters = [p for optimiser in stage.optimisers for p in optimiser.parameters]
        changing = [*parameters, *([] if rows is None else [rows.features])]
        good = [p.detach().clone() for p in changing]

        def give_up(fault: str) -> NoReturn:
            for parameter, value in zip(changing, good, strict=True):
                parameter.data.copy_(value)
            msg = f"{fault} at iteration {i} of {iterations} of the {stage.name} stage: a lower learning rate may help"
            raise Diverged(msg)

        ahead: Batch | None = None
        for i in range(self._done(stage), iterations):
            # Each stage starts at the full learning rate, also for an optimiser that an earlier stage has
            # used.
            cosine = 0.5 * (1 + math.cos(math.pi * i / iterations))
            share = cosine if self._config.training.cosine_schedule else 1.0
            stop = pauses.interrupted()
            write = pauses.checkpoint is not None and (stop or pauses.checkpoint.due())
            judge = i % _CHECK_EVERY == _CHECK_EVERY - 1 or i == iterations - 1
            look = stop or write or judge
            # No samples are drawn ahead before the state is written: it would contain the draw after the
            # next.
            batch = ahead or stage.draw()
            found, ahead = stage.gradients_of(batch, _nothing if look else stage.draw)
            loss = sum(found.losses.values())
            if not math.isfinite(loss):
                give_up(f"the {_bad_losses(found)} loss is {loss}")
            move_networks = functools.partial(_move_networks, found, stage.optimisers, share)
            if rows is None:
                move_networks()
            else:
                rows.learning_rate = share * rows.full_rate
                rows.step(found.touched or [], self._workers, meanwhile=move_networks)
            self.losses[stage.name] = loss
            for name in stage.counts:
                before = stage.iterations_before if name == stage.name else 0
                self.iterations_done[name] = min(before + i + 1, self.iterations[name])
            self.history.add(found.losses, self.iterations_done)
            self._watch.add(found.losses, batch.sdf_m)
            del (
                batch,
                found,
                move_networks,
            )  # gradients of all features are as large as these: not two at once
            pauses.bar.set_postfix_str(f"{stage.name} loss {loss:.3g}", refresh=False)
            pauses.bar.update()
            if look:
                # A sum is finite only if all numbers are. A sum that overflows is no better.
                if not all(math.isfinite(float(p.detach().sum())) for p in changing):
                    give_up("a parameter is not finite")
                if judge and (fault := self._watch.fault()):
                    give_up(fault)
                for parameter, value in zip(changing, good, strict=True):
                    value.copy_(parameter.detach())
            if write and pauses.checkpoint is not None:
                pauses.checkpoint.write(self.state())
            if stop:
                raise KeyboardInterrupt


def _backend(field: Field, config: FitConfig, schedule: Schedule, workers: Workers) -> GradientBackend:
    in_core = config.differentiates_in_core(field.intensity_network is not None)
    kind = CoreGradients if in_core else AutogradGradients
    generator = torch.Generator("cpu").manual_seed(config.seed * _GENERATORS + 1)
    return kind(field, config, RandomDropout(schedule.dropout_scale, generator), workers)


def _bad_losses(found: Gradients) -> str:
    """Names of the losses that are not finite."""
    return " and ".join(sorted(name for name, value in found.losses.items() if not math.isfinite(value)))


def _move_networks(found: Gradients, optimisers: Sequence[Optimiser], share: float) -> None:
    """Changes the networks by the gradients."""
    total = iter(found.by_parameters)
    for optimiser in optimisers:
        optimiser.learning_rate = share * optimiser.full_rate
        optimiser.step(list(itertools.islice(total, len(optimiser.parameters))))


def _nothing() -> None:
    """Is done meanwhile where no samples are drawn ahead."""


def _part(state: dict[str, Tensor], name: str) -> dict[str, Tensor]:
    """The entries of `state` whose names begin with `name` and a dot, named without that."""
    return {k.removeprefix(f"{name}."): v for k, v in state.items() if k.startswith(f"{name}.")}
