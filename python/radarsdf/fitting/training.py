# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The training loop: the stages sdf and intensity, with batches split over threads."""

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
from radarsdf.config import MAX_THREADS, FitConfig
from radarsdf.field.field import Field
from radarsdf.field.intensity_scale import IntensityScale
from radarsdf.fitting.autograd_gradients import AutogradGradients
from radarsdf.fitting.checkpoint import Checkpoint
from radarsdf.fitting.core_gradients import CoreGradients
from radarsdf.fitting.gradients import GradientBackend, Gradients, Share
from radarsdf.fitting.history import LossHistory
from radarsdf.fitting.optimiser import Adam, RowAdam
from radarsdf.fitting.sampling import RaySampler, Samples
from radarsdf.fitting.stopping import Diverged
from radarsdf.interrupts import deferred_interrupts
from radarsdf.progress import hides_bar
from radarsdf.returns.rays import Rays
from radarsdf.threads import Workers

# Random generators of a fit: one for samples, one for the dropout of each thread.
_GENERATORS = MAX_THREADS + 1
# Samples in a part of a batch of the intensity stage. With less work, threads wait for the interpreter's lock longer than
# they save: an iteration of 1024 samples took 2.0 ms on two threads, and 1.6 on one.
_LEAST_PART = 1024
_CHECK_EVERY = 100  # iterations. To check and copy all parameters in each would take a tenth of its time


class _Draws:
    """Draws the samples of all threads in one: in several, small operations would wait for each other."""

    def __init__(
        self,
        surface: Rays,
        returns: Rays,
        scale: IntensityScale | None,
        config: FitConfig,
        schedule: Schedule,
        parts: int,
    ) -> None:
        self._config = config
        self._parts = parts
        self._generator = torch.Generator("cpu").manual_seed(config.seed * _GENERATORS)

        def sampler(rays: Rays) -> RaySampler:
            unit = None
            if scale is not None and rays.intensities is not None:
                unit = torch.from_numpy(scale.to_unit(rays.intensities))
            return RaySampler(rays, config, schedule.batch_size, self._generator, schedule.neighbours, unit)

        self._surface = sampler(surface)
        # Ghosts are not part of the surface, but the sensor will see them again, so their intensities are
        # learnt.
        self._returns = self._surface if returns is surface or scale is None else sampler(returns)

    def state(self) -> dict[str, Tensor]:
        """All that the next batches depend on."""
        samplers = self._samplers()
        state = {f"{name}.{k}": v for name, sampler in samplers.items() for k, v in sampler.state().items()}
        return state | {"generator": self._generator.get_state()}

    def restore(self, state: dict[str, Tensor]) -> None:
        for name, sampler in self._samplers().items():
            sampler.restore(_part(state, name))
        self._generator.set_state(state["generator"])  # last, because the samplers change it

    def _samplers(self) -> dict[str, RaySampler]:
        samplers = {"surface": self._surface}
        return samplers if self._returns is self._surface else samplers | {"returns": self._returns}

    def of_surface(self) -> list[Samples]:
        """A batch of the sdf stage, in a part for each thread."""
        return self._surface.batch(self._parts)

    def of_returns(self) -> list[Samples]:
        """A batch of the intensity stage, in a part for each thread, or for fewer."""
        if self._config.training.intensity_in_free_space:
            return self._returns.batch(self._parts)
        count = self._config.training.intensity_batch_size
        return self._returns.spread(count, max(1, min(self._parts, count // _LEAST_PART)))


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
    adams: list[Adam]
    """Optimisers of the parameters that are trained, in the order of their gradients."""
    rows: RowAdam | None
    """Optimiser of the features if only the touched ones move."""
    draw: Callable[[], list[Samples]]
    """Draws a batch, in a part for each thread."""
    gradients_of: Callable[[tuple[GradientBackend, Samples]], Gradients]
    """Computes losses and gradients of a part."""


class Training:
    """Trains `field` in place: the sdf stage on `surface`, then the intensity stage on all `returns`.

    Without a `scale` there are no intensities. Each batch is split over the threads. Their gradients are
    added in the order of the threads, so the same number of threads gives the same bits. With another number,
    the rounding and the dropout differ.
    """

    def __init__(
        self,
        field: Field,
        surface: Rays,
        returns: Rays,
        scale: IntensityScale | None,
        config: FitConfig,
        workers: Workers,
    ) -> None:
        self._field = field
        self._config = config
        self._workers = workers
        schedule = Schedule.of(
            config,
            surface_returns=len(surface),
            returns=len(returns),
            vertices=field.cells.table.num_rows,
            with_intensity=scale is not None,
        )
        self.schedule = schedule
        self.iterations = schedule.iterations
        parts = min(workers.num_threads, schedule.batch_size, config.training.intensity_batch_size)
        self._draws: _Draws | None = None  # not made without iterations, because it sorts the returns
        self._backends: list[GradientBackend] = []
        if any(self.iterations.values()):
            self._draws = _Draws(surface, returns, scale, config, schedule, parts)
            self._backends = _backends(field, config, schedule, parts)
        self.iterations_done = {"sdf": 0, "intensity": 0}
        self.losses: dict[str, float] = {}
        self.history = LossHistory(self.iterations)
        sdf_parameters = list(field.sdf_network.parameters())
        self._rows = None
        if config.moves_rows(scale is not None):
            self._rows = RowAdam(field.cells, config.training.learning_rate)
        else:
            sdf_parameters = [*field.cells.parameters(), *sdf_parameters]
        self._adams = {"sdf": Adam(sdf_parameters, config.training.learning_rate)}
        if field.intensity_network is not None:
            self._adams["intensity"] = Adam(
                field.intensity_network.parameters(), config.training.intensity_learning_rate
            )

    def state(self) -> dict[str, Tensor]:
        """All that the rest of the training depends on, between two iterations. Tensors are not copied."""
        losses = [self.losses.get(name, 0.0) for name in self.iterations_done]
        state = {
            "done": torch.tensor(list(self.iterations_done.values()), dtype=torch.int64, device="cpu"),
            "losses": torch.tensor(losses, dtype=torch.float64, device="cpu"),
        }
        state |= {f"history.{name}": spans for name, spans in self.history.state().items()}
        state |= {f"field.{name}": p.detach() for name, p in self._field.named_parameters()}
        for name, adam in self._adams.items():
            state |= {f"adam.{name}.{k}": v for k, v in adam.state().items()}
        if self._rows is not None:
            state |= {f"rows.{k}": v for k, v in self._rows.state().items()}
        if self._draws is not None:
            state |= {f"draws.{k}": v for k, v in self._draws.state().items()}
        for i, backend in enumerate(self._backends):
            state |= {f"backend.{i}.{k}": v for k, v in backend.state().items()}
        return state

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
        for name, parameter in self._field.named_parameters():
            parameter.data.copy_(state[f"field.{name}"])
        for name, adam in self._adams.items():
            adam.restore(_part(state, f"adam.{name}"))
        if self._rows is not None:
            self._rows.restore(_part(state, "rows"))
        if self._draws is not None:
            self._draws.restore(_part(state, "draws"))
        for i, backend in enumerate(self._backends):
            backend.restore(_part(state, f"backend.{i}"))

    def run(self, progress: bool | None, checkpoint: Checkpoint | None = None) -> None:
        """Runs all iterations that are left.

        Raises
        ------
        Diverged
            If a loss or a parameter is not finite. The field then has the last parameters that were checked
            and finite.
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
        if self._draws is None:
            return stages
        sdf_iterations, intensity_iterations = self.iterations["sdf"], self.iterations["intensity"]
        sdf_adam, intensity_adam = self._adams["sdf"], self._adams.get("intensity")
        joint = sdf_iterations if intensity_adam is not None and self._config.training.joint else 0
        if sdf_iterations:
            stages.append(
                _Stage(
                    name="sdf",
                    iterations=sdf_iterations,
                    iterations_before=0,
                    counts=("sdf", "intensity") if joint else ("sdf",),
                    adams=[sdf_adam, intensity_adam] if joint and intensity_adam is not None else [sdf_adam],
                    rows=self._rows,
                    draw=self._draws.of_surface,
                    gradients_of=_joint_gradients if joint else _sdf_gradients,
                )
            )
        if intensity_adam is not None and intensity_iterations > joint:
            stages.append(
                _Stage(
                    name="intensity",
                    iterations=intensity_iterations - joint,
                    iterations_before=joint,
                    counts=("intensity",),
                    adams=[intensity_adam],
                    rows=None,
                    draw=self._draws.of_returns,
                    gradients_of=_intensity_gradients,
                )
            )
        return stages

    def _done(self, stage: _Stage) -> int:
        """Iterations of this stage that are done, without joint ones of an earlier stage."""
        return max(0, self.iterations_done[stage.name] - stage.iterations_before)

    def _run_stage(self, stage: _Stage, pauses: _Pauses) -> None:
        rows, iterations = stage.rows, stage.iterations
        parameters = [p for adam in stage.adams for p in adam.parameters]
        changing = [*parameters, *([] if rows is None else [rows.features])]
        good = [p.detach().clone() for p in changing]

        def give_up(fault: str) -> NoReturn:
            for parameter, value in zip(changing, good, strict=True):
                parameter.data.copy_(value)
            msg = f"{fault} at iteration {i} of {iterations} of the {stage.name} stage: a lower learning rate may help"
            raise Diverged(msg)

        ahead: list[Samples] | None = None
        for i in range(self._done(stage), iterations):
            # Each stage starts at the full learning rate, also for an optimiser that an earlier stage has
            # used.
            cosine = 0.5 * (1 + math.cos(math.pi * i / iterations))
            share = cosine if self._config.training.cosine_schedule else 1.0
            # A small batch of the intensity stage has fewer parts than there are threads.
            work = list(zip(self._backends, ahead or stage.draw(), strict=False))
            found = list(self._workers.map(stage.gradients_of, work))
            loss = sum(sum(part.losses.values()) for part in found)
            if not math.isfinite(loss):
                give_up(f"the {_bad_losses(found)} loss is {loss}")
            stop = pauses.interrupted()
            write = pauses.checkpoint is not None and (stop or pauses.checkpoint.due())
            look = stop or write or i % _CHECK_EVERY == _CHECK_EVERY - 1 or i == iterations - 1
            # No samples are drawn ahead before the state is written: it would contain the draw after the
            # next.
            rest = functools.partial(_move_networks, found, stage.adams, share, None if look else stage.draw)
            if rows is None:
                ahead = rest()
            else:
                rows.learning_rate = share * rows.full_rate
                ahead = rows.step(
                    [part.touched for part in found if part.touched is not None],
                    self._workers,
                    meanwhile=rest,
                )
            self.losses[stage.name] = loss
            for name in stage.counts:
                before = stage.iterations_before if name == stage.name else 0
                self.iterations_done[name] = min(before + i + 1, self.iterations[name])
            self.history.add(found, self.iterations_done)
            del found, rest  # gradients of all features are as large as these: not two for each thread
            pauses.bar.set_postfix_str(f"{stage.name} loss {loss:.3g}", refresh=False)
            pauses.bar.update()
            if look:
                # A sum is finite only if all numbers are. A sum that overflows is no better.
                if not all(math.isfinite(float(p.detach().sum())) for p in changing):
                    give_up("a parameter is not finite")
                for parameter, value in zip(changing, good, strict=True):
                    value.copy_(parameter.detach())
            if write and pauses.checkpoint is not None:
                pauses.checkpoint.write(self.state())
            if stop:
                raise KeyboardInterrupt


def _backends(field: Field, config: FitConfig, schedule: Schedule, parts: int) -> list[GradientBackend]:
    """A back end for each thread."""
    # Normals are gradients, and the core's loss does not differentiate twice.
    normals = field.intensity_network is not None and config.networks.normals
    kind = AutogradGradients if normals or config.training.gradients == "autograd" else CoreGradients
    seeds = range(config.seed * _GENERATORS + 1, config.seed * _GENERATORS + 1 + parts)
    generators = [torch.Generator("cpu").manual_seed(seed) for seed in seeds]
    return [kind(field, config, Share(schedule.dropout_scale, generator)) for generator in generators]


_Work = tuple[GradientBackend, Samples]


def _sdf_gradients(work: _Work) -> Gradients:
    backend, samples = work
    return backend.sdf(samples)


def _joint_gradients(work: _Work) -> Gradients:
    backend, samples = work
    return backend.joint(samples)


def _intensity_gradients(work: _Work) -> Gradients:
    backend, samples = work
    return backend.intensity(samples)


def _bad_losses(found: Sequence[Gradients]) -> str:
    """Names of the losses that are not finite."""
    bad = {name for part in found for name, value in part.losses.items() if not math.isfinite(value)}
    return " and ".join(sorted(bad))


def _move_networks(
    found: Sequence[Gradients], adams: Sequence[Adam], share: float, draw: Callable[[], list[Samples]] | None
) -> list[Samples] | None:
    """Adds the gradients of all threads, changes the networks and draws the next samples by `draw`."""
    for part in found[1:]:
        torch._foreach_add_(found[0].by_parameters, part.by_parameters)
    total = iter(found[0].by_parameters)
    for adam in adams:
        adam.learning_rate = share * adam.full_rate
        adam.step(list(itertools.islice(total, len(adam.parameters))))
    return None if draw is None else draw()


def _part(state: dict[str, Tensor], name: str) -> dict[str, Tensor]:
    """The entries of `state` whose names begin with `name` and a dot, named without that."""
    return {k.removeprefix(f"{name}."): v for k, v in state.items() if k.startswith(f"{name}.")}
