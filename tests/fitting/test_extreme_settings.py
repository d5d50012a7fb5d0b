# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Training at the edges of its settings: every number stays finite. `python -m bench.stress training` takes longer."""

from __future__ import annotations

import pytest

from bench.stress.training import CASES, fitted, free_and_solid


@pytest.mark.parametrize("name", CASES)
def test_every_number_stays_finite(name):
    _, end = fitted(CASES[name], 40)
    assert end == "done"


def test_the_default_finds_the_walls():
    radar_map, _ = fitted(CASES["default"], 200)
    assert min(free_and_solid(radar_map)) > 0.9


def test_a_rate_of_a_tenth_still_finds_them():
    radar_map, _ = fitted(CASES["learning rates 0.1"], 200)
    assert min(free_and_solid(radar_map)) > 0.8


def test_what_overflows_is_said_and_the_map_before_is_kept():
    radar_map, end = fitted({"training": {"learning_rate": 1e30, "cosine_schedule": False}}, 40)
    assert "loss is" in end or "not finite" in end
    assert sum(radar_map.report["iterations_done"].values()) < 80
