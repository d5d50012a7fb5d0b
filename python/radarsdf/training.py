# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The training loop: batches over threads, losses, and the schedule of the two networks."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from radarsdf.config import MAX_THREADS, FitConfig
from radarsdf.field import Field
from radarsdf.losses import intensity_loss, sdf_loss
from radarsdf.map import IntensityScale
from radarsdf.optimiser import Adam
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

    def geometry_loss(self) -> Tensor:
        samples = self._surface.sampler.batch()
        return sdf_loss(self._field.logit(samples.points), samples.sdf_m, self._config.sigma_m)

    def joint_loss(self) -> Tensor:
        samples = self._surface.sampler.batch()
        loss = sdf_loss(self._field.logit(samples.points), samples.sdf_m, self._config.sigma_m)
        return self._config.sdf_loss_weight * loss + self._intensity_loss(
            samples, self._surface, geometry_frozen=False
        )

    def reflectance_loss(self) -> Tensor:
        if self._config.intensity_in_free_space:
            samples = self._returns.sampler.batch()
        else:
            samples = self._returns.sampler.spread(self._intensity_batch_size)
        return self._intensity_loss(samples, self._returns, geometry_frozen=True)

    def _intensity_loss(self, samples: Samples, source: _Source, *, geometry_frozen: bool) -> Tensor:
        assert source.intensities is not None
        used = slice(None) if self._config.intensity_in_free_space else slice(samples.num_near)
        rays = samples.rays[used]
        labels = source.intensities[rays]
        labels[samples.num_near :] = 0  # no return is expected from free space (3QFPI)
        predicted = self._field.intensity(
            samples.points[used],
            source.directions[rays],
            source.ranges_m[rays] - samples.sdf_m[used],
            geometry_frozen=geometry_frozen,
            encoding_factors=self._encoding_factors(len(rays)),
        )
        return intensity_loss(predicted, labels)

    def _encoding_factors(self, count: int) -> Tensor | None:
        """Dropout of the encoding for `count` samples, which the SDF network is spared."""
        if not any(self._dropouts):
            return None
        dims = (self._field.cells.dim, self._field.fourier.dim)
        kept = [self._surface.sampler.kept(count, *part) for part in zip(dims, self._dropouts, strict=True)]
        return torch.cat(kept, 1)


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
        parts = min(workers.num_threads, len(surface), config.batch_size, config.intensity_batch_size)
        self._sdf_iterations = _sdf_iterations(len(surface), config)
        samples = len(returns) * config.near_samples
        self._intensity_iterations = config.intensity_iterations or max(
            config.min_intensity_iterations,
            math.ceil(config.intensity_passes * samples / config.intensity_batch_size),
        )
        # Where each sample is seen often, there is more to learn by heart. The same dropout for all (0.7 and 0.2) would
        # be as good on sparse scenes, and cost 2 % on a dense one, whose samples are seen twice.
        passes = self._intensity_iterations * config.intensity_batch_size / samples
        dropout_scale = passes / (passes + _DROPOUT_HALF_PASSES)
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
            geometry = [*field.cells.parameters(), *field.sdf_network.parameters()]
            adams = [Adam(geometry, config.learning_rate, config.adam_epsilon)]
            if reflectance is not None:
                reflectance_adam = Adam(
                    reflectance.parameters(), config.intensity_learning_rate, config.adam_epsilon
                )
                if joint:
                    adams.append(reflectance_adam)
            loss_of = _Shard.joint_loss if joint else _Shard.geometry_loss
            self._loop("sdf", self._sdf_iterations, adams, loss_of, bar)
            field.cells.requires_grad_(False)
            field.sdf_network.requires_grad_(False)
            if reflectance is not None and rest:
                self._loop("intensity", rest, [reflectance_adam], _Shard.reflectance_loss, bar)

    def _loop(
        self,
        name: str,
        iterations: int,
        adams: list[Adam],
        loss_of: Callable[[_Shard], Tensor],
        bar: Any,
    ) -> None:
        parameters = [p for adam in adams for p in adam.parameters]

        def loss_and_gradients(shard: _Shard) -> tuple[Tensor, tuple[Tensor, ...]]:
            loss = loss_of(shard) / len(self._shards)
            return loss.detach(), torch.autograd.grad(loss, parameters)

        for i in range(iterations):
            # From the full rate on in each stage, also for an Adam that has been through another.
            share = 0.5 * (1 + math.cos(math.pi * i / iterations)) if self._config.cosine_schedule else 1.0
            losses, gradients = zip(*self._workers.map(loss_and_gradients, self._shards), strict=True)
            total = iter([functools.reduce(Tensor.add_, parts) for parts in zip(*gradients, strict=True)])
            for adam in adams:
                adam.learning_rate = share * adam.full_rate
                adam.step(list(itertools.islice(total, len(adam.parameters))))
            bar.update()
            if i % 100 == 0 or i == iterations - 1:
                self.losses[name] = float(sum(losses))
                if not math.isfinite(self.losses[name]):
                    msg = f"the {name} loss is {self.losses[name]} at iteration {i}: a lower learning rate may help"
                    raise FloatingPointError(msg)


def _sdf_iterations(num_returns: int, config: FitConfig) -> int:
    """How many iterations the surface gets: too few leave it unfinished, too many passes learn its noise."""
    one_pass = num_returns * (config.near_samples + config.free_samples) / config.batch_size
    return config.sdf_iterations or max(
        config.min_sdf_iterations,
        math.ceil(config.sdf_passes * one_pass),
        min(config.enough_sdf_iterations, math.ceil(config.max_sdf_passes * one_pass)),
    )


def _share(count: int, part: int, parts: int) -> int:
    """`count` things over `parts`: how many the `part`-th gets."""
    return count * (part + 1) // parts - count * part // parts
