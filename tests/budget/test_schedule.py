# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Batches and iterations follow the size of the data. How many passes a small scene gets is in fitting/test_fit.py."""

from __future__ import annotations

import pytest
from radarsdf import FitConfig
from radarsdf.budget.schedule import Schedule


def schedule(returns, vertices=10**9, *, with_intensity=True, **changes):
    config = FitConfig(**changes)
    return Schedule.of(
        config, surface_returns=returns, returns=returns, vertices=vertices, with_intensity=with_intensity
    )


def test_many_returns_in_few_cells_take_no_more_iterations_than_their_vertices_need():
    assert schedule(10**6).sdf_iterations == pytest.approx(12e6 / 4096, abs=1)
    assert schedule(10**6, vertices=50_000).sdf_iterations == pytest.approx(32 * 50_000 / 4096, abs=1)
    assert schedule(10**6, vertices=100).sdf_iterations == FitConfig().min_sdf_iterations


def test_batches_grow_where_iterations_would_be_too_many():
    many = schedule(10**7)
    assert many.sdf_iterations == FitConfig().max_sdf_iterations
    assert many.sdf_iterations * many.batch_size == pytest.approx(12e7, rel=1e-3)
    assert many.neighbours == many.batch_size // FitConfig().batch_size > 1
    assert schedule(10**6).batch_size == FitConfig().batch_size
    assert schedule(10**6).neighbours == 1


def test_large_batches_of_a_joint_beginning_count_for_the_intensities():
    assert schedule(10**7).intensity_iterations == schedule(10**7).sdf_iterations
    alone = schedule(10**6, joint=False)
    assert alone.intensity_iterations == pytest.approx(6e6 / 2048, abs=1)
    twice = schedule(10**6, joint=False, intensity_passes=2.0, max_reflectance_iterations=10**4)
    assert twice.intensity_iterations == pytest.approx(2 * 6e6 / 2048, abs=1)


def test_many_returns_do_not_train_the_intensities_for_ever():
    assert schedule(10**8, joint=False).intensity_iterations == FitConfig().max_reflectance_iterations
    dense = schedule(10**8, vertices=10**6)
    assert dense.intensity_iterations == dense.sdf_iterations + FitConfig().max_reflectance_iterations
    assert schedule(10**7, joint=False, max_reflectance_iterations=0).intensity_iterations == 1200


def test_a_small_scene_trains_its_intensities_for_long_and_with_more_dropout():
    small, large = schedule(10_000), schedule(10**6)
    assert small.intensity_iterations == FitConfig().min_intensity_iterations
    assert 0 < large.dropout_scale < 0.5 < small.dropout_scale < 1
    assert schedule(10_000, with_intensity=False).iterations["intensity"] == 0


def test_what_is_set_is_done():
    paper = schedule(10**7, vertices=10, sdf_iterations=1000, intensity_iterations=4000)
    assert paper.iterations == {"sdf": 1000, "intensity": 4000}
    assert schedule(10**7, sdf_iterations=0).sdf_iterations == 0
