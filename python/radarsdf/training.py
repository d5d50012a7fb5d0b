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

from radarsdf.checkpoint import Checkpoint
from radarsdf.config import MAX_THREADS, FitConfig
from radarsdf.encodings import Touched
from radarsdf.field import Field, Geometry
from radarsdf.losses import intensity_loss, sdf_loss
from radarsdf.map import IntensityScale
from radarsdf.optimiser import Adam, RowAdam
from radarsdf.sampling import RaySampler, Samples, kept
from radarsdf.scans import Rays
from radarsdf.schedule import Schedule
from radarsdf.stopping import Diverged, deferred_interrupts
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


class _Shard:
    """One thread's share of the work on each batch."""

    def __init__(self, field: Field, config: FitConfig, schedule: Schedule, part: int) -> None:
        self._field = field
        self._config = config
        self._generator = torch.Generator().manual_seed(config.seed * _GENERATORS + 1 + part)
        dropouts = (config.feature_dropout, config.fourier_dropout)
        self._dropouts = [schedule.dropout_scale * dropout for dropout in dropouts]
        self.joint_parts: dict[str, Tensor] = {}
        """The two losses of the last joint one."""

    def state(self) -> dict[str, Tensor]:
        """What its dropout depends on."""
        return {"generator": self._generator.get_state()}

    def restore(self, state: dict[str, Tensor]) -> None:
        self._generator.set_state(state["generator"])

    def geometry_loss(self, samples: Samples, touched: list[Touched] | None) -> Tensor:
        logit = self._field.logit(samples.points, touched)
        return sdf_loss(logit, samples.sdf_m, self._config.sigma_m)

    def joint_loss(self, samples: Samples, touched: list[Touched] | None) -> Tensor:
        geometry = self._field.geometry(samples.points, frozen=False, touched=touched)
        sdf = sdf_loss(geometry.logit, samples.sdf_m, self._config.sigma_m)
        intensity = self._intensity_loss(samples, geometry)
        self.joint_parts = {"sdf": sdf.detach(), "intensity": intensity.detach()}
        return self._config.sdf_loss_weight * sdf + intensity

    def reflectance_loss(self, samples: Samples, _: list[Touched] | None) -> Tensor:
        return self._intensity_loss(samples, self._field.geometry(samples.points))

    def _intensity_loss(self, samples: Samples, geometry: Geometry) -> Tensor:
        count = len(samples.points) if self._config.intensity_in_free_space else samples.num_near
        labels = samples.intensities[:count].clone()
        labels[samples.num_near :] = 0  # no return is expected from free space (3QFPI)
        predicted = self._field.reflectance(
            geometry.first(count),
            samples.directions[:count],
            samples.ranges_m[:count] - samples.sdf_m[:count],
            encoding_factors=self._encoding_factors(count),
        )
        return intensity_loss(predicted, labels)

    def _encoding_factors(self, count: int) -> list[Tensor] | None:
        """Dropout of the encoding for `count` samples, which the SDF network is spared."""
        if not any(self._dropouts):
            return None
        dims = (self._field.cells.dim, self._field.fourier.dim)
        parts = [part for part in zip(dims, self._dropouts, strict=True) if part[0]]
        return [kept(count, *part, self._generator) for part in parts]


@dataclass(frozen=True)
class _Gradients:
    """Of one thread's share of a batch."""

    loss: Tensor
    by_parameters: Sequence[Tensor]
    touched: Sequence[Touched]
    by_interpolated: Sequence[Tensor]
    """Of `touched`, in the same order."""


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
        self._shards: list[_Shard] = []
        if any(self.iterations.values()):
            self._draws = _Draws(surface, returns, scale, config, schedule, parts)
            self._shards = [_Shard(field, config, schedule, part) for part in range(parts)]
        self.iterations_done = {"sdf": 0, "intensity": 0}
        self.losses: dict[str, float] = {}
        geometry = list(field.sdf_network.parameters())
        self._rows = None
        # Through normals the loss sees the features twice, which only autograd can take apart.
        if config.row_updates and not (config.joint and config.normals and scale is not None):
            self._rows = RowAdam(field.cells, config.learning_rate, config.adam_epsilon)
        else:
            geometry = [*field.cells.parameters(), *geometry]
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
            loss_of = _Shard.joint_loss if joint else _Shard.geometry_loss
            bar.update(sum(self.iterations_done.values()))
            if self._draws is not None and self.iterations["sdf"]:
                draw = self._draws.of_surface
                self._loop("sdf", self.iterations["sdf"], adams, draw, loss_of, pauses, self._rows)
            field.cells.requires_grad_(False)
            field.sdf_network.requires_grad_(False)
            if self._draws is not None and reflectance is not None and rest:
                draw = self._draws.of_returns
                self._loop("intensity", rest, [reflectance], draw, _Shard.reflectance_loss, pauses)
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
        loss_of: Callable[[_Shard, Samples, list[Touched] | None], Tensor],
        pauses: _Pauses,
        rows: RowAdam | None = None,
    ) -> None:
        parameters = [p for adam in adams for p in adam.parameters]
        changing = [*parameters, *([] if rows is None else [rows.features])]
        good = [p.detach().clone() for p in changing]

        def gradients(work: tuple[_Shard, Samples]) -> _Gradients:
            touched: list[Touched] = []
            loss = loss_of(*work, None if rows is None else touched) / len(self._shards)
            found = torch.autograd.grad(loss, [*parameters, *(t.interpolated for t in touched)])
            return _Gradients(loss.detach(), found[: len(parameters)], touched, found[len(parameters) :])

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
            loss = float(sum(part.loss for part in found))
            if not math.isfinite(loss):
                give_up(f"the {self._loss_name(name)} loss is {loss}")
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
                    [t for part in found for t in part.touched],
                    [g for part in found for g in part.by_interpolated],
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

    def _loss_name(self, stage: str) -> str:
        """Which of the losses it is that is not finite."""
        bad = {
            name
            for shard in self._shards
            for name, value in shard.joint_parts.items()
            if stage == "sdf" and not math.isfinite(float(value))
        }
        return " and ".join(sorted(bad)) or stage


def _move_networks(
    found: Sequence[_Gradients], adams: Sequence[Adam], share: float, draw: Callable[[], list[Samples]] | None
) -> list[Samples] | None:
    """What of an iteration one thread does while the others move features: it draws the next samples, too."""
    by_parameter = zip(*[part.by_parameters for part in found], strict=True)
    total = iter([functools.reduce(Tensor.add_, parts) for parts in by_parameter])
    for adam in adams:
        adam.learning_rate = share * adam.full_rate
        adam.step(list(itertools.islice(total, len(adam.parameters))))
    return None if draw is None else draw()


def _part(state: dict[str, Tensor], name: str) -> dict[str, Tensor]:
    """Those of a state whose names begin with `name` and a dot, without these."""
    return {k.removeprefix(f"{name}."): v for k, v in state.items() if k.startswith(f"{name}.")}
