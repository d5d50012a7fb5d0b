# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Figures of the Astyx HiRes2019 drives, and how near to them the simulated `astyx` must be.

They are the medians of `FITTED`. `KEPT_ASIDE` had no part in them, nor in the simulation.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

FITTED = ("r0144_0167", "r0009_0024", "r0057_0068", "r0133_0142")
KEPT_ASIDE = "r0309_0320"


class Expected(NamedTuple):
    """A figure of the drives, and the factor up to which a simulated one may differ."""

    value: float
    factor: float


EXPECTED = {
    "returns per scan": Expected(1930, 1.25),
    "returns per scan 10-20": Expected(461, 1.6),
    "returns per scan 20-30": Expected(311, 1.6),
    "returns per scan 30-45": Expected(436, 1.6),
    "returns per scan 45-60": Expected(267, 1.6),
    "median distance m 10-20": Expected(0.179, 1.5),
    "median distance m 20-30": Expected(0.273, 1.5),
    "median distance m 30-45": Expected(0.532, 1.6),
    "median distance m 45-60": Expected(1.01, 1.6),
    "share farther than 0.4 m 10-20": Expected(0.177, 1.4),
    "share farther than 0.4 m 20-30": Expected(0.341, 1.4),
    "share farther than 0.4 m 30-45": Expected(0.594, 1.4),
    "share farther than 0.4 m 45-60": Expected(0.725, 1.4),
    "share farther than 1 m 10-20": Expected(0.0222, 1.6),
    "share farther than 1 m 20-30": Expected(0.0899, 1.6),
    "share farther than 1 m 30-45": Expected(0.289, 1.6),
    "share farther than 1 m 45-60": Expected(0.476, 1.6),
    "distance, strong / weak 10-20": Expected(0.762, 1.5),
    "distance, strong / weak 20-30": Expected(0.682, 1.5),
    "distance, strong / weak 30-45": Expected(0.730, 1.5),
    "false returns seen again 20-30": Expected(0.108, 1.5),
    "false returns seen again 30-45": Expected(0.210, 1.5),
    "false returns seen again 45-60": Expected(0.308, 1.5),
    "deviation beam m 10-20": Expected(0.130, 1.25),
    "deviation beam m 20-30": Expected(0.167, 1.25),
    "deviation beam m 30-45": Expected(0.185, 1.25),
    "deviation beam m 45-60": Expected(0.195, 1.25),
    "deviation beam, strong / weak 10-20": Expected(0.659, 1.2),
    "deviation beam, strong / weak 30-45": Expected(0.698, 1.2),
    "deviation azimuth rad 10-20": Expected(0.00783, 1.6),
    "deviation azimuth rad 20-30": Expected(0.00680, 1.6),
    "deviation azimuth rad 30-45": Expected(0.0111, 1.6),
    "deviation elevation rad 10-20": Expected(0.0253, 1.25),
    "deviation elevation rad 20-30": Expected(0.0205, 1.25),
    "deviation elevation rad 30-45": Expected(0.0143, 1.25),
}


def medians(found: Sequence[dict[str, float]]) -> dict[str, float]:
    """The median of each figure over the drives that have it, NaN if none has."""
    values = {name: np.array([one[name] for one in found]) for name in found[0]}
    return {
        name: float(np.nanmedian(own)) if np.isfinite(own).any() else float("nan")
        for name, own in values.items()
    }


def misfits(found: Sequence[dict[str, float]]) -> dict[str, float]:
    """Simulated over expected figure, of those figures that differ by more than their factor or that are missing."""
    ratios = {name: own / EXPECTED[name].value for name, own in medians(found).items() if name in EXPECTED}
    return {
        name: ratio
        for name, ratio in ratios.items()
        if not 1 / EXPECTED[name].factor <= ratio <= EXPECTED[name].factor
    }
