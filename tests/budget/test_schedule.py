# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Batches and iterations follow the size of the data. How many passes a small scene gets is in fitting/test_fit.py."""

from __future__ import annotations

import pytest
from radarsdf import FitConfig
from radarsdf.fitting.schedule import Schedule

from ..settings import grouped


def schedule(returns, vertices=10**9, *, with_intensity=True, **changes):
    config = FitConfig(**grouped(**changes))
    return Schedule.of(
        config, surface_returns=returns, returns=returns, vertices=vertices, with_intensity=with_intensity
    )


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


def test_joint_iterations_count_for_the_intensities():
    alone, joint = schedule(3 * 10**5, joint=False), schedule(3 * 10**5)
    assert alone.intensity_iterations == joint.intensity_iterations
    assert alone.intensity_iterations == pytest.approx(0.65 * 6 * 3e5 / 1024, abs=1)


def test_many_returns_do_not_train_the_intensities_for_ever():
    assert schedule(10**8, joint=False).intensity_iterations == 1750
    large = schedule(10**7)
    assert large.intensity_iterations == large.sdf_iterations + 300


def test_a_small_scene_trains_its_intensities_for_long_and_with_more_dropout():
    small, large = schedule(10_000), schedule(10**6)
    assert small.intensity_iterations == 500
    assert 0 < large.dropout_scale < 0.5 < small.dropout_scale < 1
    assert schedule(10_000, with_intensity=False).iterations["intensity"] == 0


@pytest.mark.parametrize("returns", [2000, 10**5, 5 * 10**5])
@pytest.mark.parametrize("joint", [False, True])
def test_effort_multiplies_the_iterations(returns, joint):
    half, whole, twice = (schedule(returns, joint=joint, effort=effort) for effort in (0.5, 1.0, 2.0))
    for one, other in ((half, whole), (whole, twice)):
        assert 2 * one.sdf_iterations == pytest.approx(other.sdf_iterations, abs=1)
        assert other.passes == pytest.approx(2 * one.passes, rel=0.01)
        if not joint:
            assert 2 * one.intensity_iterations == pytest.approx(other.intensity_iterations, abs=1)
    assert half.batch_size == whole.batch_size == twice.batch_size == FitConfig().training.batch_size


@pytest.mark.parametrize("returns", [2000, 10**5])
def test_effort_of_a_joint_fit(returns):
    """Beginning and end both grow with it; the whole is never shorter than its beginning."""
    half, whole, twice = (schedule(returns, effort=effort) for effort in (0.5, 1.0, 2.0))
    for one in (half, whole, twice):
        assert one.intensity_iterations >= one.sdf_iterations
    # What a longer beginning has shown the intensity network is not shown again.
    assert 0.45 < half.intensity_iterations / whole.intensity_iterations <= 0.8
    assert 1.2 < twice.intensity_iterations / whole.intensity_iterations < 2.1


def test_effort_changes_nothing_that_is_set():
    for effort in (0.01, 100.0):
        found = schedule(10**5, sdf_iterations=70, intensity_iterations=90, effort=effort)
        assert found.iterations == {"sdf": 70, "intensity": 90}


def test_the_least_effort_is_an_iteration():
    assert schedule(10**5, effort=1e-9, joint=False).iterations == {"sdf": 1, "intensity": 1}


def test_great_effort_grows_the_batches_too():
    great = schedule(10**6, effort=10.0)
    assert great.sdf_iterations == 5000
    assert great.sdf_iterations * great.batch_size == pytest.approx(0.6 * 10 * 12e6, rel=1e-3)


def test_what_is_set_is_done():
    paper = schedule(10**7, vertices=10, sdf_iterations=1000, intensity_iterations=4000)
    assert paper.iterations == {"sdf": 1000, "intensity": 4000}
    assert schedule(10**7, sdf_iterations=0).sdf_iterations == 0


def test_a_batch_of_few_returns_has_the_samples_of_one_pass():
    few = schedule(5)
    assert (few.batch_size, few.intensity_batch_size) == (5 * 12, 5 * 6)
    assert few.neighbours == 1
    assert few.iterations == {"sdf": 150, "intensity": 500}
    usual = schedule(400)
    assert (usual.batch_size, usual.intensity_batch_size) == (4096, 1024)
    published = schedule(5, sdf_iterations=1000, intensity_iterations=4000)
    assert (published.batch_size, published.intensity_batch_size) == (4096, 1024)
