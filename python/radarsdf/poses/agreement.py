"""Agreement of returns of different scans, and its significance."""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.sparse import coo_matrix
from scipy.spatial import cKDTree
from scipy.stats import t as student
from typing_extensions import Self

from radarsdf.arrays import Array, Bools, Floats, Ints, NDArray
from radarsdf.poses.doppler import SensorVelocities
from radarsdf.poses.planes import SensorReturns
from radarsdf.poses.rigid import assembled, between, rotation
from radarsdf.returns.noise import SensorNoise

_SPACED = 4  # nearest returns of the same scan whose mean distance is the spacing at a return
MIN_RETURNS = _SPACED + 2  # scans with fewer have no spacing
# Limits of the quotients. A return in empty space must not count more than one next to
# a surface, or hypotheses would win that merely make the fields of view overlap.
_LEAST, _MOST = 0.1, 1.5
LEAST_M = 0.05  # minimum distance between returns where no spacing is known, m, below the noise of any radar
LAGS = (1, 2, 4, 8)  # lags between the scans of a pair; multiplied by a stride if the sensor is slow
_MOTION = 0.05  # share of the median range: smaller motions hardly show errors of the poses

# Returns of a scan, and pairs of neighbouring scans, that determine the sign of the Doppler.
_SAMPLED, _PAIRS = 200, 40
_FIRST_PAIRS = 12
_FEW_PAIRS = 8  # pairs from which on their spread determines the standard error, else that of single returns
YAW_STEP_RAD = 0.07  # resolution of the yaws between neighbouring scans
_TURNS_RAD = YAW_STEP_RAD * np.arange(-6, 7)
_TURNS, _HALF_TURNS = (rotation(np.multiply.outer(share * _TURNS_RAD, [0.0, 0.0, 1.0])) for share in (1, 0.5))
CLEAR = 4.0  # standard errors by which scans must agree better with one sign of the Doppler
ERRORS = 3.0  # standard errors of a significant difference

NEIGHBOURS = 16  # nearest neighbours of a return; those of other scans contribute to the density
_MOST_HELD = 20_000  # maximum number of held-out returns
_BY_CHANCE = 1e-3  # significance level: probability that true poses seem improved
_CLOSED_BY_CHANCE = 1e-2  # the same of loops, that are probable: the poses revisit a place
# Minimum relevant gain. Measured: with true poses up to 0.0006; where a drift of 0.01 m and 0.05 degrees a step is corrected, 0.0015.
_LEAST_GAIN = 0.001
_PLACE = 0.25  # edge of a place, median ranges: larger than single objects, near or far
# Edge of a cell, median ranges, in which the returns of other scans indicate only that scans overlap.
_NEARBY = 0.5
_MOST_COUNTED = 100_000  # maximum number of returns counted in these cells


@dataclass(frozen=True)
class Gain:
    """Mean of independent samples, such as gains in agreement, with its standard error."""

    mean: Any  # (...)
    error: Any  # (...) infinite for a single sample
    count: int

    @classmethod
    def of_samples(cls, samples: Floats, least: float = 1e-9) -> Self:
        """Build from K samples (K, ...), whose standard deviation is at least `least`."""
        spread = samples.std(axis=0, ddof=1) if len(samples) > 1 else np.full(samples.shape[1:], np.inf)
        return cls(samples.mean(axis=0), np.maximum(spread, least) / np.sqrt(len(samples)), len(samples))

    @classmethod
    def over(cls, given: Floats, others: Floats) -> Self:
        """Compare scores `given` (P,) or (H, P) of pairs of scans with others (H, P): exp(-gain) times smaller distances."""
        # The mean of a few pairs that agree by chance must not look certain.
        return cls.of_samples((given - others).T, 1e-3)

    @classmethod
    def by_groups(cls, samples: Floats, groups: NDArray[np.integer[Any]]) -> Self:
        """Build from samples (N,) with common errors within `groups` (N,)."""
        counts = np.bincount(groups)
        return cls.of_samples(np.bincount(groups, samples)[counts > 0] / counts[counts > 0])

    @property
    def significance(self) -> Any:
        """(...) means over their standard errors."""
        return self.mean / self.error

    def excess(self, level: float) -> Any:
        """Return the means (...) over the least that is significant at a level (Student's t)."""
        return self.significance / student.ppf(1 - level, self.count - 1)


class _Indexed:
    """Scan with the k-d tree of each n-th of its returns, and of those to look up in others, by two steps."""

    def __init__(self, scan: Array, steps: tuple[int, int]) -> None:
        self._kept, self.queries = (np.asarray(scan[::step], np.float64) for step in steps)
        self.tree = cKDTree(self._kept)

    @cached_property
    def spacing_m(self) -> Floats:
        """(N,) mean distance of returns in the tree to their nearest ones."""
        spacing = self.tree.query(self._kept, _SPACED + 1)[0][:, 1:].mean(axis=1)
        least = 1e-9 * max(float(np.abs(self._kept).max()), 1.0)  # coincident returns have no spacing
        return np.maximum(spacing, least)

    def nearest(self, points: Floats, most_m: float = np.inf) -> tuple[Floats, Ints]:
        """Distances (H, M) of points (H, M, 3) from the nearest returns in the tree, and their rows; its size if none is within."""
        distances, rows = self.tree.query(points.reshape(-1, 3), distance_upper_bound=most_m)
        return distances.reshape(points.shape[:2]), rows.reshape(points.shape[:2])


class Agreement:
    """Agreement of scans (N_i, 3): about `queries` returns of each are looked up among at most `returns` of another one.

    They are sampled at equal steps, not at random. `at_least`: whether `queries` is a minimum, else a maximum.
    """

    def __init__(self, scans: Sequence[Array], returns: int, queries: int, *, at_least: bool = False) -> None:
        self._scans, self._returns, self._queries, self._at_least = scans, returns, queries, at_least
        self._indexed: dict[int, _Indexed] = {}

    def scores(self, pairs: Ints, T_j_i: Floats) -> Floats:
        """Scores (H, P) of pairs (P, 2) of scans i and j under H hypotheses; lower scores mean better agreement.

        They are mean logarithms of distances over the spacing there. `T_j_i` (H, P, 4, 4): isometries, proper or improper, from
        the frame of scan i to that of scan j.
        """
        found = np.zeros(T_j_i.shape[:2])
        for p, (i, j) in enumerate(pairs.tolist()):
            for points, scan in self._both_ways(i, j, T_j_i[:, p]):
                # Beyond this bound, the quotient is clipped to _MOST anyway; it saves most of the search.
                distances, nearest = scan.nearest(points, _MOST * scan.spacing_m.max())
                quotients = distances / np.append(scan.spacing_m, 1.0)[nearest]
                found[:, p] += 0.5 * np.log(np.clip(quotients, _LEAST, _MOST)).mean(axis=1)
        return found

    def log_distances(self, i: int, j: int, T_j_i: Floats) -> Floats:
        """Log distances (H, M) between returns of scans i and j, of each to the nearest one, for `T_j_i` (H, 4, 4)."""
        found = [scan.nearest(points)[0] for points, scan in self._both_ways(i, j, T_j_i)]
        return np.log(np.maximum(np.concatenate(found, axis=1), LEAST_M))

    def spacing_m(self, i: int) -> float:
        """Median distance between neighbouring returns of scan i, m; 0 if it has too few."""
        return float(np.median(self._of(i).spacing_m)) if len(self._scans[i]) >= MIN_RETURNS else 0.0

    def _both_ways(self, i: int, j: int, T_j_i: Floats) -> Iterator[tuple[Floats, _Indexed]]:
        """Yield the returns (H, M, 3) of each of two scans in the frame of the other one, and this one."""
        for k, other, T in ((i, j, T_j_i), (j, i, np.asarray(np.linalg.inv(T_j_i), np.float64))):
            # Summed along the returns: along their three coordinates takes 40 times as long.
            points = np.einsum("hab,bn->han", T[:, :3, :3], self._of(k).queries.T) + T[:, :3, 3:]
            yield points.swapaxes(1, 2), self._of(other)

    def _of(self, i: int) -> _Indexed:
        if i not in self._indexed:
            count = len(self._scans[i])
            step = max(1, count // self._queries) if self._at_least else -(-count // self._queries)
            self._indexed[i] = _Indexed(self._scans[i], (-(-count // self._returns), step))
        return self._indexed[i]


def choose_pairs(scans: Sequence[Array], positions: Floats, count: int, lags: Sequence[int] = LAGS) -> Ints:
    """Choose about `count` pairs (P, 2) of scans, spread over the drive, at small and large lags.

    Neighbours overlap most; but at high frame rates, the sensor hardly moves between them, and every hypothesis agrees.
    So in some pairs, the sensor moved by a share of its range, according to the poses. Scans with too few returns are skipped.
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
    return np.concatenate([pairs_apart(usable, lag, -(-count // len(ways))) for lag in ways])


def pairs_apart(scans: Ints, lag: int, count: int) -> Ints:
    """Pairs (P, 2) of scans (K,) at a lag: about `count`, at equal steps."""
    last = len(scans) - lag
    firsts = np.unique(np.linspace(0, last - 1, min(last, count)).round().astype(int))
    return np.stack([scans[firsts], scans[firsts + lag]], 1)


def relative(T_world_sensor: Floats, pairs: Ints) -> Floats:
    """(P, 4, 4) motions T_j_i of pairs (P, 2) of poses (F, 4, 4), from scan i to scan j."""
    return between(T_world_sensor[pairs[:, 1]], T_world_sensor[pairs[:, 0]])


def of_neighbours(scans: Sequence[Floats], queries: int = _SAMPLED) -> Agreement:
    """Compare at least `queries` returns of each scan with all of others."""
    return Agreement(scans, max(map(len, scans)), queries, at_least=True)


def sign_significance(
    scans: Sequence[Floats], velocities: SensorVelocities, times_s: Floats
) -> tuple[float, Floats]:
    """Return the standard errors by which scans agree better with velocities than reversed, and the yaws (2, F - 1) for both."""
    durations_s, agreement = np.diff(times_s), of_neighbours(scans)
    if len(scans) < 2:
        return 0.0, np.zeros((2, 0))
    moved_m = 0.5 * (velocities.mean_mps[1:] + velocities.mean_mps[:-1]) * durations_s[:, None]
    usable = velocities.found[1:] & velocities.found[:-1] & (durations_s <= 2 * np.median(durations_s))
    usable &= np.array([min(len(a), len(b)) > 0 for a, b in itertools.pairwise(scans)], bool)
    # The longest steps are most informative: if the first are twice as clear as needed, the others are not compared, unless
    # the sensor turns so fast that each yaw is needed.
    pairs = sorted(np.flatnonzero(usable).tolist(), key=lambda i: -float(moved_m[i] @ moved_m[i]))
    yaws = np.full((2, len(durations_s)), np.nan)
    gains, significance = list[Floats](), 0.0
    for some in (pairs[:_FIRST_PAIRS], pairs[_FIRST_PAIRS:_PAIRS], pairs[_PAIRS:]):
        for i in some:
            # The motion and its reverse, each with its best yaw.
            ways_m = [sign * _HALF_TURNS @ moved_m[i] for sign in (1.0, -1.0)]
            motions = assembled(np.stack([_TURNS, _TURNS]), np.stack(ways_m)).reshape(-1, 4, 4)
            logs = agreement.log_distances(i + 1, i, motions).reshape(2, len(_TURNS), -1)
            best = logs.mean(axis=2).argmin(axis=1)
            yaws[:, i] = _TURNS_RAD[best]
            gains.append(logs[1, best[1]] - logs[0, best[0]])
        if not gains:
            break
        mean = Gain.of_samples(np.array([gain.mean() for gain in gains]), 1e-6)
        if len(gains) < _FEW_PAIRS:
            # Returns of both scans count, mostly on the same objects: half of them are independent.
            variance = sum(2 * gain.var() / len(gain) for gain in gains) / len(gains) ** 2
            mean = replace(mean, error=np.sqrt(max(variance, 1e-12)))
        significance = float(mean.significance)
        clear = abs(significance) > 2 * CLEAR or len(gains) >= min(_PAIRS, len(pairs))
        if clear and not turns_fast(yaws[int(significance < 0)]):
            break
    return significance, yaws


def turns_fast(yaws: Floats) -> bool:
    """Return whether yaws (F - 1,) between scans, NaN if unknown, are beyond those that tracking expects of an unknown sensor."""
    known = np.abs(yaws[np.isfinite(yaws)])
    return bool(len(known) and np.median(known) > YAW_STEP_RAD)


def motion_significance(scans: Sequence[Floats], firsts: Ints, steps: Floats) -> float:
    """Return by how many standard errors scans `firsts` (K,) and the next ones agree better after steps (K, 4, 4) than after
    their rotations alone."""
    # Negative where a pattern that moves with the sensor, such as that of a straight wall, explains the returns better.
    agreement, both = of_neighbours(scans), np.repeat(steps[:, None], 2, axis=1)
    both[:, 0, :3, 3] = 0
    gains = [
        np.subtract(*agreement.log_distances(i + 1, i, T).mean(axis=1))
        for i, T in zip(firsts.tolist(), both, strict=True)
        if min(len(scans[i]), len(scans[i + 1])) > 0
    ]
    return float(Gain.of_samples(np.array(gains), 1e-6).significance) if len(gains) >= _FEW_PAIRS else 0.0


@dataclass(frozen=True)
class Verdict(Gain):
    """Increase of the log density of other scans' returns at held-out ones, as mean over independent scans.

    `count` is the number of scans, or of places if these are fewer.
    """

    # The same gain for the density in cells far larger than pose errors. Where scans contract, in the end on top of each
    # other, all densities rise, whether or not surfaces agree.
    crowding: float = 0.0

    @property
    def needed(self) -> float:
        """Minimum gain: relevant, significant (Student's t), and not explained by crowding."""
        return max(self._significant(_BY_CHANCE), self.crowding)

    def _significant(self, level: float) -> float:
        if self.count < 2:
            return np.inf
        return max(_LEAST_GAIN, float(student.ppf(1 - level, self.count - 1)) * self.error)

    @property
    def closed(self) -> bool:
        """Whether the gain is that of a closed loop: significant, whether or not scans come closer together."""
        return bool(self.mean > self._significant(_CLOSED_BY_CHANCE))

    @property
    def improved(self) -> bool:
        return bool(self.mean > self.needed)

    @property
    def words(self) -> str:
        first, agree = "The given poses are kept", "do not agree"
        if self.improved:
            first, agree = "The refined poses make a sharper map", "agree"
        change = f"{self.mean:+.2%}, by chance and overlap alone up to {self.needed:.2%}"
        agreement = f"{agree} better with those of other scans (their density changes by {change})"
        return f"{first}: returns that took no part {agreement}."

    @classmethod
    def of(
        cls, held: SensorReturns, used: SensorReturns, before: Floats, after: Floats, noise: SensorNoise
    ) -> "Verdict":
        """Compare `held`-out returns with the `used` ones at poses `before` and `after`.

        Returns are not independent. Those of a scan share the error of its pose. Those of a place may lie on one object that
        moved, or that looks different from each side. The standard error is the larger of the two clustered ones.
        """
        if len(held) == 0:
            return cls(0.0, np.inf, 0)
        held = held.every(-(-len(held) // _MOST_HELD))
        gains = _gains(held, used, before, after, noise)
        edge_m = _PLACE * held.median_range_m
        cells = np.floor(held.posed(before).points / edge_m)
        places = np.unique(cells, axis=0, return_inverse=True)[1].ravel()
        by_scans = Gain.by_groups(gains, held.scans)
        parts = min(by_scans.count, int(places.max()) + 1)
        if parts < 2:
            return cls(0.0, np.inf, parts)
        # Cluster-robust standard error over places.
        sums = np.bincount(places, gains - gains.mean())
        error = float(np.sqrt((sums**2).sum() * len(sums) / (len(sums) - 1)) / len(gains))
        crowding = Gain.by_groups(_crowding(held, used, before, after), held.scans).mean
        return cls(by_scans.mean, max(by_scans.error, error), parts, crowding)


def _gains(
    held: SensorReturns, used: SensorReturns, before: Floats, after: Floats, noise: SensorNoise
) -> Floats:
    """Return the increase (N,) of the log density at the held-out returns."""
    # A nearest neighbour alone mostly reflects the sampling. The density is a sum over several, with a kernel as wide as the noise of
    # both returns and their spacing. Isolated returns are clutter or new objects: with the median density added, they count little.
    variances = noise.mean_variances_m2(held.ranges_m), noise.mean_variances_m2(used.ranges_m)
    densities, apart_m2 = [], 0.0
    for poses in (before, after):
        tree = cKDTree(used.posed(poses).points)
        distances, rows = tree.query(held.posed(poses).points, min(NEIGHBOURS, len(used)))
        distances, rows = distances.reshape(len(held), -1), rows.reshape(len(held), -1)
        others = used.scans[rows] != held.scans[:, None]
        if poses is before:
            apart_m2 = median_apart_m(distances, others) ** 2
        variance = variances[0][:, None] + apart_m2 + variances[1][rows]
        densities.append(np.where(others, density(distances, variance), 0.0).sum(axis=1))
    floor = float(np.median(densities[0]))
    if floor == 0:  # the scans do not overlap
        return np.zeros(len(held))
    return np.log((densities[1] + floor) / (densities[0] + floor))


def density(distances_m: Floats, variances_m2: Floats) -> Floats:
    """Return normal densities of errors of these lengths, up to a factor."""
    with np.errstate(under="ignore"):
        return np.exp(-0.5 * distances_m**2 / variances_m2) / variances_m2**1.5


def median_apart_m(distances_m: Floats, others: Bools) -> float:
    """Return the median distance to the nearest neighbour of another scan, else to the last one, of neighbours (N, K)."""
    nearest = np.where(others.any(axis=1), others.argmax(axis=1), -1)
    return float(np.median(distances_m[np.arange(len(nearest)), nearest]))


def _crowding(held: SensorReturns, used: SensorReturns, before: Floats, after: Floats) -> Floats:
    """Return the increase (N,) of the log number of other scans' returns in the cell of each held-out return."""
    edge_m = _NEARBY * held.median_range_m
    used = used.every(-(-len(used) // _MOST_COUNTED))
    counts = []
    for poses in (before, after):
        points = np.concatenate([held.posed(poses).points, used.posed(poses).points])
        cells = np.unique(np.floor(points / edge_m), axis=0, return_inverse=True)[1].ravel()
        of_held, of_used = np.split(cells, [len(held)])
        # Sparse matrix of counts by cell and scan.
        shape = int(cells.max()) + 1, len(poses)
        table = coo_matrix((np.ones(len(used)), (of_used, used.scans)), shape).tocsr()
        in_cell = np.asarray(table.sum(axis=1)).ravel()[of_held]
        counts.append(in_cell - np.asarray(table[of_held, held.scans]).ravel())
    floor = max(float(np.median(counts[0])), 1.0)
    return np.log((counts[1] + floor) / (counts[0] + floor))
