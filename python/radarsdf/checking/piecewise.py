"""Faults that begin or end at a scan: exchanged scans, and a mounting that changed."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from radarsdf.checking.agreement import MIN_RETURNS, Agreement, Comparison, inverse, relative
from radarsdf.checking.frames import FULL, Effort
from radarsdf.checking.recording import Finding, FloatArray
from radarsdf.poses.rigid import transform
from radarsdf.scans import Scans

_LAGS = 4  # scans on each side of a cut that are compared across it
_NEAR = 17  # pairs at one lag, whose median score is the usual one there: scenes overlap more in some places than in others
_MOST_CUTS = 10
_LEAST_SCANS = 2 * _LAGS
_MIN_GAIN, _MIN_SIGNIFICANCE = 0.05, 4.0  # as in frames.py
# Of the best of some hundred exchanges. Measured: 14 and more for exchanges, 4 on a handheld radar with dead reckoning.
_EXCHANGE_SIGNIFICANCE = 8.0
_CLOSES = 0.5  # share of the difference to the usual score
# Steps of the search for a mounting, rad, and m at `_LEVER_M`.
_STEPS_RAD, _LEVER_M = (0.1, 0.05, 0.025, 0.0125), 4.0


def exchanged_scans(
    recording: Scans, numbers: NDArray[np.int64], effort: Effort = FULL
) -> tuple[Finding, NDArray[np.int64]] | None:
    """Find two blocks of scans that changed places, and return the right order (F,) of the scans. `numbers` (F,): of them."""
    cuts = _Cuts(recording, effort)
    best, most = None, 0.0
    # Of adjacent blocks, one may be longer: it was moved past the other.
    places = [0, *sorted(cuts.places), len(cuts.rows)]
    blocks = [(a, b, b, c) for a, b, c in itertools.combinations(places, 3)]
    blocks += [ends for ends in itertools.combinations(places, 4) if ends[1] - ends[0] == ends[3] - ends[2]]
    for a, b, c, d in blocks:
        order = np.r_[0:a, c:d, b:c, a:b, d : len(cuts.rows)]
        gain, significance = cuts.gain_of(order, (a, b, c, d))
        if gain > most and significance >= _EXCHANGE_SIGNIFICANCE:
            most, best = gain, (a, b, c, d, order, significance)
    if best is None:
        return None
    *ends, order, significance = best
    named = numbers[cuts.rows]
    first, second = (f"{named[i]} to {named[j - 1]}" for i, j in (ends[:2], ends[2:]))
    evidence = (
        f"If scans {first} and scans {second} change places, returns of neighbouring scans are {np.exp(most):.2f} times closer to "
        f"each other at the ends of these blocks ({significance:.0f} standard errors)."
    )
    whole = np.arange(len(recording))
    whole[cuts.rows] = cuts.rows[order]
    return Finding("scans_exchanged", "error", evidence), whole


def changed_mounting(recording: Scans) -> tuple[int, FloatArray, FloatArray] | None:
    """Return the scan from which on another mounting agrees better, its rotation vector and shift, and the poses (F, 4, 4) with it."""
    found = _Cuts(recording, FULL).mounting()
    if found is None:
        return None
    poses, (scan, vector) = recording.poses.copy(), found
    poses[scan:] = poses[scan:] @ transform(vector[:3], vector[3:])
    return scan, vector, poses


class _Cuts:
    """Agreement of scans across each place between two scans, and of hypotheses about the worst places."""

    def __init__(self, recording: Scans, effort: Effort) -> None:
        self.rows = np.flatnonzero([len(scan) >= MIN_RETURNS for scan in recording.points])
        count = len(self.rows)
        lags = range(1, min(_LAGS, count - 1) + 1) if count >= _LEAST_SCANS else ()
        self._agreement = Agreement([recording.points[i] for i in self.rows], effort.returns, effort.queries)
        pairs = [np.stack([np.arange(count - lag), np.arange(lag, count)], 1) for lag in lags]
        self._pairs = np.concatenate([np.zeros((0, 2), np.int64), *pairs])
        self._motions = relative(recording.poses[self.rows], self._pairs)
        self._scores = self._agreement.scores(self._pairs, self._motions[None])[0]
        ends = np.cumsum([len(part) for part in pairs])[:-1]
        self._usual = np.concatenate(
            [median_filter(part, _NEAR, mode="nearest") for part in np.split(self._scores, ends)]
        )
        self._known: dict[tuple[int, int, int], float] = {}
        excess = self._scores - self._usual
        across = [-excess[self._crosses(k)].mean() for k in range(1, count)] if lags else []
        self.places: list[int] = (np.argsort(across, kind="stable")[:_MOST_CUTS] + 1).tolist()
        """Numbers of the scans after the worst places, worst first."""

    def _crosses(self, *cuts: int) -> NDArray[np.bool_]:
        """Mask of the pairs across any of some cuts, each named by the scan after it."""
        first, second = self._pairs.T
        found: NDArray[np.bool_] = np.any([(first < k) & (k <= second) for k in cuts], axis=0)
        return found

    def gain_of(self, order: NDArray[np.int64], cuts: tuple[int, ...]) -> tuple[float, float]:
        """Gain of scans in another order (F,) near its cuts, and its significance; 0 if their agreement remains unusual."""
        # Other scans with the motion of the same poses: their fields of view overlap as much, whatever is right.
        others = order[self._pairs]
        changed = (others != self._pairs).any(axis=1)
        joined = (others[:, 1] - others[:, 0] != self._pairs[:, 1] - self._pairs[:, 0]) | self._crosses(*cuts)
        rows = np.flatnonzero(changed & joined)
        neighbours = rows[rows < len(order) - 1]
        if len(rows) < 2 * _LAGS or self._compared(neighbours, others).gains[0] < _MIN_GAIN:
            return 0.0, 0.0
        compared = self._compared(rows, others)
        gain, significance = float(compared.gains[0]), float(compared.significance[0])
        closes = gain > _CLOSES * (self._scores[rows] - self._usual[rows]).mean()
        return (gain, significance) if gain >= _MIN_GAIN and closes else (0.0, 0.0)

    def _compared(self, rows: NDArray[np.int64], others: NDArray[np.int64]) -> Comparison:
        """Compare the scores of some pairs with those of other scans (P, 2) at the same motions."""
        for row in rows.tolist():
            key = row, *others[row].tolist()
            if key not in self._known:
                self._known[key] = float(
                    self._agreement.scores(others[[row]], self._motions[None, [row]])[0, 0]
                )
        scores = np.array([self._known[(row, *others[row].tolist())] for row in rows.tolist()])
        return Comparison.of(self._scores[rows], scores[None])

    def mounting(self) -> tuple[int, FloatArray] | None:
        """Scan after the worst place if another mounting from there on agrees clearly better, its rotation vector and shift (6,)."""
        if not self.places:
            return None
        cut = self.places[0]
        crossing = np.flatnonzero(self._crosses(cut))
        after = np.flatnonzero((self._pairs[:, 0] >= cut) & (self._pairs[:, 1] - self._pairs[:, 0] == _LAGS))
        used = np.append(crossing, after[:: max(1, len(after) // len(crossing))])
        pairs, motions = self._pairs[used], self._motions[used]
        across = pairs[:, 0] < cut

        def scores(vectors: FloatArray) -> FloatArray:
            """Scores (H, P) with mountings (H, 6)."""
            T_old_new = transform(vectors[:, :3], vectors[:, 3:])[:, None]
            first = np.where(across[:, None, None], np.eye(4), T_old_new)
            return self._agreement.scores(pairs, inverse(T_old_new) @ motions @ first)

        best = np.zeros((1, 6))
        given = least = scores(best)[0]
        for size in _STEPS_RAD:
            steps = size * np.concatenate([np.eye(6), -np.eye(6)]) * np.repeat([1.0, _LEVER_M], 3)
            while True:
                tried = scores(best + steps)
                top = int(np.argmin(tried.mean(axis=1)))
                if tried[top].mean() > least.mean() - 1e-3:
                    break
                best, least = best + steps[top], tried[top]
        compared = Comparison.of(given[across], least[None, across])
        gain = compared.gains[0]
        closes = gain > _CLOSES * (given[across] - self._usual[crossing]).mean()
        if gain < _MIN_GAIN or compared.significance[0] < _MIN_SIGNIFICANCE or not closes:
            return None
        return int(self.rows[cut]), best[0]
