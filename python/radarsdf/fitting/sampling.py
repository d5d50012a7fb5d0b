# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Samples along rays with their labels, drawn as they are needed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from radarsdf._core import RAY_DIRECTION, RAY_INTENSITY, RAY_POINT, RAY_RANGE, cell_keys
from radarsdf.config import FitConfig
from radarsdf.returns.rays import Rays


@dataclass(frozen=True)
class Samples:
    """A batch of points on rays. The near-surface ones come first."""

    points: Tensor
    """(B, 3) float32, local frame, m."""
    sdf_m: Tensor
    """(B,) distance along the ray to the return, positive in front of it."""
    num_near: int
    """The first `num_near` are near the surface, the others in free space."""
    of_ray: Tensor
    """(B, 7 or 8): return (3), direction (3), range and, where there are any, scaled intensity of each sample's ray."""

    @property
    def directions(self) -> Tensor:
        """(B, 3) unit vectors from the sensor to the return."""
        return _directions(self.of_ray)

    @property
    def ranges_m(self) -> Tensor:
        """(B,) from the sensor to the return."""
        return self.of_ray[:, RAY_RANGE]

    @property
    def intensities(self) -> Tensor:
        """(B,) of the returns, scaled."""
        return self.of_ray[:, RAY_INTENSITY]


class RaySampler:
    """Draws batches from rays: memory grows with the returns, not with the samples.

    Rays are taken in random order without replacement, so that after one pass each has been seen equally often; the
    positions along the rays are random. A batch takes one near-surface and one free-space sample from each of its rays
    rather than all twelve from a twelfth as many: the gradient sees more of the scene. Within a batch, rays go in
    Morton order of their returns, so that neighbours share cache lines. `neighbours` rays that follow each other in that
    order are taken together: in large batches of a large map, no two others would be near. `intensities` (N,) are those of
    the rays, scaled.
    """

    def __init__(
        self,
        rays: Rays,
        config: FitConfig,
        batch_size: int,
        generator: torch.Generator,
        neighbours: int = 1,
        intensities: Tensor | None = None,
    ) -> None:
        self._config = config
        self._neighbours = neighbours
        self._generator = generator
        order = np.argsort(cell_keys(np.ascontiguousarray(rays.points), config.leaf_size_m, 1), kind="stable")
        # One gather a batch fetches all there is to know of a ray: 32 bytes, half a cache line.
        columns = [torch.from_numpy(a) for a in (rays.points, rays.directions, rays.ranges_m[:, None])]
        if intensities is not None:
            columns.append(intensities[:, None])
        self._rays = torch.cat(columns, 1)[torch.from_numpy(order)]
        self._order = np.zeros(0, np.int64)
        self._order_from = torch.zeros_like(generator.get_state())
        """The generator's state that `_order` was drawn from."""
        self._next = 0
        near_share = config.sampling.near_samples / (
            config.sampling.near_samples + config.sampling.free_samples
        )
        self._num_near = max(1, round(batch_size * near_share))
        self._num_free = batch_size - self._num_near
        self._layouts: dict[int, _Layout] = {}

    def state(self) -> dict[str, Tensor]:
        """Where in which order of the rays it is; the generator is its owner's."""
        drawn = len(self._order) > 0
        return {"order_from": self._order_from, "next": torch.tensor(self._next if drawn else -1)}

    def restore(self, state: dict[str, Tensor]) -> None:
        """Go on as the sampler of the same rays that gave `state`; leaves the generator in another state."""
        following = int(state["next"])
        if not -1 <= following <= len(self._rays):
            msg = f"a sampler of {len(self._rays)} rays is at none of them"
            raise ValueError(msg)
        if following >= 0:
            self._generator.set_state(state["order_from"])
            self._draw_order()
            self._next = following

    def _draw_order(self) -> None:
        self._order_from = self._generator.get_state()
        runs = torch.randperm(-(-len(self._rays) // self._neighbours), generator=self._generator).numpy()
        order = (runs[:, None] * self._neighbours + np.arange(self._neighbours)).ravel()
        self._order = order[order < len(self._rays)]
        self._next = 0

    def _take(self, count: int) -> Tensor:
        """The next `count` rays of the random order, sorted; a new order begins where one ends."""
        parts = []
        while count > 0:
            if self._next >= len(self._order):
                self._draw_order()
            part = self._order[self._next : self._next + count]
            self._next += len(part)
            count -= len(part)
            parts.append(part)
        return torch.from_numpy(np.sort(np.concatenate(parts)))

    def _uniform(self, count: int) -> Tensor:
        return torch.rand(count, generator=self._generator)

    def spread(self, count: int, parts: int = 1) -> list[Samples]:
        """`count` samples round returns, in parts: within `near_band_m` along the beam, and across it as angular noise is."""
        config = self._config
        places = self._take(count)
        sdf_m = (2 * self._uniform(count) - 1) * config.near_band_m
        ray = self._rays.index_select(0, places)
        points = _returns(ray) - sdf_m[:, None] * _directions(ray)
        if config.sampling.cross_range_noise_rad > 0:
            # Isotropic: what it adds along the beam is lost in the width of the band.
            noise = torch.randn(points.shape, generator=self._generator)
            points += noise * (config.sampling.cross_range_noise_rad * ray[:, RAY_RANGE, None])
        near = [share(count, part, parts) for part in range(parts)]
        return self._split(points, sdf_m, ray, near, near)

    def batch(self, parts: int = 1) -> list[Samples]:
        """`batch_size` samples, near the surface and in free space, in parts that each have their share of both."""
        if parts not in self._layouts:
            self._layouts[parts] = _Layout.of(self._num_near, self._num_free, parts, self._config)
        layout = self._layouts[parts]
        places = self._take(max(self._num_near, self._num_free)).index_select(0, layout.index)
        ray = self._rays.index_select(0, places)
        range_m = ray[:, RAY_RANGE]
        start_m, length_m = (
            torch.addcmul(constant, of_range, range_m) for constant, of_range in (layout.start, layout.length)
        )
        # Drawn for the batch, and then dealt out: the number of parts changes no sample.
        sdf_m = torch.addcmul(start_m, length_m, self._uniform(len(places)).index_select(0, layout.order))
        points = torch.addcmul(_returns(ray), sdf_m[:, None], _directions(ray), value=-1)
        return self._split(points, sdf_m, ray, layout.sizes, layout.near)

    def _split(
        self,
        points: Tensor,
        sdf_m: Tensor,
        ray: Tensor,
        sizes: Sequence[int],
        near: Sequence[int],
    ) -> list[Samples]:
        if len(sizes) == 1:
            return [Samples(points, sdf_m, near[0], ray)]
        columns = [torch.split_with_sizes(column, sizes) for column in (points, sdf_m, ray)]
        return [
            Samples(x, sdf, num_near, of_ray) for x, sdf, of_ray, num_near in zip(*columns, near, strict=True)
        ]


def _returns(rays: Tensor) -> Tensor:
    return rays[:, RAY_POINT:RAY_DIRECTION]


def _directions(rays: Tensor) -> Tensor:
    return rays[:, RAY_DIRECTION:RAY_RANGE]


def share(count: int, part: int, parts: int) -> int:
    """`count` things over `parts`: how many the `part`-th gets."""
    return count * (part + 1) // parts - count * part // parts


@dataclass(frozen=True)
class _Layout:
    """Which samples a batch has: part by part, the near ones of each first."""

    index: Tensor
    """(B,) int64, of each sample's ray among those that were taken."""
    order: Tensor
    """(B,) int64, of each sample among the near and then the free ones of the whole batch."""
    start: tuple[Tensor, Tensor]
    """(B,) each: c and d of the end nearest to the return, c + d · range, as a distance in front of it, m."""
    length: tuple[Tensor, Tensor]
    """The same, from there to the other end."""
    sizes: list[int]
    """Of the parts."""
    near: list[int]
    """Near samples of the parts."""

    @classmethod
    def of(cls, num_near: int, num_free: int, parts: int, config: FitConfig) -> _Layout:
        taken = max(num_near, num_free)
        shares = [[share(n, part, parts) for part in range(parts)] for n in (num_near, num_free)]
        sizes = [size for part in zip(*shares, strict=True) for size in part]  # near, free, near, free, ...
        kinds = torch.tensor([0, 1] * parts).repeat_interleave(torch.tensor(sizes))
        order = kinds.argsort(stable=True).argsort()
        # Where one kind is rarer, every so many-th ray has one of it: each kind still covers the whole scene.
        index = torch.cat([torch.arange(n) * taken // max(n, 1) for n in (num_near, num_free)])[order]
        # Near samples within the band; free ones uniform in [free_from · range, range + free_beyond] from the sensor.
        band_m, before = config.near_band_m, 1 - config.sampling.free_from
        ends = torch.tensor(
            [[-band_m, 0, 2 * band_m, 0], [-config.free_beyond_m, 0, config.free_beyond_m, before]]
        )[kinds]
        start, of_range, length, length_of_range = ends.T.contiguous()
        sums = [sum(part) for part in zip(*shares, strict=True)]
        return cls(index, order, (start, of_range), (length, length_of_range), sums, shares[0])


@dataclass(frozen=True)
class Dropout:
    """Which numbers of a matrix stay.

    Not torch's own dropout, which draws from the global generator: the same seed would not give the same bits.
    """

    bytes: Tensor
    """(rows, columns) uint8, drawn for each number."""
    keep: int
    """What is below it stays."""

    @classmethod
    def draw(cls, rows: int, columns: int, dropout: float, generator: torch.Generator) -> Dropout:
        """For a matrix of which each number is left out with the probability `dropout`."""
        # Eight bytes from every number drawn: drawing one for each would take a tenth of an iteration.
        words = torch.empty(-(-rows * columns // 8), dtype=torch.int64).random_(
            -(2**63), None, generator=generator
        )
        return cls(words.view(torch.uint8)[: rows * columns].view(rows, columns), round(256 * (1 - dropout)))

    @property
    def factors(self) -> Tensor:
        """(rows, columns) of mean one: zero, or what makes up for the zeros."""
        return (self.bytes <= self.keep - 1) * (256 / self.keep)  # not < keep: 256 is no byte
