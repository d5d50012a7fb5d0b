"""Motion between scans: priors, predictions, and measurements."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.stats import qmc
from typing_extensions import Self

from radarsdf.arrays import Bools, Floats, Ints
from radarsdf.poses.rigid import rotation, rotation_vector, skew, step_vectors, steps, transform

_PRIOR_STEPS = 3.0  # weight of the initial motion prior, steps
# Steps over which changes are measured. A smooth motion changes more over several than a random walk of its single steps: the largest
# spectral density counts. Errors of odometry by three radars are 9 to 18 % smaller.
_LAGS = 1, 2, 4, 8, 16
_SPAN = 4.0  # width of a search, standard deviations
_FEWEST, _MOST = 64, 8192  # limits of the number of poses of a search
_AT_ONCE = 1e-3  # duration of a step between two radars that measure at the same time, median steps
_LEAST_SPAN = 0.1  # minimum duration of a step, median steps: two scans at the same time may still differ
_MOST_AT_ONCE = 8  # maximum number of such steps in succession: the band of the prior includes them
LEAST_S = 1e-6  # of a step, against division by zero
_YAW = 5  # component of a step
_NO_LEVER = np.zeros((3, 3))
_LEAST = np.square([1e-5, 1e-6])  # minimum variances, m² and rad², below the resolution of any radar


@dataclass(frozen=True)
class MotionPrior:
    """Prior of a rate with three components: rotation, rad/s, or translation, m/s."""

    usual: Floats  # (3,) mean square
    change: Floats  # (3,) mean square of its change per second
    # Whether the rate is mean-reverting (Ornstein-Uhlenbeck process) or a random walk. Turns end, a drive goes on: with
    # mean-reverting velocities, the error of a sparse simulated drive without Doppler was 4.8 m instead of 0.25; with
    # random-walk turns, that of a real one 7.9 m instead of 1.
    settles: bool

    def after(self, rate: "MotionRate | None", elapsed_s: float) -> "MotionRate":
        """Predict the rate `elapsed_s` later. `rate` None: unknown."""
        if rate is None:
            return MotionRate(np.zeros(3), np.diag(self.usual))
        if not self.settles:
            return MotionRate(rate.mean, rate.covariance + np.diag(self.change) * elapsed_s)
        share = float(np.exp(-0.5 * elapsed_s * self.change.sum() / self.usual.sum()))
        covariance = share**2 * rate.covariance + (1 - share**2) * np.diag(self.usual)
        return MotionRate(share * rate.mean, covariance)

    def transition(self, elapsed_s: Floats) -> tuple[Floats, Floats]:
        """Share of a rate that remains after `elapsed_s` (K,), and the variance of what is added to it, (K, 3) each."""
        elapsed_s = elapsed_s[:, None]
        if not self.settles:
            return np.ones((len(elapsed_s), 3)), elapsed_s * self.change
        # By axis: a sensor that keeps turning in yaw may still pitch at random.
        share = np.exp(-0.5 * elapsed_s * self.change / self.usual)
        return share, (1 - share**2) * self.usual

    def learnt(
        self, rates: "Sequence[MotionRate | None]", durations_s: Floats, *, with_errors: bool = False
    ) -> "MotionPrior":
        """Update from rates (None: lost) and durations of steps; `with_errors`: squares include the errors of the rates."""
        unknown = np.full(3, np.nan)
        means = np.array([unknown if rate is None else rate.mean for rate in rates])
        errors = np.array([unknown if rate is None else rate.covariance.diagonal() for rate in rates])
        if not np.isfinite(means).any():
            return self

        def mean(squares: Floats, prior: Floats | float) -> Floats:
            known = squares[np.isfinite(squares).all(axis=1)]
            return (_PRIOR_STEPS * prior + known.sum(axis=0)) / (_PRIOR_STEPS + len(known))

        def density(squares: Floats, lag: int, prior: Floats | float) -> Floats:
            apart_s = middles_s[lag:] - middles_s[:-lag]
            return mean(squares / np.where(apart_s > 0, apart_s, np.nan)[:, None], prior)

        usual = mean(means**2 + with_errors * errors, self.usual)
        middles_s = np.cumsum(durations_s) - durations_s / 2
        lags = _LAGS if with_errors else (1,)
        changes = [density((means[lag:] - means[:-lag]) ** 2, lag, self.change) for lag in lags]
        of_errors = with_errors * density(errors[1:] + errors[:-1], 1, 0.0)
        return MotionPrior(usual, np.max(changes, axis=0) + of_errors, self.settles)


@dataclass(frozen=True)
class MotionRate:
    mean: Floats  # (3,)
    covariance: Floats  # (3, 3)

    def integrate(self, duration_s: float) -> "MotionRate":
        return MotionRate(self.mean * duration_s, self.covariance * duration_s**2)


Priors = tuple[MotionPrior, MotionPrior]  # translation, rotation


def way(
    turn: Floats, begin_mps: Floats, end_mps: Floats, duration_s: float | Floats, levers: Floats = _NO_LEVER
) -> Floats:
    """Return the translation (..., 3), m, in the first frame, of a sensor with a constant rate of rotation over `turn` (..., 3)
    and linearly changing velocity. `levers` (..., 3, 3): its derivative by the turn, due to lever arms of radars, m."""

    def turned(share: float, vectors: Floats) -> Floats:
        return np.einsum("...ij,...j->...i", rotation(share * turn), vectors)

    moved = duration_s / 6 * (begin_mps + 4 * turned(0.5, 0.5 * (begin_mps + end_mps)) + turned(1.0, end_mps))
    return moved + turned(0.5, np.einsum("...ij,...j->...i", levers, turn))


@dataclass(frozen=True)
class PredictedStep:
    """Predicted motion from one scan to the next, in the frame of the first, before its returns are used."""

    turn: MotionRate  # rotation vector, rad
    begin_mps: Floats  # (3,) velocity at the first scan, in its frame
    end_mps: Floats  # (3,) velocity at the second scan, in its frame
    translation_covariance: Floats  # (3, 3) of the translation given the turn, m²
    duration_s: float
    lever: Floats = field(default_factory=_NO_LEVER.copy)  # (3, 3) as in :func:`way`, m

    def pose(self, turn: Floats | None = None) -> Floats:
        """Return the pose (..., 4, 4) after rotation vectors `turn` (..., 3). None: the predicted one."""
        turn = self.turn.mean if turn is None else turn
        return transform(turn, way(turn, self.begin_mps, self.end_mps, self.duration_s, self.lever))

    def covariance(self, turn: Floats | None = None) -> Floats:
        """Return covariances (..., 6, 6) of translation and rotation vector, in the first frame, correlated by turns (..., 3)."""
        turn = self.turn.mean if turn is None else turn
        # Derivative of the translation by the turn: about that of its second half.
        swept = self.lever - skew(self.duration_s / 2 * rotation(turn) @ self.end_mps)
        both = np.concatenate([swept, np.broadcast_to(np.eye(3), swept.shape)], axis=-2)
        covariance = both @ self.turn.covariance @ both.swapaxes(-1, -2)
        covariance[..., :3, :3] += self.translation_covariance
        return covariance

    def spread_m(self, radius_m: float) -> float:
        """Return the largest standard deviation of the position of a return at range `radius_m`, m."""
        moved = np.linalg.eigvalsh(self.covariance()[:3, :3])[-1]
        turned = np.linalg.eigvalsh(self.turn.covariance)[-1]
        return float(np.sqrt(max(moved + radius_m**2 * turned, 0.0)))

    def candidates(self, capture_m: float, radius_m: float) -> tuple[Floats, Floats]:
        """Sample turns (K, 3) and poses (K, 4, 4) of the prediction, about `capture_m` apart for returns at range `radius_m`."""
        turns, turn_axes = np.linalg.eigh(self.turn.covariance)
        ways, way_axes = np.linalg.eigh(self.translation_covariance)
        deviations = np.sqrt(np.maximum(np.concatenate([turns, ways]), 0.0))
        needed = np.maximum(1.0, _SPAN * deviations / np.repeat([capture_m / radius_m, capture_m], 3)).prod()
        count = int(np.clip(2 ** np.ceil(np.log2(needed)), _FEWEST, _MOST))
        # A quasi-random sequence covers space more evenly than random numbers (Sobol 1967).
        draws = qmc.MultivariateNormalQMC(np.zeros(6), seed=0).random(count) * deviations
        drawn = self.turn.mean + draws[:, :3] @ turn_axes.T
        poses = self.pose(drawn)
        poses[:, :3, 3] += draws[:, 3:] @ way_axes.T
        return drawn, poses


def _jacobians(poses: Floats) -> tuple[Floats, Floats]:
    """Return Jacobians (F - 1, 6, 6) of the residuals by increments of the first and the second pose of a step."""
    first, second = np.zeros((2, len(poses) - 1, 6, 6))
    back = poses[:-1, :3, :3].transpose(0, 2, 1)
    first[:, :3, :3], second[:, :3, :3] = -back, back
    first[:, :3, 3:] = np.einsum("fij,fjk->fik", back, skew(poses[1:, :3, 3] - poses[:-1, :3, 3]))
    turned_back = poses[1:, :3, :3].transpose(0, 2, 1)
    first[:, 3:, 3:], second[:, 3:, 3:] = -turned_back, turned_back
    return first, second


def step_variances(poses: Floats, diagonal: Floats, below: Floats) -> Floats:
    """Return variances (F - 1, 6) of the steps of `poses`, whose covariance has blocks (F, 6, 6) and (F - 1, 6, 6)."""
    first, second = _jacobians(poses)
    blocks = ((first, diagonal[:-1], first), (second, diagonal[1:], second), (second, 2 * below, first))
    variances = np.sum([np.einsum("fai,fij,faj->fa", *block) for block in blocks], axis=0)
    return np.maximum(variances, _LEAST[1])  # of a weak prior, blocks cancel


@dataclass(frozen=True)
class Motion:
    """Motions between neighbouring scans measured by one source: given poses, Doppler, or a gyroscope."""

    steps: Floats  # (F - 1, 4, 4)
    shares: Floats  # (F - 1, 6) factors of the variances. Infinite for components that are not measured
    spans: Floats  # (F - 1,) duration of each step relative to the median, to which biases are proportional
    # (2,) of a component of a step's translation, m², and rotation, rad², at share 1
    variances: Floats = field(default_factory=lambda: np.ones(2), kw_only=True)
    # (6,) bias of a step: translation, m, rotation vector, rad, in the sensor frame
    bias: Floats = field(default_factory=lambda: np.zeros(6), kw_only=True)
    # (6,) standard deviation of the systematic part of the bias, not observable from this source.
    bias_sigma: Floats = field(default_factory=lambda: np.zeros(6), kw_only=True)

    @classmethod
    def of(cls, poses: Floats, sigma_m: float, sigma_rad: float, times_s: Floats) -> "Motion":
        """Build from poses (F, 4, 4) at `times_s` (F,). Step errors accumulate: variances grow with time."""
        spans = spans_of(times_s)
        shares = np.repeat(spans[:, None], 6, axis=1)
        variances = np.maximum(np.square([sigma_m, sigma_rad]), _LEAST)
        return cls(steps(poses), shares, spans, variances=variances)

    def evidence(self) -> "Motion":
        """Return the part that is independent of the returns, for covariances."""
        return self

    def errors(self, poses: Floats) -> Floats:
        """Return residuals (F - 1, 6) of `poses` (F, 4, 4) against the measured steps: translations, m, rotation vectors, rad."""
        found = steps(poses)
        turns = np.einsum("fji,fjk->fik", self.steps[:, :3, :3], found[:, :3, :3])
        off_m = found[:, :3, 3] - self.steps[:, :3, 3]
        return np.concatenate([off_m, rotation_vector(turns)], 1)

    def jacobians(self, poses: Floats) -> tuple[Ints, Floats]:
        """Return the poses (K, F - 1) on which each residual depends, and its Jacobians (K, F - 1, 6, 6) by their increments."""
        step = np.arange(len(self.spans))
        return np.stack([step, step + 1]), np.stack(_jacobians(poses))

    def prior(self, poses: Floats) -> tuple[Floats, Floats]:
        """Return the normal equations of increments of `poses`: band (F, W, 6, 6) as in CommonPlanes.solve, gradient (F, 6)."""
        information = 1 / (np.repeat(self.variances, 3) * self.shares)
        scans, jacobians = self.jacobians(poses)
        errors = self.errors(poses) - self.bias * self.spans[:, None]
        last = (scans.max(axis=0) - scans.min(axis=0)).max()
        band, gradient = np.zeros((len(poses), last + 1, 6, 6)), np.zeros((len(poses), 6))
        for rows, jacobian in zip(scans, jacobians * information[:, :, None], strict=True):
            np.add.at(gradient, rows, np.einsum("fki,fk->fi", jacobian, errors))
            for columns, other in zip(scans, jacobians, strict=True):
                lower = rows >= columns
                blocks = np.einsum("fki,fkj->fij", jacobian[lower], other[lower])
                np.add.at(band, (rows[lower], last - (rows - columns)[lower]), blocks)
        return band, gradient

    def by_bias(self, poses: Floats) -> tuple[Floats, Floats]:
        """Return derivatives (K, F, 6) of the gradient by uncertain, normalised bias components, and their information (K,)."""
        rows = np.flatnonzero(self.bias_sigma)
        weights = self.spans[:, None] / (np.repeat(self.variances, 3) * self.shares) * self.bias_sigma
        found = np.zeros((len(rows), len(poses), 6))
        for scans, jacobian in zip(*self.jacobians(poses), strict=True):
            found[:, scans] -= np.einsum("fki,fk->kfi", jacobian[:, rows], weights[:, rows])
        return found, (weights * self.spans[:, None] * self.bias_sigma).sum(axis=0)[rows]

    def updated(self, poses: Floats, before: Floats, diagonal: Floats, below: Floats) -> "Motion":
        """Re-estimate bias and variances from `poses`.

        Their covariance has blocks `diagonal` (F, 6, 6) and `below` (F - 1, 6, 6), of increments of the poses `before`: at other
        poses, the gauge freedom would count as step errors. One step of expectation maximisation (Dempster et al. 1977): the
        expected square of an error is the square of its estimate plus its variance.
        """
        left, errors = step_variances(before, diagonal, below), self.errors(poses)
        spans, weights, counts = self.spans[:, None], 1 / self.shares, np.isfinite(self.shares).sum(axis=0)
        bias = (weights * spans * errors).sum(axis=0) / np.maximum((weights * spans**2).sum(axis=0), 1e-30)
        # Where the returns hardly constrain the poses, along a corridor say, bias and poses would drift together without end:
        # a straight corridor shrank by 3 cm a step. So the bias is shrunk by the share of the variance that remains. Not in yaw:
        # all walls measure it, little in a step but much in many. Sparse simulated laps with 0.2 degrees a step did not close.
        variances = np.repeat(self.variances, 3)
        left_mean = (weights * left).sum(axis=0) / np.maximum(counts, 1)
        gained = bias**2 * np.maximum(variances - left_mean, 0.0)
        bias[:_YAW] *= (gained / np.maximum(gained + left_mean * variances, 1e-30))[:_YAW]
        squares = ((errors - bias * spans) ** 2 + left) * weights
        sums, counts = squares.sum(axis=0).reshape(2, 3).sum(axis=1), counts.reshape(2, 3).sum(axis=1)
        found = np.maximum(sums / np.maximum(counts, 1), _LEAST)
        return replace(self, bias=bias, variances=np.where(counts > 0, found, self.variances))


@dataclass(frozen=True)
class SteadyMotion(Motion):
    """Steps predicted by the motion priors, each from the one before it.

    Tracked steps, taken as measurements, keep the errors that they share with the returns: heights in a forest were wrong by 2 to 7
    times as much.
    """

    before: Ints  # (F - 1,) the step by which each is predicted
    ratios: Floats  # (F - 1, 6) of its expectation to that step; 0: none
    usual: Floats  # (2,) variances of a step given the usual rates only, m² and rad²

    @classmethod
    def by(cls, priors: Priors, usual: Floats, times_s: Floats, poses: Floats, known: Bools) -> Self:
        """Build from scans, mean squares of rates `usual` (2,), and the components (6,) of steps `known` by other sources."""
        durations_s, usual_s = np.maximum(np.diff(times_s), LEAST_S), usual_duration_s(np.diff(times_s))
        # Radars that measure almost at once show no rate: as rates of 0, such steps bent both ends of a drive by 5 degrees.
        step = np.arange(len(durations_s))
        timed = np.where(durations_s >= _LEAST_SPAN * usual_s, step, -1)
        before = np.append(-1, np.maximum.accumulate(timed)[:-1])
        before = np.where((before >= 0) & (step - before <= _MOST_AT_ONCE), before, step)
        both = [prior.transition((durations_s + durations_s[before]) / 2) for prior in priors]
        kept, added = (np.concatenate(parts, axis=1) for parts in zip(*both, strict=True))
        follows, all_usual = (before < step)[:, None], np.concatenate([prior.usual for prior in priors])
        ratios = np.where(follows, kept * (durations_s / durations_s[before])[:, None], 0.0)
        variances = np.where(follows, added, all_usual) * durations_s[:, None] ** 2
        shares = np.where(known, np.inf, np.maximum(variances, np.repeat(_LEAST, 3)))
        return cls(steps(poses), shares, spans_of(times_s), before, ratios, usual_s**2 * usual).updated(poses)

    def updated(self, poses: Floats, *_: Floats) -> Self:
        """Predict each step of `poses` from the one before it."""
        moves, turns = np.split(self.ratios * step_vectors(poses)[self.before], 2, axis=1)
        return replace(self, steps=transform(turns, moves))

    def jacobians(self, poses: Floats) -> tuple[Ints, Floats]:
        scans, own = super().jacobians(poses)
        predicted = -self.ratios[:, :, None] * own[:, self.before]
        return np.concatenate([scans, scans[:, self.before]]), np.concatenate([own, predicted])

    def evidence(self) -> Motion:
        """Return the usual rates alone: similarity to neighbouring steps is no independent measurement."""
        shares = np.where(np.isinf(self.shares), np.inf, self.spans[:, None])
        return Motion(self.steps, shares, self.spans, variances=self.usual, bias_sigma=self.bias_sigma)


def unsteadiness(poses: Floats, times_s: Floats) -> tuple[float, float]:
    """Return standard deviations of the changes between successive steps of poses (F, 4, 4), treated as noise: m, rad.

    Repeated poses, or poses of another clock, have errors as large as the steps: with less, returns would seem outliers.
    """
    if len(poses) < 3:
        return 0.0, 0.0
    spans = spans_of(times_s)
    rates = step_vectors(poses) / spans[:, None]
    squares = np.diff(rates, axis=0) ** 2 / (1 / spans[1:] + 1 / spans[:-1])[:, None]
    sigma_m, sigma_rad = np.sqrt(np.median(squares.reshape(-1, 2, 3).mean(axis=2), axis=0)).tolist()
    return sigma_m, sigma_rad


def spans_of(times_s: Floats) -> Floats:
    """Return durations (F - 1,) of steps relative to the median."""
    durations = np.maximum(np.diff(times_s), 0.0)
    usual_s = usual_duration_s(durations)
    if usual_s == 0:
        return np.ones(len(durations))
    return np.where(durations > 0, np.maximum(durations / usual_s, _LEAST_SPAN), _AT_ONCE)


def usual_duration_s(durations_s: Floats) -> float:
    """Return the median of those durations that are positive: radars of a rig may measure at once. 0 if there are none."""
    positive = durations_s[durations_s > 0]
    return float(np.median(positive)) if len(positive) else 0.0


def interpolate(times_s: Floats, at_s: Floats, values: Floats) -> Floats:
    """Interpolate values (G, 3) at ascending times (G,) linearly at `times_s` (F,)."""
    return np.stack([np.interp(times_s, at_s, column) for column in values.T], 1)
