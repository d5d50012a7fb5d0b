"""Samples along rays: labels are geometric, and all rays are sampled equally."""

import tracemalloc
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from radarsdf import FitConfig, _core
from radarsdf.fitting.sampling import Dropout, RaySampler
from radarsdf.returns.rays import prepare

from ..conftest import pose
from ..settings import grouped

NUM_RAYS = 1000
NEAR_M = 0.3  # of the default


@pytest.fixture(scope="module")
def rays():
    rng = np.random.default_rng(0)
    points = [rng.normal(size=(NUM_RAYS // 4, 3)) * [20, 20, 2] + 0.5 for _ in range(4)]
    return prepare(points, np.stack([pose([10.0 * i, i, 1], 0.3 * i) for i in range(4)]))


def sampler(rays, batch_size=256, seed=0, neighbours=1, **settings):
    config = FitConfig(**grouped(**settings))
    return RaySampler(rays, config, batch_size, torch.Generator().manual_seed(seed), neighbours)


def rows_of(points, samples):
    """(B,) row in `points` of each sample's return; returns are distinct."""
    rows = {point.tobytes(): row for row, point in enumerate(points)}
    return torch.tensor([rows[point.tobytes()] for point in samples.of_ray[:, :3].numpy()])


def sensors_of(rays, samples):
    index = rows_of(rays.points, samples).numpy()
    points = rays.points[index].astype(np.float64)
    return points, points - rays.directions[index].astype(np.float64) * rays.ranges_m[index, None]


def split(batch):
    """Samples of each part of a batch, as tensors."""
    sizes, labelled = zip(*batch.parts, strict=True)
    columns = [torch.from_numpy(c).split(sizes) for c in (batch.points, batch.sdf_m, batch.of_ray)]
    names = ("points", "sdf_m", "of_ray", "num_labelled")
    return [
        SimpleNamespace(**dict(zip(names, of, strict=True))) for of in zip(*columns, labelled, strict=True)
    ]


DRAWS = {"batch": lambda draw: split(draw.batch())[0], "spread": lambda draw: split(draw.spread(256))[0]}


@pytest.mark.parametrize("kind", DRAWS)
def test_labels_are_the_signed_distance_to_the_return(rays, kind):
    samples = DRAWS[kind](sampler(rays, cross_range_noise_rad=0.0))
    returns, sensors = sensors_of(rays, samples)
    points, sdf_m = samples.points.numpy().astype(np.float64), samples.sdf_m.numpy()
    np.testing.assert_allclose(np.linalg.norm(points - returns, axis=1), np.abs(sdf_m), atol=2e-5)
    # Positive between sensor and return: the sample is nearer to the sensor by this distance.
    to_sample, to_return = (np.linalg.norm(p - sensors, axis=1) for p in (points, returns))
    np.testing.assert_allclose(to_return - to_sample, sdf_m, atol=2e-5)
    assert (sdf_m > 0).any()
    assert (sdf_m < 0).any()


def test_ranges_of_the_samples(rays):
    draw = sampler(rays, 512)
    near, free, lowest_share = [], [], []
    for _ in range(40):
        samples = split(draw.batch())[0]
        range_m = torch.from_numpy(rays.ranges_m)[rows_of(rays.points, samples)][256:]
        near.append(samples.sdf_m[:256])
        from_sensor = range_m - samples.sdf_m[256:]
        free.append((from_sensor - 0.3 * range_m) / (0.7 * range_m + 0.8))
        lowest_share.append((from_sensor / range_m).min())
    # Uniform over each whole interval, and not beyond.
    near, free = torch.cat(near) / NEAR_M, torch.cat(free)
    assert -1 <= near.min() < -0.99
    assert 0.99 < near.max() <= 1
    assert -1e-5 <= free.min() < 0.01
    assert 0.99 < free.max() <= 1 + 1e-5
    assert near.var().item() == pytest.approx(1 / 3, rel=0.05)
    assert free.var().item() == pytest.approx(1 / 12, rel=0.05)
    assert min(lowest_share) >= 0.3 - 1e-5


@pytest.mark.parametrize(("batch_size", "neighbours"), [(100, 1), (128, 7), (1000, 1)])
def test_each_ray_is_sampled_equally_often(rays, batch_size, neighbours):
    draw = sampler(rays, batch_size, neighbours=neighbours)
    seen = np.zeros((2, NUM_RAYS), int)
    batches = 4 * NUM_RAYS * 2 // batch_size
    for _ in range(batches):
        samples = split(draw.batch())[0]
        rows = rows_of(rays.points, samples)
        for kind, part in enumerate((rows[: batch_size // 2], rows[batch_size // 2 :])):
            np.add.at(seen[kind], part.numpy(), 1)
    assert seen.sum() == batches * batch_size
    # Complete passes, and the current one.
    whole = batches * (batch_size // 2) // NUM_RAYS
    assert set(np.unique(seen)) <= {whole, whole + 1}


@pytest.mark.parametrize("kind", DRAWS)
def test_memory_of_a_batch_is_independent_of_the_number_of_rays(rays, kind):
    many = rays.select(np.arange(300 * NUM_RAYS) % NUM_RAYS)
    draw = sampler(many)
    DRAWS[kind](draw)  # draws the order of all rays
    tracemalloc.start()  # NumPy's arrays are traced, PyTorch's tensors are not
    DRAWS[kind](draw)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < len(many)  # bytes


def test_spread_samples_lie_across_the_beam_as_angular_noise_does(rays):
    samples = split(sampler(rays, cross_range_noise_rad=0.02).spread(20 * NUM_RAYS))[0]
    index = rows_of(rays.points, samples).numpy()
    offset = samples.points.numpy() - rays.points[index]
    along = (offset * rays.directions[index]).sum(axis=1)
    across = offset - along[:, None] * rays.directions[index]
    angle_rad = np.linalg.norm(across, axis=1) / rays.ranges_m[index]
    assert np.sqrt((angle_rad**2).mean() / 2) == pytest.approx(0.02, rel=0.02)  # two axes across the beam


@pytest.mark.parametrize("parts", [1, 3])
def test_the_number_of_intensity_labels_is_limited(rays, parts):
    """They are distributed over the batch, and over adjacent samples."""
    config = FitConfig(training={"intensity_batch_size": 24})
    generator, unit = torch.Generator().manual_seed(0), torch.linspace(0, 1, NUM_RAYS)
    draw = RaySampler(rays, config, 288, generator, 6, unit)
    batches = [split(draw.batch(parts)) for _ in range(NUM_RAYS // 24 * 12)]
    assert {sum(part.num_labelled for part in batch) for batch in batches} == {24}
    for batch in batches[:5]:
        for part in batch:
            near = 144 // parts
            assert (part.sdf_m[:near].abs() <= NEAR_M).all()
            assert (part.sdf_m[near:].abs() > NEAR_M).float().mean() > 0.8
            assert 0 <= part.num_labelled - 24 // parts <= 1
    labelled = torch.cat(
        [part.of_ray[: part.num_labelled, _core.RAY_INTENSITY] for batch in batches for part in batch]
    )
    assert len(torch.unique(labelled)) > 0.9 * NUM_RAYS
    # All near samples are labelled without intensities, and if free space has its own label.
    assert split(RaySampler(rays, config, 288, generator).batch())[0].num_labelled == 144
    free = config.override(training={"intensity_in_free_space": True})
    assert split(RaySampler(rays, free, 288, generator, 1, unit).batch())[0].num_labelled == 144


@pytest.mark.parametrize("parts", [2, 3])
def test_parts_partition_the_batch(rays, parts):
    (whole,) = split(sampler(rays, 250).batch())
    found = split(sampler(rays, 250).batch(parts))
    sizes, near = [len(part.points) for part in found], [part.num_labelled for part in found]
    for counts, total in ((sizes, 250), (near, 125)):  # without intensities, all near samples have labels
        assert sum(counts) == total
        assert max(counts) - min(counts) <= 2
    # The same rays and the same random numbers, each kind in the same order.
    sdf_m = [part.sdf_m[: part.num_labelled] for part in found] + [
        part.sdf_m[part.num_labelled :] for part in found
    ]
    assert torch.equal(torch.cat(sdf_m), whole.sdf_m)
    near = torch.cat([part.of_ray[: part.num_labelled] for part in found])
    free = torch.cat([part.of_ray[part.num_labelled :] for part in found])
    assert torch.equal(torch.cat([near, free]), whole.of_ray)
    for part in found:
        rows = rows_of(rays.points, part)
        assert torch.equal(part.of_ray[:, _core.RAY_RANGE], torch.from_numpy(rays.ranges_m)[rows])
        assert (part.sdf_m[: part.num_labelled].abs() <= NEAR_M).all()
        directions = part.of_ray[:, _core.RAY_DIRECTION : _core.RAY_RANGE]
        gap = part.points + part.sdf_m[:, None] * directions - torch.from_numpy(rays.points)[rows]
        assert gap.abs().max() < 2e-5


@pytest.mark.parametrize("dropout", [0.0, 0.3, 0.85])
def test_dropout_zeroes_its_rate_and_keeps_the_mean(dropout):
    state = torch.get_rng_state()
    factors = Dropout.draw(dropout, torch.Generator().manual_seed(0)).factors(999, 21)
    assert factors.shape == (999, 21)
    assert factors.dtype == torch.float32
    assert abs(float((factors == 0).float().mean()) - dropout) < 0.015
    assert abs(float(factors.mean()) - 1) < 0.05
    assert len(factors.unique()) == (1 if dropout == 0 else 2)
    again, other = (
        Dropout.draw(dropout, torch.Generator().manual_seed(seed)).factors(999, 21) for seed in (0, 1)
    )
    assert torch.equal(factors, again)
    assert not torch.equal(factors, other) or dropout == 0
    assert torch.equal(torch.get_rng_state(), state)
