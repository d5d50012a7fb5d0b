# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""How a sensor goes on from what it did before."""

from __future__ import annotations

import itertools
from types import SimpleNamespace

import numpy as np
import pytest
from radarsdf import FitConfig
from radarsdf.poses.drive import Drive, followed
from radarsdf.poses.rates import Habits, Rate

TURNS = Habits(np.array([0.1, 0.2, 0.3]), np.array([0.05, 0.1, 0.15]), True)
MOVES = Habits(np.array([20.0, 10.0, 5.0]), np.array([2.0, 1.0, 0.5]), False)
RATE = Rate(np.array([0.3, -0.2, 0.1]), np.diag([0.01, 0.02, 0.03]))


def assert_same(found, expected):
    np.testing.assert_allclose(found.mean, expected.mean, rtol=1e-9)
    np.testing.assert_allclose(found.covariance, expected.covariance, rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("habits", [TURNS, MOVES], ids=["turns", "moves"])
def test_two_times_are_as_long_as_both(habits):
    assert_same(habits.after(RATE, 0.0), RATE)
    assert_same(habits.after(habits.after(RATE, 0.3), 0.4), habits.after(RATE, 0.7))


def test_turns_come_to_what_is_usual_and_moves_stay():
    late = TURNS.after(RATE, 1e3)
    np.testing.assert_allclose(late.mean, 0, atol=1e-9)
    np.testing.assert_allclose(late.covariance, np.diag(TURNS.usual))
    np.testing.assert_array_equal(MOVES.after(RATE, 1e3).mean, RATE.mean)
    np.testing.assert_allclose(MOVES.after(RATE, 2.0).covariance, RATE.covariance + 2 * np.diag(MOVES.change))


@pytest.mark.parametrize("habits", [TURNS, MOVES], ids=["turns", "moves"])
def test_habits_are_learnt_from_a_drive_that_has_them(habits):
    rng = np.random.default_rng(0)
    durations_s = rng.choice([0.05, 0.15], 8000)
    rates = [Rate(np.sqrt(habits.usual) * rng.normal(size=3), np.zeros((3, 3)))]
    for before_s, after_s in itertools.pairwise(durations_s):
        told = habits.after(rates[-1], (before_s + after_s) / 2)
        noise = np.sqrt(np.diag(told.covariance)) * rng.normal(size=3)
        rates.append(Rate(told.mean + noise, np.zeros((3, 3))))
    usual = np.square([rate.mean for rate in rates]).mean(axis=0)
    rates[4000:4002] = None, None  # it was lost there
    first = Habits(np.full(3, 1.0), np.full(3, 1.0), habits.settles)
    found = first.learnt(rates, durations_s)
    np.testing.assert_allclose(found.usual, usual, rtol=0.02)
    # Of 8000 squares; turns settle within 4 s, so that a step of 0.1 s changes them by 2.5 % less.
    np.testing.assert_allclose(found.change, habits.change, rtol=4 * np.sqrt(2 / 8000) + 0.025)
    assert first.learnt([None, None], durations_s[:2]) == first


def test_a_step_is_expected_from_the_middle_of_the_one_before():
    times_s = np.array([0.0, 0.1, 0.4])
    drive = Drive([], times_s, None, None, TURNS, MOVES)
    found, turn, move = drive.expected(2, RATE, RATE), TURNS.after(RATE, 0.2), MOVES.after(RATE, 0.2)
    assert_same(found.turn, Rate(0.3 * turn.mean, 0.09 * turn.covariance))
    np.testing.assert_array_equal((found.begin_mps, found.end_mps), [move.mean] * 2)
    np.testing.assert_allclose(found.way_covariance, 0.09 * move.covariance)
    assert found.duration_s == pytest.approx(0.3)
    for nothing in (drive.expected(1, None, None), drive.expected(2, None, None)):
        np.testing.assert_array_equal(nothing.turn.mean, 0)
        np.testing.assert_allclose(nothing.turn.covariance, nothing.duration_s**2 * np.diag(TURNS.usual))
        np.testing.assert_allclose(nothing.way_covariance, nothing.duration_s**2 * np.diag(MOVES.usual))


def test_a_gyroscope_helps_from_the_second_pass_on(monkeypatch):
    """The first finds the turns that tell its bias."""
    seen = []
    passed = SimpleNamespace(tracked=[], rotations=lambda times_s: (times_s, times_s))
    monkeypatch.setattr(
        "radarsdf.poses.drive._Pass.of", lambda drive, _: seen.append(drive.gyroscope) or passed
    )
    monkeypatch.setattr(Drive, "learnt", lambda drive, _: drive)
    gyroscope = SimpleNamespace(learnt=lambda *_: "learnt")
    followed(Drive([], np.arange(3.0), None, gyroscope), FitConfig(), 1)
    assert seen == [None, "learnt", "learnt"]
