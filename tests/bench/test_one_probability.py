# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The rule that `python -m bench.paper.one_probability` tries beside that of a mesh."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import radarsdf
import torch
from radarsdf import FitConfig
from radarsdf.map import queries

from bench.paper.one_probability import Example, columns_of, threshold


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


def test_the_threshold_is_that_of_the_highest_expected_f_score():
    rng = np.random.default_rng(1)
    p, added, areas = rng.uniform(size=(3, 200))
    found = threshold(p, added, areas)

    def expected(limit):
        kept = p >= limit
        precision = (p * areas)[kept].sum() / areas[kept].sum()
        completion = (added * areas)[kept].sum() / (added * areas).sum()
        return 2 * precision * completion / (precision + completion)

    assert expected(found) == pytest.approx(max(expected(limit) for limit in p))
    assert expected(found) > expected(0) + 0.01


def test_what_a_second_layer_adds_is_nothing(contents):
    """Two vertices lie near two points of the truth: the more probable one covers it."""
    near, points = np.array([0, 1, 0, 1, 2]), np.array([0, 0, 1, 1, 2])
    areas = np.ones(3)
    example = Example("", "", np.zeros((3, 3)), contents, None, None, None, areas, None, near, points)
    added = example.added(np.array([0.9, 0.5, 0.7]))
    assert added[1] == 0
    assert added[0] == pytest.approx(2 * added[2])
    both = example.added(np.array([0.9, 0.9, 0.7]))
    assert both[0] == both[1] == pytest.approx(both[2])


def test_what_is_missing_counts_in_deviations_of_chance(contents):
    """A surface that answers as often as it should misses nothing, however many scans looked."""
    evidence = queries.evidence(contents, torch.tensor([[5.0, 0, 0]]))
    assert columns_of(contents, evidence)[0, 2] == 0
    missing = [
        columns_of(contents, evidence._replace(detections=evidence.detections * 0, looks=evidence.looks * n))
        for n in (1, 100)
    ]
    assert 0 < missing[0][0, 2] < missing[1][0, 2] / 5
    rough = dataclasses.replace(contents, rough_share=0.3)
    assert columns_of(rough, evidence)[0, 3] == pytest.approx(np.log(0.3))
