"""Errors of predicted intensities, with the paper's nearest-neighbour baseline, and of stated uncertainties and confidences."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import ndtri
from scipy.stats import rankdata

from radarsdf.arrays import ArrayLike, Floats, Ints
from radarsdf.checks import check, positions, real_array, whole_number
from radarsdf.threads import resolve_num_threads

INTENSITY_PROTOCOL = "radarsdf-intensity-1"  # changes with the meaning of a number

_CHUNK = 1 << 21  # candidates of all queries processed at once: about 130 MB
_DISTANCE_M, _ANGLE_RAD = 0.1, 0.1  # noise of the returns: smaller differences hardly change a weight
_SETTINGS = ((4, 4), (8, 8), (16, 16), (16, 64), (16, 128), (16, 256))  # (k, candidates)
_EVERY = 5  # spacing of the training scans held out to choose between them
_MAX_QUERIES = 20_000  # held-out returns predicted for the choice, evenly spread

CALIBRATION_PROTOCOL = "radarsdf-calibration-1"  # changes with the meaning of a number

_ENCE_BINS = 20
_DECILES = 10
_LEAST_M = 1e-12  # keeps ratios of squares from overflowing
_LEAST_SHARE = 0.01  # smallest share of points in a bin


def intensity_metrics(predicted: ArrayLike, measured: ArrayLike) -> dict[str, Any]:
    """Compute the errors of predicted intensities.

    Raises a ValueError if the shapes differ, there is no return, or a value is not finite, since every return needs a
    prediction; a TypeError for values that are not real numbers.

    Parameters
    ----------
    predicted, measured : (N,) array_like
        Intensities, sensor units.

    Returns
    -------
    dict of str to float
        `mae` and `medae`, mean and median absolute error in the sensor's units, and `num_returns`.
    """
    p, m = _paired(predicted, "predicted", measured, "measured")
    check(p.size, "predicted and measured must both be (N,), with at least one return")
    error = np.abs(p - m)
    check(np.isfinite(error).all(), "predicted and measured must be finite")
    errors = {"mae": float(error.mean()), "medae": float(np.median(error))}
    return {"protocol": INTENSITY_PROTOCOL, **errors, "num_returns": p.size}


def holdout(frames: int | Iterable[int], every: int = 10) -> tuple[Ints, Ints]:
    """Split scans into training and held-out ones: in ascending order, scans 0, `every`, 2 · `every`, … are held out.

    Raises a ValueError if `every` is below 2, or there are fewer than two scans: no scan would be left to train on.

    Parameters
    ----------
    frames : int or iterable of int
        Number of scans F, for the scans 0 … F-1; or scan numbers in any order, possibly repeated, such as one for each return.
    every : int
        Distance between held-out scans, at least 2.

    Returns
    -------
    train, test : (A,), (B,) int64
        Scan numbers, ascending. Select returns with ``numpy.isin(frame, test)``.

    Examples
    --------
    >>> train, test = holdout(7, every=3)
    >>> train.tolist(), test.tolist()
    ([1, 2, 4, 5], [0, 3, 6])
    """
    real_array(frames, "frames")
    numbers = np.arange(frames) if isinstance(frames, (int, np.integer)) else np.asarray(frames)
    fits = not numbers.size or numbers.dtype.kind in "iu"
    check(fits, "frames must be a number of scans or integer frame numbers")
    numbers = np.unique(numbers)
    what = f"every {every}th of {numbers.size} scans"
    check(min(every, numbers.size) >= 2, f"cannot hold out {what}: at least one must remain to train on")
    held_out = np.arange(numbers.size) % every == 0
    return numbers[~held_out].astype(np.int64), numbers[held_out].astype(np.int64)


class KNNIntensity:
    """Intensity from the nearest returns seen from a similar direction: the paper's baseline.

    The search selects the `candidates` returns nearest in space, and of these the `k` with the most similar
    viewing direction. Their intensities are averaged with the weights 1 / ((distance + 0.1 m) · (angle + 0.1 rad)). The paper
    specifies neither `k`, `candidates` nor the weights, and no choice suits all scenes: compare with :meth:`chosen`.

    Parameters
    ----------
    points_world : (N, 3) array_like
        Returns of the training scans, world frame, m.
    sensor_positions : (N, 3) or (3,) array_like
        Position of the sensor for each return, world frame, m.
    intensities : (N,) array_like
        Sensor units.
    candidates, k : int
        Sizes of the two selections, 1 ≤ k ≤ candidates, capped at the number of returns.

    Raises
    ------
    ValueError, TypeError
        If a shape is wrong, a value is not finite or out of its range, or a return lies at the sensor itself.

    Examples
    --------
    >>> import numpy as np
    >>> points = np.random.default_rng(0).uniform(-5, 5, (600, 3)) + [20.0, 0.0, 0.0]
    >>> scans = np.arange(600) // 100  # six scans
    >>> knn = KNNIntensity.chosen(points, [0.0, 0.0, 0.0], points[:, 1], scans)
    >>> 1 <= knn.k <= knn.candidates <= 256
    True
    """

    def __init__(
        self,
        points_world: ArrayLike,
        sensor_positions: ArrayLike,
        intensities: ArrayLike,
        *,
        candidates: int = 20,
        k: int = 16,
    ) -> None:
        points, self._directions = _rays(points_world, sensor_positions)
        self._values = real_array(intensities, "intensities")
        check(len(points), "the baseline needs at least one return")
        fits = self._values.shape == (len(points),) and np.isfinite(self._values).all()
        check(fits, f"intensities must be ({len(points)},) and finite, but have shape {self._values.shape}")
        ascending = whole_number(k, "k", 1) <= whole_number(candidates, "candidates", 1)
        check(ascending, f"1 <= k <= candidates is needed, not k={k}, candidates={candidates}")
        self._origin = points.mean(axis=0)
        self._tree = cKDTree(points - self._origin)
        self.candidates = min(candidates, len(points))
        """Number of returns that are nearest in space, of which `k` are chosen."""
        self.k = min(k, len(points))
        """Number of returns whose intensities are averaged."""

    @classmethod
    def chosen(
        cls, points_world: ArrayLike, sensor_positions: ArrayLike, intensities: ArrayLike, scans: ArrayLike
    ) -> "KNNIntensity":
        """Build the baseline with the best `candidates` and `k` for these training scans.

        Every fifth training scan is held out and predicted from the others. The lowest mean absolute error selects
        4 of 4, 8 of 8, or 16 of 16, 64, 128 or 256 candidates. The result uses all training scans; of a single one, which cannot
        be held out, it has the defaults of the class. Raises the errors of the class, also if `scans` are not (N,) integers.

        Parameters
        ----------
        points_world, sensor_positions, intensities
            As for the class. Pass the training scans only: a choice based on the evaluation scans is not fair.
        scans : (N,) array_like of int
            Scan number of each return. Whole scans are held out, since returns of one scan share view and noise.
        """
        points, values = positions(points_world, "points"), real_array(intensities, "intensities")
        sensors = np.broadcast_to(real_array(sensor_positions, "sensor positions"), points.shape)
        numbers = np.asarray(scans)
        fits = numbers.shape == values.shape and np.issubdtype(numbers.dtype, np.integer)
        check(fits, f"scans must be ({len(values)},) integers, not {numbers.shape} {numbers.dtype}")
        if numbers.min() == numbers.max():
            return cls(points, sensors, values)
        test = np.isin(numbers, holdout(numbers, _EVERY)[1])
        queries = np.flatnonzero(test)
        queries = queries[:: -(-len(queries) // _MAX_QUERIES)]

        def error(setting: tuple[int, int]) -> float:
            k, candidates = setting
            inner = cls(points[~test], sensors[~test], values[~test], candidates=candidates, k=k)
            return float(np.abs(inner.predict(points[queries], sensors[queries]) - values[queries]).mean())

        k, candidates = min(_SETTINGS, key=error)
        return cls(points, sensors, values, candidates=candidates, k=k)

    def predict(self, x: ArrayLike, sensor_positions: ArrayLike) -> Floats:
        """Predict the intensities (M,) float64, sensor units, at points (M, 3) for sensor positions (M, 3) or (3,), world, m.

        They are defined everywhere: far from all returns, they are those of the nearest returns. Raises the errors of the class.
        """
        points, directions = _rays(x, sensor_positions)
        predicted = np.zeros(len(points))
        ranks = np.arange(1, self.candidates + 1)  # an int k=1 would drop a dimension
        step = max(1, _CHUNK // self.candidates)
        for start in range(0, len(points), step):
            part = slice(start, start + step)
            near = points[part] - self._origin
            distance, index = self._tree.query(near, k=ranks, workers=resolve_num_threads(0))
            chord = np.linalg.norm(self._directions[index] - directions[part, None], axis=2)
            angle = 2.0 * np.arcsin(np.minimum(0.5 * chord, 1.0))  # accurate at small angles, unlike arccos
            weight = 1.0 / ((distance + _DISTANCE_M) * (angle + _ANGLE_RAD))
            closest = np.argpartition(angle, self.k - 1, axis=1)[:, : self.k]
            weight, index = (np.take_along_axis(values, closest, axis=1) for values in (weight, index))
            predicted[part] = (weight * self._values[index]).sum(axis=1) / weight.sum(axis=1)
        return predicted


def _rays(points: ArrayLike, sensors: ArrayLike) -> tuple[Floats, Floats]:
    """Points (N, 3) and the unit vectors (N, 3) from the sensor to each, after checks of both arguments."""
    x = positions(points, "points")
    s = positions(np.atleast_2d(real_array(sensors, "sensor positions")), "sensor positions")
    check(len(s) in {1, len(x)}, f"sensor positions must be ({len(x)}, 3) or (3,), not {s.shape}")
    ray = x - s
    length = np.linalg.norm(ray, axis=1, keepdims=True)
    check(not (length == 0).any(), "a point lies at its sensor position: it has no viewing direction")
    return x, ray / length


def uncertainty_metrics(error_m: ArrayLike, uncertainty_m: ArrayLike) -> dict[str, Any]:
    """Compare errors with their predicted standard errors.

    Parameters
    ----------
    error_m : (N,) array_like
        Signed errors, m: the distance from the true surface along the normal. NaN where it is unknown.
    uncertainty_m : (N,) array_like
        Predicted standard error of each, m. NaN where nothing was observed.

    Returns
    -------
    dict of str to float
        - `coverage_68`, `coverage_95`: share of the errors within the central interval of this probability of a
          Gaussian with mean zero. Less is overconfident.
        - `ence`, expected normalised calibration error: mean of ``|predicted - measured| / predicted`` over 20 equally
          filled bins of ascending uncertainty, where both are root mean squares. Perfect is 0, up to the noise of the
          bins. A prediction of half the true error gives 1.
        - `decile_predicted_m`, `decile_rmse_m`: root mean squares of uncertainties and errors in ten such bins.
          `worst_decile_factor`: the largest ratio of the two, in either direction.
        - `z_rms`: root mean square of error / uncertainty. Perfect is 1.
        - `mean_error_m`, `rmse_m`, `mean_uncertainty_m`: bias, size of the errors, and sharpness.
        - `num_points`, and `num_unknown` points with NaN in either array, which are ignored.

    Raises
    ------
    ValueError
        If the shapes differ, a value is infinite, an uncertainty is below 1e-12, or fewer than 20 points are known.
    TypeError
        If the values are not real numbers.

    Notes
    -----
    Points of equal uncertainty share their mean squared error, so the order of points does not matter. Errors of
    neighbouring points of a surface are correlated, so results on a single surface scatter more.

    Examples
    --------
    >>> import numpy as np
    >>> uncertainty_m = np.full(1000, 0.1)
    >>> error_m = np.random.default_rng(0).normal(0, 0.2, 1000)
    >>> metrics = uncertainty_metrics(error_m, uncertainty_m)  # the prediction is half of the truth
    >>> round(metrics["z_rms"], 1), round(metrics["ence"], 1)
    (2.0, 1.0)
    """
    error, sigma = _paired(error_m, "error_m", uncertainty_m, "uncertainty_m")
    fits = not np.isinf(error).any() and not ((sigma < _LEAST_M) | np.isinf(sigma)).any()
    check(fits, f"error_m must be finite or NaN, and uncertainty_m at least {_LEAST_M:g} m")
    known = ~(np.isnan(error) | np.isnan(sigma))
    error, sigma = error[known], sigma[known]
    check(len(error) >= _ENCE_BINS, f"{len(error)} points are too few for {_ENCE_BINS} bins")
    z = error / sigma
    predicted, measured = _by_uncertainty(error, sigma, _ENCE_BINS)
    decile_predicted, decile_measured = _by_uncertainty(error, sigma, _DECILES)
    # A zero error everywhere would be wrong by an infinite factor, which JSON cannot store.
    ratio = np.maximum(decile_measured, _LEAST_M * decile_predicted) / decile_predicted
    return {
        "protocol": CALIBRATION_PROTOCOL,
        "coverage_68": float(np.mean(np.abs(z) <= ndtri(0.84))),
        "coverage_95": float(np.mean(np.abs(z) <= ndtri(0.975))),
        "ence": float(np.mean(np.abs(predicted - measured) / predicted)),
        "z_rms": float(np.sqrt(np.mean(z**2))),
        "mean_error_m": float(error.mean()),
        "rmse_m": float(np.sqrt(np.mean(error**2))),
        "mean_uncertainty_m": float(sigma.mean()),
        "decile_predicted_m": decile_predicted.tolist(),
        "decile_rmse_m": decile_measured.tolist(),
        "worst_decile_factor": float(np.maximum(ratio, 1 / ratio).max()),
        "num_points": len(error),
        "num_unknown": int(np.count_nonzero(~known)),
    }


def confidence_metrics(confidence: ArrayLike, is_true: ArrayLike) -> dict[str, Any]:
    """Compare confidences in a surface with the share of true surface.

    Raises a ValueError if the shapes differ, a value is out of its range, or no point has a confidence; a TypeError for values
    that are not real numbers.

    Parameters
    ----------
    confidence : (N,) array_like
        Probability that there is a surface, in [0, 1]. Points with NaN, where nothing was observed, are ignored.
    is_true : (N,) array_like
        Whether there is one: bool, or 0 and 1.

    Returns
    -------
    dict of str to float
        - `bin_count`, `bin_confidence`, `bin_true_share`: number of points, mean confidence and share of true ones in
          ten bins of equal width. The last two are None in an empty bin.
        - `worst_gap`: largest ``|confidence - share|`` of a bin with at least 1 % of the points. `mean_gap`: mean over all
          bins, weighted by their points; others call it expected calibration error.
        - `auc`: probability that a true point has a higher confidence than a false one; 0.5 is chance. None if all
          are true or all are false.
        - `true_share`: share of true points among all.

    Examples
    --------
    >>> metrics = confidence_metrics([0.9, 0.9, 0.9, 0.1], [True, True, False, False])
    >>> round(metrics["mean_gap"], 3), round(metrics["auc"], 3)
    (0.2, 0.75)
    """
    p, truth = _paired(confidence, "confidence", is_true, "is_true")
    known = ~np.isnan(p)
    p, truth = p[known], truth[known]
    fits = len(p) != 0 and not ((p < 0) | (p > 1)).any() and np.isin(truth, (0, 1)).all()
    check(fits, "confidence must be in [0, 1], or NaN but for some, and is_true True or False")
    count, mean, share = (np.histogram(p, _DECILES, (0, 1), weights=of)[0] for of in (None, p, truth))
    mean, share = mean / np.maximum(count, 1), share / np.maximum(count, 1)
    gap = np.abs(mean - share)
    num_true, ranks = int(truth.sum()), float(rankdata(p)[truth == 1].sum())
    pairs = num_true * (len(p) - num_true)
    return {
        "protocol": CALIBRATION_PROTOCOL,
        "bin_count": count.tolist(),
        "bin_confidence": [float(v) if n else None for v, n in zip(mean, count, strict=True)],
        "bin_true_share": [float(v) if n else None for v, n in zip(share, count, strict=True)],
        "worst_gap": float(gap[count >= _LEAST_SHARE * len(p)].max()),
        "mean_gap": float(gap @ count / len(p)),
        # Mann-Whitney statistic by ranks, where ties count half.
        "auc": (ranks - num_true * (num_true + 1) / 2) / pairs if pairs else None,
        "true_share": float(truth.mean()),
    }


def _paired(a: ArrayLike, name_a: str, b: ArrayLike, name_b: str) -> tuple[Floats, Floats]:
    first, second = real_array(a, name_a), real_array(b, name_b)
    fits = first.ndim == 1 and first.shape == second.shape
    check(fits, f"{name_a} {first.shape} and {name_b} {second.shape} must both be (N,)")
    return first, second


def _by_uncertainty(error: Floats, sigma: Floats, bins: int) -> tuple[Floats, Floats]:
    """Root mean squares (bins,) of uncertainties and errors, in equally filled bins of ascending uncertainty."""
    levels, level, count = np.unique(sigma, return_inverse=True, return_counts=True)
    squared_error = np.bincount(level, error**2) / count
    by_level = (np.array_split(np.repeat(values, count), bins) for values in (levels**2, squared_error))
    predicted, measured = (np.sqrt([part.mean() for part in parts]) for parts in by_level)
    return predicted, measured
