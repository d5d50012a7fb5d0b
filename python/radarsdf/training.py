# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The training loop: batches over threads, losses, and the schedule of the two networks."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from radarsdf.config import MAX_THREADS, FitConfig
from radarsdf.encodings import Touched
from radarsdf.field import Field, Geometry
from radarsdf.losses import intensity_loss, sdf_loss
from radarsdf.map import IntensityScale
from radarsdf.optimiser import Adam, RowAdam
from radarsdf.sampling import RaySampler, Samples
from radarsdf.scans import Rays
from radarsdf.threads import Workers

_DROPOUT_HALF_PASSES = 3.0  # each sample seen so often: half of the configured dropout


class _Source:
    """Rays to draw samples from, with what the intensity network is to know of them."""

    def __init__(
        self,
        rays: Rays,
        scale: IntensityScale | None,
        config: FitConfig,
        batch_size: int,
        generator: torch.Generator,
    ) -> None:
        self.sampler = RaySampler(rays, config, batch_size, generator)
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
        part: int,
        parts: int,
        dropout_scale: float,
    ) -> None:
        self._field = field
        self._config = config
        generator = torch.Generator().manual_seed(config.seed * MAX_THREADS + part)

        def source(rays: Rays) -> _Source:
            share = _share(config.batch_size, part, parts)
            return _Source(rays.every(parts, part), scale, config, share, generator)

        self._surface = source(surface)
        # A ghost has an intensity, though no surface: the sensor will see it again.
        self._returns = self._surface if returns is surface or scale is None else source(returns)
        self._dropouts = (dropout_scale * config.feature_dropout, dropout_scale * config.fourier_dropout)
        self._intensity_batch_size = _share(config.intensity_batch_size, part, parts)

    def geometry_loss(self, touched: list[Touched] | None) -> Tensor:
        samples = self._surface.sampler.batch()
        logit = self._field.logit(samples.points, touched)
        return sdf_loss(logit, samples.sdf_m, self._config.sigma_m)

    def joint_loss(self, touched: list[Touched] | None) -> Tensor:
        samples = self._surface.sampler.batch()
        geometry = self._field.geometry(samples.points, frozen=False, touched=touched)
        loss = sdf_loss(geometry.logit, samples.sdf_m, self._config.sigma_m)
        return self._config.sdf_loss_weight * loss + self._intensity_loss(samples, self._surface, geometry)

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
        # Through normals the loss sees the features twice, which only autograd can take apart.
        self._by_rows = config.row_updates and not (config.joint and config.normals and scale is not None)
        parts = min(workers.num_threads, len(surface), config.batch_size, config.intensity_batch_size)
        samples = len(surface) * (config.near_samples + config.free_samples)
        passes = math.ceil(config.sdf_passes * samples / config.batch_size)
        self._sdf_iterations = (
            max(config.min_sdf_iterations, passes) if config.sdf_iterations is None else config.sdf_iterations
        )
        samples = len(returns) * config.near_samples
        self._intensity_iterations = config.intensity_iterations or max(
            config.min_intensity_iterations,
            math.ceil(config.intensity_passes * samples / config.intensity_batch_size),
        )
        # Where each sample is seen often, there is more to learn by heart. The same dropout for all (0.7 and 0.2) would
        # be as good on sparse scenes, and cost 2 % on a dense one, whose samples are seen twice.
        times_seen = self._intensity_iterations * config.intensity_batch_size / samples
        dropout_scale = times_seen / (times_seen + _DROPOUT_HALF_PASSES)
        self._shards = [
            _Shard(field, surface, returns, scale, config, part, parts, dropout_scale)
            for part in range(parts)
        ]
        if scale is None:
            self._intensity_iterations = 0
        self.iterations = {"sdf": self._sdf_iterations, "intensity": self._intensity_iterations}
        self.losses: dict[str, float] = {}

    def run(self, progress: bool | None) -> None:
        config, field = self._config, self._field
        reflectance = field.intensity_network
        joint = config.joint and reflectance is not None
        rest = max(0, self._intensity_iterations - (self._sdf_iterations if joint else 0))
        with tqdm(
            total=self._sdf_iterations + rest,
            desc="fit",
            unit="it",
            disable=None if progress is None else not progress,
        ) as bar:
            geometry = list(field.sdf_network.parameters())
            rows = None
            if self._by_rows:
                rows = RowAdam(field.cells, config.learning_rate, config.adam_epsilon)
            else:
                geometry = [*field.cells.parameters(), *geometry]
            adams = [Adam(geometry, config.learning_rate, config.adam_epsilon)]
            if reflectance is not None:
                reflectance_adam = Adam(
                    reflectance.parameters(), config.intensity_learning_rate, config.adam_epsilon
                )
                if joint:
                    adams.append(reflectance_adam)
            loss_of = _Shard.joint_loss if joint else _Shard.geometry_loss
            self._loop("sdf", self._sdf_iterations, adams, loss_of, bar, rows)
            field.cells.requires_grad_(False)
            field.sdf_network.requires_grad_(False)
            if reflectance is not None and rest:
                self._loop("intensity", rest, [reflectance_adam], _Shard.reflectance_loss, bar)

    def _loop(
        self,
        name: str,
        iterations: int,
        adams: list[Adam],
        loss_of: Callable[[_Shard, list[Touched] | None], Tensor],
        bar: Any,
        rows: RowAdam | None = None,
    ) -> None:
        parameters = [p for adam in adams for p in adam.parameters]

        def gradients(shard: _Shard) -> _Gradients:
            touched: list[Touched] = []
            loss = loss_of(shard, None if rows is None else touched) / len(self._shards)
            interpolated = [t.interpolated for t in touched]
            found = torch.autograd.grad(loss, [*parameters, *interpolated])
            return _Gradients(loss.detach(), found[: len(parameters)], touched, found[len(parameters) :])

        for i in range(iterations):
            # From the full rate on in each stage, also for an Adam that has been through another.
            share = 0.5 * (1 + math.cos(math.pi * i / iterations)) if self._config.cosine_schedule else 1.0
            found = list(self._workers.map(gradients, self._shards))
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
            bar.update()
            if i % 100 == 0 or i == iterations - 1:
                self.losses[name] = float(sum(part.loss for part in found))
                if not math.isfinite(self.losses[name]):
                    msg = f"the {name} loss is {self.losses[name]} at iteration {i}: a lower learning rate may help"
                    raise FloatingPointError(msg)


def _share(count: int, part: int, parts: int) -> int:
    """`count` things over `parts`: how many the `part`-th gets."""
    return count * (part + 1) // parts - count * part // parts
