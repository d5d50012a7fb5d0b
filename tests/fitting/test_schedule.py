# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Batches and iterations follow the size of the data."""

import pytest
from radarsdf import FitConfig
from radarsdf.fitting.schedule import Schedule

from ..settings import grouped


def schedule(returns, vertices=10**9, *, with_intensity=True, **changes):
    config = FitConfig(**grouped(**changes))
    return Schedule.of(
        config, surface_returns=returns, returns=returns, vertices=vertices, with_intensity=with_intensity
    )


@pytest.mark.parametrize(
    ("returns", "changes", "expected"),
    [
        (100_000, {}, 180),  # half a pass is nearly enough
        (200_000, {}, 352),  # and here more than enough
        (50_000, {}, 176),  # a pass is not enough, and still all that the data gives
        (2_000, {}, 150),  # without so many iterations there is no surface
        (2_000, {"effort": 1e-9}, 1),
        (20_000, {"sdf_iterations": 7, "effort": 3.0}, 7),
    ],
)
def test_iterations_until_the_surface_is_finished_but_its_noise_not_learnt(returns, changes, expected):
    assert schedule(returns, 10**6, **changes).sdf_iterations == expected


def test_without_training_there_are_none():
    assert schedule(10**5, train=False).iterations == {"sdf": 0, "intensity": 0}


def test_many_returns_in_few_cells_take_no_more_iterations_than_their_vertices_need():
    assert schedule(10**6).sdf_iterations == pytest.approx(0.6 * 12e6 / 4096, abs=1)
    assert schedule(10**6, vertices=50_000).sdf_iterations == pytest.approx(20 * 50_000 / 4096, abs=1)
    assert schedule(10**6, vertices=100_000).sdf_iterations == 300
    assert schedule(10**6, vertices=300_000).sdf_iterations == pytest.approx(10 * 300_000 / 4096, abs=1)
    assert schedule(10**6, vertices=100).sdf_iterations == 150


def test_batches_grow_where_iterations_would_be_too_many():
    many = schedule(10**7)
    assert many.sdf_iterations == 5000
    assert many.sdf_iterations * many.batch_size == pytest.approx(0.6 * 12e7, rel=1e-3)
    assert many.neighbours == many.batch_size // FitConfig().training.batch_size > 1
    assert schedule(10**6).batch_size == FitConfig().training.batch_size
    assert schedule(10**6).neighbours == 1


def test_a_small_scene_trains_its_intensities_for_long_and_with_more_dropout():
    small, large = schedule(10_000), schedule(10**6)
    assert small.intensity_iterations == 500
    assert 0 < large.dropout_scale < 0.5 < small.dropout_scale < 1
    assert schedule(10_000, with_intensity=False).iterations["intensity"] == 0


@pytest.mark.parametrize("returns", [2000, 10**5, 5 * 10**5])
def test_effort_multiplies_the_iterations(returns):
    half, whole, twice = (schedule(returns, effort=effort) for effort in (0.5, 1.0, 2.0))
    for one, other in ((half, whole), (whole, twice)):
        assert 2 * one.sdf_iterations == pytest.approx(other.sdf_iterations, abs=1)
        assert other.passes == pytest.approx(2 * one.passes, rel=0.01)
        assert other.intensity_iterations > 1.1 * one.intensity_iterations
    assert half.batch_size == whole.batch_size == twice.batch_size == FitConfig().training.batch_size


def test_a_batch_of_few_returns_has_the_samples_of_one_pass():
    few = schedule(5)
    assert (few.batch_size, few.intensity_batch_size) == (5 * 12, 5 * 6)
    assert few.neighbours == 1
    assert few.iterations == {"sdf": 150, "intensity": 500}
    usual = schedule(400)
    assert (usual.batch_size, usual.intensity_batch_size) == (4096, 1024)
    published = schedule(5, sdf_iterations=1000, intensity_iterations=4000)
    assert (published.batch_size, published.intensity_batch_size) == (4096, 1024)
