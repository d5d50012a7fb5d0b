"""The weight of a return: averages of distances, their smoothing, evidence and uncertainty all take it from here."""

from __future__ import annotations

from typing import NamedTuple

from radarsdf.arrays import Floats32
from radarsdf.returns.noise import SensorNoise


class Weights(NamedTuple):
    """Weights of M groups of returns with about the same range, such as those of a leaf cell."""

    average: Floats32  # (M,) in averages of distances
    information: Floats32  # (M,) in smoothing and evidence: 1 / variance of the position, m⁻²


def weights_of(counts: Floats32, ranges_m: Floats32, noise: SensorNoise) -> Weights:
    """Return the weights of groups of `counts` (M,) returns each, at ranges (M,), m."""
    return Weights(counts, counts / noise.variances_m2(ranges_m))
