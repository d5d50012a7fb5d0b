# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The training loop: batches over threads, losses, and the schedule of the two networks."""

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
from radarsdf.fitting.checkpoint import Checkpoint
from radarsdf.fitting.gradients import Gradients, Shard
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
        self._generator = torch.Generator().manual_seed(config.seed * _GENERATORS)

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
        if self._config.intensity_in_free_space:
            return self._returns.batch(self._parts)
        return self._returns.spread(self._config.intensity_batch_size, self._parts)


@dataclass(frozen=True)
class _Pauses:
    """What is asked after each iteration."""

    bar: Any
    interrupted: Callable[[], bool]
    checkpoint: Checkpoint | None


class Training:
    """The schedule: geometry first, then, on frozen geometry, reflectance; or, as published, both from the start.

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
        parts = min(workers.num_threads, schedule.batch_size, config.intensity_batch_size)
        self._draws: _Draws | None = None  # where nothing is trained: the returns need not be put in order
        self._shards: list[Shard] = []
        if any(self.iterations.values()):
            self._draws = _Draws(surface, returns, scale, config, schedule, parts)
        self.iterations_done = {"sdf": 0, "intensity": 0}
        self.losses: dict[str, float] = {}
        geometry = list(field.sdf_network.parameters())
        self._rows = None
        # Through normals the loss sees the features twice, which only autograd can take apart.
        if config.row_updates and not (config.joint and config.normals and scale is not None):
            self._rows = RowAdam(field.cells, config.learning_rate, config.adam_epsilon)
        else:
            geometry = [*field.cells.parameters(), *geometry]
        if self._draws is not None:
            for part in range(parts):
                generator = torch.Generator().manual_seed(config.seed * _GENERATORS + 1 + part)
                shard = Shard(
                    field, config, schedule.dropout_scale, generator, parts, moves_rows=self.moves_rows
                )
                self._shards.append(shard)
        self._adams = {"geometry": Adam(geometry, config.learning_rate, config.adam_epsilon)}
        if field.intensity_network is not None:
            self._adams["reflectance"] = Adam(
                field.intensity_network.parameters(), config.intensity_learning_rate, config.adam_epsilon
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
        for i, shard in enumerate(self._shards):
            state |= {f"shard.{i}.{k}": v for k, v in shard.state().items()}
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
        for i, shard in enumerate(self._shards):
            shard.restore(_part(state, f"shard.{i}"))

    def run(self, progress: bool | None, checkpoint: Checkpoint | None = None) -> None:
        """All iterations that are left.

        Raises
        ------
        Diverged
            With the parameters as they last were when all were finite.
        KeyboardInterrupt
            For Ctrl-C, between two iterations.
        """
        config, field = self._config, self._field
        geometry, reflectance = self._adams["geometry"], self._adams.get("reflectance")
        joint = config.joint and reflectance is not None
        rest = max(0, self.iterations["intensity"] - (self.iterations["sdf"] if joint else 0))
        with (
            tqdm(
                total=self.iterations["sdf"] + rest,
                desc="fit",
                unit="it",
                disable=None if progress is None else not progress,
            ) as bar,
            deferred_interrupts() as interrupted,
        ):
            pauses = _Pauses(bar, interrupted, checkpoint)
            adams = [geometry, reflectance] if joint and reflectance is not None else [geometry]
            gradients_of = Shard.joint if joint else Shard.geometry
            bar.update(sum(self.iterations_done.values()))
            if self._draws is not None and self.iterations["sdf"]:
                draw = self._draws.of_surface
                self._loop("sdf", self.iterations["sdf"], adams, draw, gradients_of, pauses, self._rows)
            field.cells.requires_grad_(False)
            field.sdf_network.requires_grad_(False)
            if self._draws is not None and reflectance is not None and rest:
                draw = self._draws.of_returns
                self._loop("intensity", rest, [reflectance], draw, Shard.reflectance, pauses)
            if checkpoint is not None:
                checkpoint.write(self.state())
            if interrupted():  # by now all is done, but whoever pressed it wants to stop more than this
                raise KeyboardInterrupt

    def _loop(
        self,
        name: str,
        iterations: int,
        adams: list[Adam],
        draw: Callable[[], list[Samples]],
        gradients_of: Callable[[Shard, Samples], Gradients],
        pauses: _Pauses,
        rows: RowAdam | None = None,
    ) -> None:
        parameters = [p for adam in adams for p in adam.parameters]
        changing = [*parameters, *([] if rows is None else [rows.features])]
        good = [p.detach().clone() for p in changing]

        def gradients(work: tuple[Shard, Samples]) -> Gradients:
            return gradients_of(*work)

        def give_up(fault: str) -> NoReturn:
            for parameter, value in zip(changing, good, strict=True):
                parameter.data.copy_(value)
            msg = f"{fault} at iteration {i} of {iterations} of the {name} stage: a lower learning rate may help"
            raise Diverged(msg)

        ahead: list[Samples] | None = None
        for i in range(self.iterations_done[name], iterations):
            # From the full rate on in each stage, also for an Adam that has been through another.
            share = 0.5 * (1 + math.cos(math.pi * i / iterations)) if self._config.cosine_schedule else 1.0
            found = list(self._workers.map(gradients, list(zip(self._shards, ahead or draw(), strict=True))))
            loss = sum(sum(part.losses.values()) for part in found)
            if not math.isfinite(loss):
                give_up(f"the {_bad_losses(found)} loss is {loss}")
            stop = pauses.interrupted()
            write = pauses.checkpoint is not None and (stop or pauses.checkpoint.due())
            look = stop or write or i % _KEEP_EVERY == _KEEP_EVERY - 1 or i == iterations - 1
            # No draw before the state is looked at: it would be that after the next one.
            rest = functools.partial(_move_networks, found, adams, share, None if look else draw)
            if rows is None:
                ahead = rest()
            else:
                rows.learning_rate = share * rows.full_rate
                ahead = rows.step(
                    [part.touched for part in found if part.touched is not None],
                    self._workers,
                    meanwhile=rest,
                )
            self.losses[name] = loss
            self.iterations_done[name] = i + 1
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
