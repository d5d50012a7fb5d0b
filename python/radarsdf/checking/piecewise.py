"""Scans that were exchanged."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np
from scipy.ndimage import median_filter

from radarsdf.arrays import Ints
from radarsdf.checking.agreement import LAGS, MIN_RETURNS, Agreement, Comparison, relative
from radarsdf.checking.frames import FULL
from radarsdf.checking.recording import Finding
from radarsdf.scans import Scans

_NEAR = 17  # pairs whose median score is the usual one: scenes overlap more in some places than in others
_MOST_CUTS = 10
# Of the best of some hundred exchanges. Measured: 14 and more for exchanges, 4 on a handheld radar with dead reckoning.
_MIN_GAIN, _MIN_SIGNIFICANCE = 0.05, 8.0
_CLOSES = 0.5  # share of the difference to the usual score


def check_order(recording: Scans, numbers: Ints) -> Iterator[Finding]:
    """Find two scans or blocks of scans that changed places. `numbers` (F,): of the scans."""
    rows = np.flatnonzero([len(scan) >= MIN_RETURNS for scan in recording.points])
    count = len(rows)
    if count < 2 * max(LAGS):
        return
    agreement = Agreement([recording.points[i] for i in rows], FULL.returns, FULL.queries)
    pairs = np.concatenate([np.stack([np.arange(count - lag), np.arange(lag, count)], 1) for lag in LAGS[:3]])
    motions = relative(recording.poses[rows], pairs)[None]
    scores = agreement.scores(pairs, motions)[0]
    excess = scores[: count - 1] - median_filter(scores[: count - 1], _NEAR, mode="nearest")
    places = [0, *np.sort(np.argsort(-excess, kind="stable")[:_MOST_CUTS] + 1).tolist(), count]
    # Of adjacent blocks, one may be longer: it was moved past the other.
    blocks = [(a, b, b, c) for a, b, c in itertools.combinations(places, 3)]
    blocks += [ends for ends in itertools.combinations(places, 4) if ends[1] - ends[0] == ends[3] - ends[2]]
    best = _MIN_GAIN, 0.0, (0, 0, 0, 0)
    for a, b, c, d in blocks:
        # Other scans with the motion of the same poses: their fields of view overlap as much, whatever is right.
        others = np.r_[0:a, c:d, b:c, a:b, d:count][pairs]
        cuts = np.array([a, b, c, d, a + d - c, a + d - b])
        across = ((pairs[:, :1] < cuts) & (cuts <= pairs[:, 1:])).any(axis=1)
        crossing = np.flatnonzero(across & (others != pairs).any(axis=1))
        neighbours = crossing[crossing < count - 1]
        for chosen in (neighbours, crossing):
            compared = Comparison.of(scores[chosen], agreement.scores(others[chosen], motions[:, chosen]))
            gain, significance = float(compared.gains[0]), float(compared.significance[0])
            if gain < max(best[0] if chosen is crossing else _MIN_GAIN, _CLOSES * excess[neighbours].mean()):
                break
        else:
            if significance >= _MIN_SIGNIFICANCE:
                best = gain, significance, (a, b, c, d)
    gain, significance, (a, b, c, d) = best
    if not d:
        return
    first, second = (f"{numbers[rows[i]]} to {numbers[rows[j - 1]]}" for i, j in ((a, b), (c, d)))
    evidence = (
        f"If scans {first} and scans {second} change places, returns of neighbouring scans are {np.exp(gain):.2f} times closer to "
        f"each other at the ends of these blocks ({significance:.0f} standard errors)."
    )
    yield Finding("scans_exchanged", "error", evidence)
