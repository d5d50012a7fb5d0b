# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What a plan says of memory and time follows from each tile's own rays."""

import pytest
from radarsdf.fitting.estimate import estimate_rays
from radarsdf.tiles.plan import Plan, report_of
from radarsdf.tiles.planning import read_rays


def test_the_cells_are_those_that_the_fit_of_the_tile_has(folder):
    plan = Plan.load(folder)
    for tile in plan.tiles:
        rays, inside = read_rays(folder, plan, tile)
        assert inside.sum() < len(rays)  # others only pass
        report, expected = report_of(folder, tile), estimate_rays(rays, plan.config, inside)
        assert expected.returns == inside.sum()
        for name in ("leaf_cells", "vertices"):  # the promise of an estimate: within a factor of two
            assert 0.5 < getattr(expected, name) / report[name] < 2
        assert (tile.memory_bytes, tile.seconds) == (
            expected.peak_memory_bytes,
            pytest.approx(expected.seconds, abs=1e-3),
        )
