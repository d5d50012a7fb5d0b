"""Sampling of labelled points on rays, on demand."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from radarsdf import core
from radarsdf.arrays import Bytes, Floats32, Ints, Ints32
from radarsdf.checks import check
from radarsdf.config.fit_config import FitConfig
from radarsdf.returns.rays import Rays

NEAR_SAMPLES, FREE_SAMPLES = 6, 6
"""Samples near the surface and in free space for each return in one pass (3QFPI: 6 and 6)."""
NEAR_BAND_CELLS = 1.5
"""Samples near the surface are uniform within this distance of the return, leaf cells (3QFP: 0.3 m)."""
FREE_FROM = 0.3
"""Samples in free space begin at this share of the range (3QFP: 0.3)."""
FREE_BEYOND_CELLS = 4.0
"""Samples in free space end this far behind the return, leaf cells (3QFP: 0.8 m)."""
_GOLDEN = 0.6180339887498949  # multiples of it are spread evenly over an interval of length 1


def near_and_labelled(config: FitConfig, batch_size: int) -> tuple[int, int]:
    """Return the number of near-surface samples in a batch of the sdf stage, and how many have intensity labels.

    The intensity network needs no more of them in a large batch than in a batch of its own stage.
    """
    near = max(1, round(batch_size * (NEAR_SAMPLES / (NEAR_SAMPLES + FREE_SAMPLES))))
    training = config.training
    # With labels in free space, an unlabelled near sample would get the label of free space.
    return near, near if training.intensity_in_free_space else min(near, training.intensity_batch_size)


@dataclass(frozen=True)
class Batch:
    """B samples on rays, in consecutive parts, each with the samples near the surface first. One thread processes each part."""

    points: Floats32  # (B, 3) local frame, m
    sdf_m: Floats32  # (B,) label: distance along the ray to the return, m, positive in front of it
    of_ray: Floats32  # (B, 7 or 8) return (3), local, m; direction (3); range, m; optionally scaled intensity
    parts: list[tuple[int, int]]
    """Numbers of samples and of leading samples with intensity labels of each part."""


class RaySampler:
    """Draw batches of samples from N rays, with scaled intensities (N,) or None.

    Rays are drawn in random order without replacement, with random positions on them. A batch has one sample near the
    surface and one in free space on each of its rays, instead of all twelve on a twelfth of the rays, so its gradient covers
    more of the scene. Runs of `neighbours` rays, consecutive in Morton order of their returns, are drawn together: in a large
    map, the rays of a batch would otherwise share no cache lines. The caller saves the state of the `generator`.
    """

    def __init__(
        self,
        rays: Rays,
        config: FitConfig,
        batch_size: int,
        generator: torch.Generator,
        neighbours: int = 1,
        intensities: Floats32 | None = None,
        num_threads: int = 1,
    ) -> None:
        self._config = config
        self._neighbours = neighbours
        self._generator = generator
        self._rays = _in_morton_order(rays, intensities, config.leaf_size_m, num_threads)
        self._runs = np.zeros(0, np.int32)  # runs of neighbours, in random order
        self._next = 0  # position of the next ray in that order
        self._order_from = generator.get_state()  # before the order was drawn
        near, labelled = near_and_labelled(config, batch_size)
        # Labelled samples come first; a batch without labels is in Morton order.
        self._counts = (near if intensities is None else labelled, near, batch_size - near)
        self._layouts: dict[tuple[int, ...], _Layout] = {}

    def state(self) -> dict[str, Tensor]:
        """Return the order of the rays, as a generator state, and the position in it: 0 before an order is drawn."""
        following = torch.tensor(self._next, dtype=torch.int64, device="cpu")
        return {"order_from": self._order_from, "next": following}

    def restore(self, order_from: Tensor, following: int) -> None:
        fits = 0 <= following <= len(self._rays) + self._neighbours
        check(fits, f"a sampler of {len(self._rays)} rays cannot be at ray {following}")
        if following > 0:
            self._generator.set_state(order_from)
            self._draw_order()
            self._next = following

    def _draw_order(self) -> None:
        self._order_from = self._generator.get_state()
        count = -(-len(self._rays) // self._neighbours)
        runs = torch.randperm(count, generator=self._generator, dtype=torch.int32, device="cpu")
        self._runs, self._next = runs.numpy(), 0

    def _take(self, count: int) -> Ints:
        """Return the rows of the next `count` rays of the random order, ascending: in Morton order of their returns."""
        # A whole pass takes every ray once, in any order: with few rays, a batch would draw hundreds of permutations.
        passes, count = divmod(count, len(self._rays))
        parts = [np.repeat(np.arange(len(self._rays)), passes)] if passes else []
        while count > 0:
            if self._next >= len(self._runs) * self._neighbours:
                self._draw_order()
            places = np.arange(self._next, min(self._next + count, len(self._runs) * self._neighbours))
            run, of_run = np.divmod(places, self._neighbours)
            part = self._runs[run] * np.int64(self._neighbours) + of_run
            self._next += len(part)
            part = part[part < len(self._rays)]  # the last run may be shorter
            count -= len(part)
            parts.append(part)
        return np.sort(np.concatenate(parts))

    def spread(self, count: int, parts: int = 1) -> Batch:
        """Draw `count` samples in the near band, in `parts`, with the sensor's angular noise across the beam."""
        batch, noise_rad = self._draw((count, count, 0), parts), self._config.training.cross_range_noise_rad
        if noise_rad > 0:
            # Isotropic noise is simpler. Along the beam it is small compared with the width of the band.
            noise = torch.randn(count, 3, generator=self._generator, dtype=torch.float32, device="cpu")
            batch.points[:] += noise.numpy() * (noise_rad * batch.of_ray[:, core.RAY_RANGE, None])
        return batch

    def batch(self, parts: int = 1) -> Batch:
        """Draw `batch_size` samples, in `parts`, each with its share of near and free samples."""
        return self._draw(self._counts, parts)

    def _draw(self, counts: tuple[int, int, int], parts: int) -> Batch:
        if (key := (*counts, parts)) not in self._layouts:
            self._layouts[key] = _Layout.of(counts, parts, self._config)
        layout, places, seed = self._layouts[key], self._take(max(counts)), draw_seed(self._generator)
        of_samples = layout.ray, layout.number, layout.kind, layout.segments
        return Batch(*core.draw_samples(self._rays, places, *of_samples, seed), layout.parts)


def _in_morton_order(rays: Rays, values: Floats32 | None, leaf_size_m: float, num_threads: int) -> Floats32:
    """Return :attr:`Batch.of_ray` for all rays, in Morton order of their returns."""
    # A ray is one row of 32 bytes, half a cache line: a batch reads it by one gather.
    order = core.stable_order(core.cell_keys(np.ascontiguousarray(rays.points), leaf_size_m, num_threads))
    columns = [rays.points, rays.directions, rays.ranges_m[:, None]]
    if values is not None:
        columns.append(values[:, None])
    rows = np.empty((len(rays), sum(column.shape[1] for column in columns)), np.float32)
    core.gather_rows([np.ascontiguousarray(column) for column in columns], order, rows, num_threads)
    return rows


@dataclass(frozen=True)
class _Layout:
    """Layout of the B samples of a batch, each uniform on a segment of its ray: by part, near samples first."""

    ray: Ints32  # (B,) row of each sample's ray among the rays drawn
    # (B,) index of its random number: its row with all near samples of the batch first, so that samples do not depend on `parts`
    number: Ints32
    kind: Bytes  # (B,) row of its segment
    segments: Floats32  # (2, 4) of near and free samples, see the core's ``draw_samples``
    parts: list[tuple[int, int]]  # see :class:`Batch`

    @classmethod
    def of(cls, counts: tuple[int, int, int], parts: int, config: FitConfig) -> "_Layout":
        """Build from `counts` of labelled near samples, all near samples and free samples."""
        num_labelled, num_near, num_free = counts
        taken = max(num_near, num_free)
        # The less frequent kind is spread evenly over the rays, so that it covers the whole scene too.
        near_rays, free_rays = (np.arange(n) * taken // max(n, 1) for n in (num_near, num_free))
        # The labelled ones are evenly spaced, with jitter, since rays are drawn in runs.
        jittered = np.arange(num_labelled) + np.arange(num_labelled) * _GOLDEN % 1
        labelled = np.minimum(jittered * num_near // max(num_labelled, 1), num_near - 1)
        chosen = np.zeros(num_near, np.bool_)
        chosen[labelled.astype(np.int64)] = True
        of_kinds = [near_rays[chosen], near_rays[~chosen], free_rays]
        shares = [np.diff(np.arange(parts + 1) * len(kind) // parts).tolist() for kind in of_kinds]
        sizes = [size for part in zip(*shares, strict=True) for size in part]
        kinds = np.repeat(np.tile([0, 1, 2], parts), sizes)
        number = kinds.argsort(kind="stable").argsort().astype(np.int32)
        ray = np.concatenate(of_kinds).astype(np.int32)[number]
        # From the return to the sensor: near samples in ± near_band, free ones in [-free_beyond, (1 - free_from) · range].
        band_m, beyond_m = config.metres(NEAR_BAND_CELLS), config.metres(FREE_BEYOND_CELLS)
        rows = [[-band_m, 0, 2 * band_m, 0], [-beyond_m, 0, beyond_m, 1 - FREE_FROM]]
        segments = np.array(rows, np.float32)
        sizes_and_labels = [(sum(part), part[0]) for part in zip(*shares, strict=True)]
        return cls(ray, number, (kinds == 2).astype(np.uint8), segments, sizes_and_labels)


def draw_seed(generator: torch.Generator) -> int:
    return int(torch.empty((), dtype=torch.int64, device="cpu").random_(generator=generator))


@dataclass(frozen=True)
class Dropout:
    """Dropout mask of a matrix. PyTorch's own dropout draws from the global generator."""

    seed: int  # seed of the random bytes, one for each element of the matrix
    keep: int  # elements with a byte below this are kept, from 1 to 256

    @classmethod
    def draw(cls, dropout: float, generator: torch.Generator) -> "Dropout":
        """Draw a seed. `dropout`: probability that an element is dropped."""
        return cls(draw_seed(generator), round(256 * (1 - dropout)))

    def factors(self, rows: int, columns: int) -> Tensor:
        """Return factors (rows, columns): 0 for dropped elements, 256 / keep for the others, so that the mean is 1."""
        bytes_ = core.random_bytes(self.seed, rows, columns)
        # not < keep: 256 does not fit into a byte
        return torch.from_numpy(bytes_ <= self.keep - 1).float() * (256 / self.keep)
