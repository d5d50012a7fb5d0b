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
from radarsdf.sampling import RaySampler, Samples
from radarsdf.scans import Rays
from radarsdf.schedule import Schedule
from radarsdf.stopping import Diverged, deferred_interrupts
from radarsdf.threads import Workers

_KEEP_EVERY = (
    100  # iterations: to look through all parameters, and copy them, in each would cost a tenth of it
)


class _Source:
    """Rays to draw samples from, with what the intensity network is to know of them."""

    def __init__(
        self,
        rays: Rays,
        scale: IntensityScale | None,
        config: FitConfig,
        batch_size: int,
        generator: torch.Generator,
        neighbours: int,
    ) -> None:
        self.sampler = RaySampler(rays, config, batch_size, generator, neighbours)
        self.directions = torch.from_numpy(rays.directions)
        self.ranges_m = torch.from_numpy(rays.ranges_m)
        self.intensities = None
        if scale is not None and rays.intensities is not None:
            self.intensities = torch.from_numpy(scale.to_unit(rays.intensities))


class _Shard:
    """One thread's share of the rays and of each batch: it draws samples and computes gradients."""

    def __init__(
        self,
        field: Field,
        surface: Rays,
        returns: Rays,
        scale: IntensityScale | None,
        config: FitConfig,
        schedule: Schedule,
        part: int,
        parts: int,
    ) -> None:
        self._field = field
        self._config = config
        generator = torch.Generator().manual_seed(config.seed * MAX_THREADS + part)

        def source(rays: Rays) -> _Source:
            share = _share(schedule.batch_size, part, parts)
            return _Source(rays.every(parts, part), scale, config, share, generator, schedule.neighbours)

        self._surface = source(surface)
        # A ghost has an intensity, though no surface: the sensor will see it again.
        self._returns = self._surface if returns is surface or scale is None else source(returns)
        dropouts = (config.feature_dropout, config.fourier_dropout)
        self._dropouts = [schedule.dropout_scale * dropout for dropout in dropouts]
        self._intensity_batch_size = _share(config.intensity_batch_size, part, parts)
        self._generator = generator
        self.joint_parts: dict[str, Tensor] = {}
        """The two losses of the last joint one."""

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
        samplers = {"surface": self._surface.sampler}
        return samplers if self._returns is self._surface else samplers | {"returns": self._returns.sampler}

    def geometry_loss(self, touched: list[Touched] | None) -> Tensor:
        samples = self._surface.sampler.batch()
        logit = self._field.logit(samples.points, touched)
        return sdf_loss(logit, samples.sdf_m, self._config.sigma_m)

    def joint_loss(self, touched: list[Touched] | None) -> Tensor:
        samples = self._surface.sampler.batch()
        geometry = self._field.geometry(samples.points, frozen=False, touched=touched)
        sdf = sdf_loss(geometry.logit, samples.sdf_m, self._config.sigma_m)
        intensity = self._intensity_loss(samples, self._surface, geometry)
        self.joint_parts = {"sdf": sdf.detach(), "intensity": intensity.detach()}
        return self._config.sdf_loss_weight * sdf + intensity

    def reflectance_loss(self, _: list[Touched] | None) -> Tensor:
        if self._config.intensity_in_free_space:
            samples = self._returns.sampler.batch()
        else:
            samples = self._returns.sampler.spread(self._intensity_batch_size)
        return self._intensity_loss(samples, self._returns, self._field.geometry(samples.points))

    def _intensity_loss(self, samples: Samples, source: _Source, geometry: Geometry) -> Tensor:
        assert source.intensities is not None
        count = len(samples.rays) if self._config.intensity_in_free_space else samples.num_near
        rays = samples.rays[:count]
        labels = source.intensities[rays]
        labels[samples.num_near :] = 0  # no return is expected from free space (3QFPI)
        predicted = self._field.reflectance(
            geometry.first(count),
            source.directions[rays],
            source.ranges_m[rays] - samples.sdf_m[:count],
            encoding_factors=self._encoding_factors(count),
        )
        return intensity_loss(predicted, labels)

    def _encoding_factors(self, count: int) -> Tensor | None:
        """Dropout of the encoding for `count` samples, which the SDF network is spared."""
        if not any(self._dropouts):
            return None
        dims = (self._field.cells.dim, self._field.fourier.dim)
        kept = [self._surface.sampler.kept(count, *part) for part in zip(dims, self._dropouts, strict=True)]
        return torch.cat(kept, 1)


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
    threads gives the same bits.
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
        parts = min(workers.num_threads, len(surface), schedule.batch_size, config.intensity_batch_size)
        if not any(self.iterations.values()):
            parts = 0  # nobody will draw a sample
        self._shards = [
            _Shard(field, surface, returns, scale, config, schedule, part, parts) for part in range(parts)
        ]
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
            self._loop("sdf", self.iterations["sdf"], adams, loss_of, pauses, self._rows)
            field.cells.requires_grad_(False)
            field.sdf_network.requires_grad_(False)
            if reflectance is not None and rest:
                self._loop("intensity", rest, [reflectance], _Shard.reflectance_loss, pauses)
            if checkpoint is not None:
                checkpoint.write(self.state())
            if interrupted():  # by now all is done, but whoever pressed it wants to stop more than this
                raise KeyboardInterrupt

    def _loop(
        self,
        name: str,
        iterations: int,
        adams: list[Adam],
        loss_of: Callable[[_Shard, list[Touched] | None], Tensor],
        pauses: _Pauses,
        rows: RowAdam | None = None,
    ) -> None:
        if iterations == 0:
            return
        parameters = [p for adam in adams for p in adam.parameters]
        changing = [*parameters, *([] if rows is None else [rows.features])]
        kept = [p.detach().clone() for p in changing]

        def gradients(shard: _Shard) -> _Gradients:
            touched: list[Touched] = []
            loss = loss_of(shard, None if rows is None else touched) / len(self._shards)
            found = torch.autograd.grad(loss, [*parameters, *(t.interpolated for t in touched)])
            return _Gradients(loss.detach(), found[: len(parameters)], touched, found[len(parameters) :])

        def give_up(fault: str) -> NoReturn:
            for parameter, value in zip(changing, kept, strict=True):
                parameter.data.copy_(value)
            msg = f"{fault} at iteration {i} of {iterations} of the {name} stage: a lower learning rate may help"
            raise Diverged(msg)

        for i in range(self.iterations_done[name], iterations):
            # From the full rate on in each stage, also for an Adam that has been through another.
            share = 0.5 * (1 + math.cos(math.pi * i / iterations)) if self._config.cosine_schedule else 1.0
            found = list(self._workers.map(gradients, self._shards))
            loss = float(sum(part.loss for part in found))
            if not math.isfinite(loss):
                give_up(f"the {self._loss_name(name)} loss is {loss}")
            by_parameter = zip(*[part.by_parameters for part in found], strict=True)
            total = iter([functools.reduce(Tensor.add_, parts) for parts in by_parameter])
            if rows is not None:
                rows.learning_rate = share * rows.full_rate
                rows.step(
                    [t for part in found for t in part.touched],
                    [g for part in found for g in part.by_interpolated],
                    self._workers,
                )
            for adam in adams:
                adam.learning_rate = share * adam.full_rate
                adam.step(list(itertools.islice(total, len(adam.parameters))))
            self.losses[name] = loss
            self.iterations_done[name] = i + 1
            pauses.bar.update()
            stop = pauses.interrupted()
            write = pauses.checkpoint is not None and (stop or pauses.checkpoint.due())
            if stop or write or i % _KEEP_EVERY == _KEEP_EVERY - 1 or i == iterations - 1:
                # The sum is finite only if all are; that it overflows by itself is as bad.
                if not all(math.isfinite(float(p.detach().sum())) for p in changing):
                    give_up("a parameter is not finite")
                for parameter, value in zip(changing, kept, strict=True):
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


def _part(state: dict[str, Tensor], name: str) -> dict[str, Tensor]:
    """Those of a state whose names begin with `name` and a dot, without these."""
    return {k.removeprefix(f"{name}."): v for k, v in state.items() if k.startswith(f"{name}.")}


def _share(count: int, part: int, parts: int) -> int:
    """`count` things over `parts`: how many the `part`-th gets."""
    return count * (part + 1) // parts - count * part // parts
