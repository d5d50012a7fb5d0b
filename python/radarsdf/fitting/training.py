# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The training loop: batches over threads, and the schedule of the two networks."""

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
from radarsdf.fitting.optimiser import Adam, RowAdam
from radarsdf.fitting.sampling import RaySampler, Samples
from radarsdf.fitting.stopping import Diverged
from radarsdf.interrupts import deferred_interrupts
from radarsdf.returns.rays import Rays
from radarsdf.threads import Workers

_GENERATORS = MAX_THREADS + 1  # of random numbers in a fit: one for the draws, one for each thread's dropout
_KEEP_EVERY = (
    100  # iterations: to look through all parameters, and copy them, in each would cost a tenth of it
)


class _Draws:
    """Samples for each thread, drawn by one: dozens of small operations on every thread would wait for each other."""

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
        # A ghost has an intensity, though no surface: the sensor will see it again.
        self._returns = self._surface if returns is surface or scale is None else sampler(returns)

    def state(self) -> dict[str, Tensor]:
        """What the next batches depend on."""
        samplers = self._samplers()
        state = {f"{name}.{k}": v for name, sampler in samplers.items() for k, v in sampler.state().items()}
        return state | {"generator": self._generator.get_state()}

    def restore(self, state: dict[str, Tensor]) -> None:
        for name, sampler in self._samplers().items():
            sampler.restore(_part(state, name))
        self._generator.set_state(state["generator"])  # last: the samplers draw their orders again

    def _samplers(self) -> dict[str, RaySampler]:
        samplers = {"surface": self._surface}
        return samplers if self._returns is self._surface else samplers | {"returns": self._returns}

    def of_surface(self) -> list[Samples]:
        return self._surface.batch(self._parts)

    def of_returns(self) -> list[Samples]:
        if self._config.training.intensity_in_free_space:
            return self._returns.batch(self._parts)
        return self._returns.spread(self._config.training.intensity_batch_size, self._parts)


@dataclass(frozen=True)
class _Pauses:
    """What is asked after each iteration."""

    bar: Any
    interrupted: Callable[[], bool]
    checkpoint: Checkpoint | None


@dataclass(frozen=True)
class _Stage:
    """A part of the schedule."""

    name: str
    """ "sdf" or "intensity"."""
    iterations: int
    """How many it has."""
    iterations_before: int
    """Of the same name, done by an earlier stage."""
    counts: tuple[str, ...]
    """Whose iterations it does: both in a joint beginning."""
    adams: list[Adam]
    """Of the parameters that learn, in the order of their gradients."""
    rows: RowAdam | None
    """Of the features, where only the touched ones move."""
    draw: Callable[[], list[Samples]]
    """A batch, in a part for each thread."""
    gradients_of: Callable[[tuple[GradientBackend, Samples]], Gradients]


class Training:
    """The schedule: the SDF first, alone or with the intensity, then the intensity on the frozen SDF.

    Every batch is split over the threads; their gradients are added in the order of the threads, so the same number of
    threads gives the same bits; another number of threads rounds differently and has another dropout.
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
        self.iterations = schedule.iterations
        self.passes = schedule.passes
        parts = min(workers.num_threads, schedule.batch_size, config.training.intensity_batch_size)
        self._draws: _Draws | None = None  # where nothing is trained, the returns need not be put in order
        self._backends: list[GradientBackend] = []
        if any(self.iterations.values()):
            self._draws = _Draws(surface, returns, scale, config, schedule, parts)
            self._backends = _backends(field, config, schedule, parts)
        self.iterations_done = {"sdf": 0, "intensity": 0}
        self.losses: dict[str, float] = {}
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

    @property
    def moves_rows(self) -> bool:
        """Whether an iteration moves the touched features alone."""
        return self._rows is not None

    def state(self) -> dict[str, Tensor]:
        """All that the rest of the training depends on, between two iterations. Not copies."""
        losses = [self.losses.get(name, 0.0) for name in self.iterations_done]
        state = {
            "done": torch.tensor(list(self.iterations_done.values())),
            "losses": torch.tensor(losses, dtype=torch.float64),
        }
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
        """Go on where another training of the same rays and configuration was when it gave `state`."""
        done = dict(zip(self.iterations_done, state["done"].tolist(), strict=True))
        if not all(0 <= done[name] <= self.iterations[name] for name in done):
            msg = f"{done} iterations of {self.iterations}"
            raise ValueError(msg)
        self.iterations_done.update(done)
        losses = zip(done, state["losses"].tolist(), strict=True)
        self.losses.update({name: loss for name, loss in losses if done[name]})
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
        """All iterations that are left.

        Raises
        ------
        Diverged
            With the parameters as they last were when all were finite.
        KeyboardInterrupt
            For Ctrl-C, between two iterations.
        """
        field = self._field
        stages = self._stages()
        with (
            tqdm(
                total=sum(stage.iterations for stage in stages),
                initial=sum(self._done(stage) for stage in stages),
                desc="fit",
                unit="it",
                disable=None if progress is None else not progress,
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
            if interrupted():  # by now all is done, but whoever pressed it wants to stop more than this
                raise KeyboardInterrupt

    def _stages(self) -> list[_Stage]:
        """The SDF, alone or joint with the intensity; then the intensity alone, on frozen features and SDF network."""
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
        """Iterations of a stage that are done."""
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
            # From the full rate on in each stage, also for an Adam that has been through another.
            cosine = 0.5 * (1 + math.cos(math.pi * i / iterations))
            share = cosine if self._config.training.cosine_schedule else 1.0
            work = list(zip(self._backends, ahead or stage.draw(), strict=True))
            found = list(self._workers.map(stage.gradients_of, work))
            loss = sum(sum(part.losses.values()) for part in found)
            if not math.isfinite(loss):
                give_up(f"the {_bad_losses(found)} loss is {loss}")
            stop = pauses.interrupted()
            write = pauses.checkpoint is not None and (stop or pauses.checkpoint.due())
            look = stop or write or i % _KEEP_EVERY == _KEEP_EVERY - 1 or i == iterations - 1
            # No draw before the state is looked at: it would be that after the next one.
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
            pauses.bar.update()
            if look:
                # The sum is finite only if all are; that it overflows by itself is as bad.
                if not all(math.isfinite(float(p.detach().sum())) for p in changing):
                    give_up("a parameter is not finite")
                for parameter, value in zip(changing, good, strict=True):
                    value.copy_(parameter.detach())
            if write and pauses.checkpoint is not None:
                pauses.checkpoint.write(self.state())
            if stop:
                raise KeyboardInterrupt


def _backends(field: Field, config: FitConfig, schedule: Schedule, parts: int) -> list[GradientBackend]:
    """One for each thread."""
    # Normals are gradients themselves, which the core does not know.
    normals = field.intensity_network is not None and config.networks.normals
    kind = AutogradGradients if normals or config.training.gradients == "autograd" else CoreGradients
    seeds = range(config.seed * _GENERATORS + 1, config.seed * _GENERATORS + 1 + parts)
    generators = [torch.Generator("cpu").manual_seed(seed) for seed in seeds]
    return [kind(field, config, Share(parts, schedule.dropout_scale, generator)) for generator in generators]


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
    """Which of them are not finite."""
    bad = {name for part in found for name, value in part.losses.items() if not math.isfinite(value)}
    return " and ".join(sorted(bad))


def _move_networks(
    found: Sequence[Gradients], adams: Sequence[Adam], share: float, draw: Callable[[], list[Samples]] | None
) -> list[Samples] | None:
    """What of an iteration one thread does while the others move features: it draws the next samples, too."""
    for part in found[1:]:
        torch._foreach_add_(found[0].by_parameters, part.by_parameters)
    total = iter(found[0].by_parameters)
    for adam in adams:
        adam.learning_rate = share * adam.full_rate
        adam.step(list(itertools.islice(total, len(adam.parameters))))
    return None if draw is None else draw()


def _part(state: dict[str, Tensor], name: str) -> dict[str, Tensor]:
    """Those of a state whose names begin with `name` and a dot, without these."""
    return {k.removeprefix(f"{name}."): v for k, v in state.items() if k.startswith(f"{name}.")}
