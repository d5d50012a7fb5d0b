"""Calibration of a map: standard errors in metres, and confidences as probabilities."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import ndtri
from scipy.stats import rankdata

from radarsdf.arrays import Floats
from radarsdf.checks import check, real_array

CALIBRATION_PROTOCOL = "radarsdf-calibration-1"  # changes with the meaning of a number

_ENCE_BINS = 20
_DECILES = 10
_LEAST_M = 1e-12  # keeps ratios of squares from overflowing
_LEAST_SHARE = 0.01  # smallest share of points in a bin


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
        If the shapes differ, a value is infinite, an uncertainty is below 1e-12, or fewer than 20 points are
        left.
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

    Raises
    ------
    ValueError
        If the shapes differ, a confidence is not in [0, 1], `is_true` has other values than 0 and 1, or no point has a
        confidence.
    TypeError
        If the values are not real numbers.

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
