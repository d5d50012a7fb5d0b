# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What `python -m bench.paper.one_probability` learns."""

from __future__ import annotations

import numpy as np
import pytest
import radarsdf
from radarsdf import FitConfig

from bench.paper.one_probability import Example, logistic_regression


@pytest.fixture(scope="module")
def contents():
    """A wall that four scans see."""
    rng = np.random.default_rng(0)
    points = [
        np.column_stack([rng.normal(5, 0.03, 60), rng.uniform(-1, 1, 60), rng.uniform(-1, 1, 60)])
        for _ in range(4)
    ]
    poses = np.tile(np.eye(4), (4, 1, 1))
    return radarsdf.fit(
        points, poses, config=FitConfig.quick(num_threads=2), origin=(0, 0, 0), progress=False
    )._contents


def test_what_a_second_layer_adds_is_nothing(contents):
    """Two vertices lie near two points of the truth: the more probable one covers it."""
    near, points = np.array([0, 1, 0, 1, 2]), np.array([0, 0, 1, 1, 2])
    areas = np.ones(3)
    example = Example("", "", np.zeros((3, 3)), contents, 0.2, None, None, None, areas, None, near, points)
    added = example.added(np.array([0.9, 0.5, 0.7]))
    assert added[1] == 0
    assert added[0] == pytest.approx(2 * added[2])
    both = example.added(np.array([0.9, 0.9, 0.7]))
    assert both[0] == both[1] == pytest.approx(both[2])


def test_a_regression_finds_the_numbers_again():
    rng = np.random.default_rng(0)
    columns = np.column_stack([np.ones(5000), rng.normal(size=(5000, 2))])
    numbers = np.array([-0.5, 1.0, -2.0])
    shares = 1 / (1 + np.exp(-(columns @ numbers)))
    np.testing.assert_allclose(
        logistic_regression(columns, shares, rng.uniform(size=5000)), numbers, atol=1e-6
    )
