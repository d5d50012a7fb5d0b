# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""How well the returns of different scans agree, if one scan is moved into the frame of another.

A return of scan i is moved into the frame of scan j. Its distance to the nearest return of scan j is divided by the
distances between returns of scan j at that place. So neither the density of the returns, nor their noise, nor the
unit of length matters: 1 means that the returns of the two scans mix as the returns of one scan do. The score of a
pair of scans is the mean logarithm of these quotients. The smaller, the better the scans agree.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from radarsdf.poses.rigid import between

FloatArray = NDArray[np.float64]

_NEIGHBOURS = 4  # returns of the same scan whose mean distance is the spacing at a return
MIN_RETURNS = _NEIGHBOURS + 2  # of a scan. One with fewer tells nothing
# Quotients below and above these count as much as these. A return in empty space must not count more than one beside
# a surface, or a hypothesis would win that merely makes the fields of view overlap.
_LEAST, _MOST = 0.1, 1.5
LAGS = (1, 2, 4, 8)
"""How far apart the scans of a pair are, and the same times a stride where the sensor is slow."""
_MOTION = 0.05  # of the median range: a sensor that has moved less shows little of the error of its poses


class Agreement:
    """Compares scans, each with the nearest-neighbour tree of a sample of its returns.

    Parameters
    ----------
    scans : sequence of F arrays
        (N_i, 3) each, real numbers, in the frame that they came in. They are sampled at equal steps: no random numbers.
    returns : int
        Largest number of returns of a scan in its tree.
    queries : int
        About so many returns of each scan are looked up in another one.
    """

    def __init__(self, scans: Sequence[NDArray[Any]], returns: int, queries: int) -> None:
        self._scans = scans
        self._returns = returns
        self._queries = queries
        self._trees: dict[int, tuple[cKDTree, FloatArray, FloatArray]] = {}

    def scores(self, pairs: NDArray[np.int64], T_j_i: FloatArray) -> FloatArray:
        """Scores (H, P) of P pairs of scans under H hypotheses. The smaller, the better the scans agree.

        Parameters
        ----------
        pairs : ndarray
            (P, 2) int64, scans i and j.
        T_j_i : ndarray
            (H, P, 4, 4) isometries, proper or not, from the frame of scan i to that of scan j.
        """
        back = inverse(T_j_i)
        found = np.zeros(T_j_i.shape[:2])
        for p, (i, j) in enumerate(pairs.tolist()):
            found[:, p] = 0.5 * (self._one_way(i, j, T_j_i[:, p]) + self._one_way(j, i, back[:, p]))
        return found

    def spacing_m(self, i: int) -> float:
        """Median distance between neighbouring returns of scan i, m. 0 if it has too few."""
        return float(np.median(self._tree(i)[1])) if len(self._scans[i]) >= MIN_RETURNS else 0.0

    def _one_way(self, i: int, j: int, T_j_i: FloatArray) -> FloatArray:
        """Mean logarithms (H,) of the quotients of returns of scan i in scan j."""
        queries = self._tree(i)[2]
        tree, spacing, _ = self._tree(j)
        moved = np.einsum("hab,nb->hna", T_j_i[:, :3, :3], queries) + T_j_i[:, None, :3, 3]
        # Far from all returns, the quotient counts as _MOST anyway: the bound saves most of the search.
        distances, nearest = tree.query(moved.reshape(-1, 3), distance_upper_bound=_MOST * spacing.max())
        quotients = distances / np.append(spacing, 1.0)[nearest]  # the tree says n where it found none
        logs = np.log(np.clip(quotients, _LEAST, _MOST)).reshape(moved.shape[:2])
        means: FloatArray = logs.mean(axis=1)
        return means

    def _tree(self, i: int) -> tuple[cKDTree, FloatArray, FloatArray]:
        if i not in self._trees:
            scan = self._scans[i]
            kept = np.asarray(scan[:: -(-len(scan) // self._returns)], np.float64)
            tree = cKDTree(kept)
            spacing = tree.query(kept, _NEIGHBOURS + 1)[0][:, 1:].mean(axis=1)
            spacing = np.maximum(
                spacing, 1e-9 * max(float(np.abs(kept).max()), 1.0)
            )  # returns on one another
            queries = np.asarray(scan[:: -(-len(scan) // self._queries)], np.float64)
            self._trees[i] = tree, spacing, queries
        return self._trees[i]


@dataclass(frozen=True)
class Comparison:
    """How much better hypotheses agree than the data as given, over P pairs of scans."""

    gains: FloatArray
    """(H,) mean decrease of the score. exp(-gain) is the factor by which the distances shrink."""
    errors: FloatArray
    """(H,) standard error of the mean, from the differences between the pairs."""

    @classmethod
    def of(cls, given: FloatArray, others: FloatArray) -> Comparison:
        """Compares scores `given` (P,) or (H, P) with scores `others` (H, P)."""
        better = given - others
        count = better.shape[1]
        # A mean of few pairs that agree by chance must not look certain.
        spread = better.std(axis=1, ddof=1) if count > 1 else np.full(len(better), np.inf)
        return cls(better.mean(axis=1), np.maximum(spread, 1e-3) / np.sqrt(count))

    @property
    def significance(self) -> FloatArray:
        """(H,) gains over their standard errors."""
        return self.gains / self.errors


def choose_pairs(
    scans: Sequence[NDArray[Any]], positions: FloatArray, count: int, lags: Sequence[int] = LAGS
) -> NDArray[np.int64]:
    """Pairs (P, 2) of scans, about `count`, spread over the drive, with short and longer ways between them.

    Neighbours overlap most; but where scans are frequent, the sensor hardly moves between them, and any hypothesis
    agrees. So some pairs are so far apart that the sensor moved a share of its range, as the poses say. Scans with
    too few returns are left out.
    """
    usable = np.flatnonzero([len(scan) >= MIN_RETURNS for scan in scans])
    if len(usable) < 2:
        return np.zeros((0, 2), np.int64)
    some = usable[:: -(-len(usable) // 20)]
    middle = np.median([np.median(np.linalg.norm(scans[i], axis=1)) for i in some])
    step = np.median(np.linalg.norm(np.diff(positions[usable], axis=0), axis=1))
    most = max(1, len(usable) // 2)
    stride = int(np.clip(_MOTION * middle / step if step > 0 else 1, 1, max(1, most // lags[-1])))
    ways = sorted({min(lag, most) for lag in lags} | {lag * stride for lag in lags if lag * stride <= most})
    found = []
    for lag in ways:
        found.append(pairs_apart(usable, lag, -(-count // len(ways))))
    return np.concatenate(found)


def pairs_apart(scans: NDArray[np.int64], lag: int, count: int) -> NDArray[np.int64]:
    """Pairs (P, 2) of scans (K,), `lag` of them apart: about `count`, at equal steps."""
    last = len(scans) - lag
    firsts = np.unique(np.linspace(0, last - 1, min(last, count)).round().astype(int))
    return np.stack([scans[firsts], scans[firsts + lag]], 1)


def relative(T_world_sensor: FloatArray, pairs: NDArray[np.int64]) -> FloatArray:
    """(P, 4, 4) motions T_j_i of the pairs (P, 2) of poses (F, 4, 4), each from scan i to scan j."""
    return between(T_world_sensor[pairs[:, 1]], T_world_sensor[pairs[:, 0]])


def inverse(T_a_b: FloatArray) -> FloatArray:
    """Inverses (…, 4, 4) of isometries (…, 4, 4)."""
    found = np.zeros_like(T_a_b)
    transposed = np.swapaxes(T_a_b[..., :3, :3], -1, -2)
    found[..., :3, :3] = transposed
    found[..., :3, 3] = -np.einsum("...ab,...b->...a", transposed, T_a_b[..., :3, 3])
    found[..., 3, 3] = 1
    return found
