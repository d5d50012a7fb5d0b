# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Which intensities can belong to the others."""

import numpy as np
import pytest
from radarsdf.returns import intensities as plausible
from radarsdf.returns.intensities import Intensities, Plausible

N = 20_000


def decibels(rng):
    """In steps of half a decibel above a threshold, as automotive radars give them."""
    return np.round(2 * (45 + rng.gamma(1.2, 6, N))) / 2


USUAL = {
    "dB": decibels,
    "linear": lambda rng: 10 ** (decibels(rng) / 10),
    "lognormal": lambda rng: rng.lognormal(0, 2.3, N),
    "exponential": lambda rng: rng.exponential(size=N),
    "Gaussian": lambda rng: rng.normal(-3, 5, N),
    "radar equation": lambda rng: rng.uniform(1, 100, N) ** -4.0,
    "bytes": lambda rng: np.clip(np.round(rng.normal(90, 60, N)), 0, 255),
    "clipped": lambda rng: np.minimum(decibels(rng), 50),
    "mostly one value": lambda rng: np.where(rng.random(N) < 0.9, 0, rng.normal(30, 8, N)),
    "few values": lambda rng: rng.integers(0, 3, N),
    "few returns of another kind": lambda rng: np.where(
        rng.random(N) < 0.01, rng.normal(90, 3, N), rng.normal(50, 8, N)
    ),
}


@pytest.mark.parametrize("values", USUAL.values(), ids=USUAL)
def test_all_of_one_kind_belong_together(values):
    for seed in range(5):
        intensities = values(np.random.default_rng(seed)).astype(np.float32)
        assert Plausible.of(intensities).holds(intensities).all()


WILD = {
    "one of 1e9": (0, [1e9]),
    "one of -9999": (0, [-9999]),
    "-9999": (0.01, [-9999]),
    "65535": (0.01, [65535]),
    "999": (0.01, [999]),
    "-9999 in two of five": (0.4, [-9999]),
    "two sentinels": (0.2, [-9999, -32768]),
    "at both ends": (0.1, [-9999, 65535]),
    "garbage": (0.02, np.linspace(-1e9, 1e9, 1000)),
    "a sentinel and garbage": (0.02, np.append(np.linspace(-1e30, 1e30, 500), np.full(500, -9999))),
}


@pytest.mark.parametrize("case", WILD.values(), ids=WILD)
def test_only_outliers_are_left_out(case):
    share, values = case
    rng = np.random.default_rng(1)
    intensities = decibels(rng).astype(np.float32)
    rows = rng.choice(N, max(1, round(share * N)), replace=False)
    intensities[rows] = rng.choice(values, len(rows))
    held = Plausible.of(intensities).holds(intensities)
    np.testing.assert_array_equal(np.flatnonzero(~held), np.sort(rows))


@pytest.mark.parametrize("most", [1 << 15, 2000], ids=["all", "some"])
def test_parts_have_the_limits_of_the_whole(monkeypatch, most):
    monkeypatch.setattr(plausible, "_MOST", most)
    intensities = decibels(np.random.default_rng(0)).astype(np.float32)
    intensities[12_345] = 1e9  # those that stand for all need not hold it
    parts = Intensities()
    for part in np.split(intensities, [10, 10, 3000, 9001]):
        parts.add(part)
    found = parts.plausible()
    assert found == Plausible.of(intensities)
    assert np.flatnonzero(~found.holds(intensities)).tolist() == [12_345]
    assert (parts.low, parts.high) == (45, 1e9)
