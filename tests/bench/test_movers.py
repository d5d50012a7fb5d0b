# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The cars of the bench of movers are where they hide what is behind them, and its table has a row for each choice."""

from __future__ import annotations

import numpy as np
from radarsdf.returns.moving import Movers

from bench import movers


def test_a_ray_enters_a_car_at_its_side():
    directions = np.array([[1.0, 0, 0], [0, 1.0, 0], [-1.0, 0, 0]])
    found = movers._entry(np.zeros(3), directions, np.array([10.0, 0, 0]))
    np.testing.assert_allclose(found, [10 - 4.5 / 2, np.inf, np.inf])


def test_cars_hide_what_is_behind_them_and_are_told_by_doppler():
    with_car, without = movers.simulated("wall", 6, 1), movers.simulated("wall", 6, 0)
    moves = np.concatenate(with_car.moves)
    ranges = [np.linalg.norm(np.concatenate(drive.points), axis=1) for drive in (with_car, without)]
    assert moves.sum() > 100
    assert (ranges[0][moves] < ranges[1][moves]).all()
    np.testing.assert_array_equal(ranges[0][~moves], ranges[1][~moves])
    told = np.concatenate(Movers.of(with_car.points, with_car.doppler_mps).masks)
    assert (told == moves).mean() > 0.99


def test_a_table_has_a_row_for_each_choice():
    drive = movers.simulated("wall", 6, 1)
    rows = movers.measure(drive, 1, 20_000, {"training": {"sdf_iterations": 40}})
    assert [row[0] for row in rows] == ["all returns", "without movers by Doppler", "without true movers"]
    assert [int(row[2]) for row in rows[::2]] == [sum(int(mask.sum()) for mask in drive.moves), 0]
