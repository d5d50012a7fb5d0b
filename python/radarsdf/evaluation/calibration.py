# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Whether a map knows its own errors: standard errors in metres, and confidences as probabilities."""

from __future__ import annotations

from typing import TypedDict

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtri

from radarsdf.checks import real_array, whole_number

CALIBRATION_PROTOCOL = "radarsdf-calibration-1"  # changes when the meaning of a number changes

_Floats = NDArray[np.float64]
_DECILES = 10
_LEAST_M, _MOST_M = 1e-12, 1e12  # squares, and ratios of two such lengths squared, are far from overflow
_LEAST_SHARE = 0.01  # of the points. The share of true ones among fewer says little


class UncertaintyMetrics(TypedDict):
    """Result of `uncertainty_metrics`: errors and uncertainties in metres, coverages in [0, 1]."""

    protocol: str
    coverage_50: float
    coverage_68: float
    coverage_90: float
    coverage_95: float
    ence: float
    nll: float
    z_mean: float
    z_rms: float
    mean_error_m: float
    rmse_m: float
    mean_uncertainty_m: float
    bin_predicted_m: list[float]
    bin_rmse_m: list[float]
    decile_predicted_m: list[float]
    decile_rmse_m: list[float]
    worst_decile_factor: float
    deciles_in_order: bool
    num_points: int
    num_unknown: int


class ConfidenceMetrics(TypedDict):
    """Result of `confidence_metrics`: probabilities and shares in [0, 1]. None where there is no number."""

    protocol: str
    bin_count: list[int]
    bin_confidence: list[float | None]
    bin_true_share: list[float | None]
    worst_gap: float
    mean_gap: float
    brier: float
    auc: float | None
    true_share: float
    num_points: int
    num_unknown: int


def uncertainty_metrics(
    error_m: ArrayLike, uncertainty_m: ArrayLike, *, bins: int = 20
) -> UncertaintyMetrics:
    """Compare errors with their predicted standard errors.

    Parameters
    ----------
    error_m : (N,) array_like
        Signed errors, m: the distance from the true surface along the normal. NaN where it is not known.
    uncertainty_m : (N,) array_like
        Predicted standard error of each, m. NaN where nothing was observed.
    bins : int
        Number of equally filled bins for `ence`. Its value depends on this number: compare only equal ones.

    Returns
    -------
    UncertaintyMetrics
        - `coverage_50` to `coverage_95`: share of the errors within the central interval of this probability of a
          Gaussian with mean zero. Perfect is 0.5, 0.68, 0.9 and 0.95. Less is overconfident.
        - `bin_predicted_m`, `bin_rmse_m`: root mean square of the uncertainties and of the errors in each bin, from the
          lowest uncertainty to the highest.
        - `ence`, expected normalised calibration error: mean over the bins of ``|predicted - measured| / predicted``.
          Perfect is 0, up to the noise of the bins. A prediction of half the true error gives 1.
        - `decile_predicted_m`, `decile_rmse_m`: the same in ten bins. `worst_decile_factor`: the largest ratio of the
          two, in either direction. `deciles_in_order`: whether the errors never fall from one decile to the next.
        - `nll`: mean negative log likelihood of the errors under the Gaussians, in nats, with errors in m. Lower is
          better. In another unit of length it moves by the logarithm of the ratio.
        - `z_mean`, `z_rms`: mean and root mean square of error / uncertainty. Perfect are 0 and 1.
        - `mean_error_m`, `rmse_m`, `mean_uncertainty_m`: bias, size of the errors, and sharpness.
        - `num_points`, and `num_unknown` points with NaN in either array, which do not count.

    Raises
    ------
    ValueError
        If the shapes differ, a value is infinite or beyond 1e12, an uncertainty is below 1e-12, or fewer points than
        bins are left.
    TypeError
        If the values are not real numbers.

    Notes
    -----
    Points of equal uncertainty share their mean squared error, so the order of the points does not matter. Errors of
    neighbouring points of a surface are correlated, so numbers of one surface scatter more.

    Examples
    --------
    >>> import numpy as np
    >>> uncertainty_m = np.full(1000, 0.1)
    >>> error_m = np.random.default_rng(0).normal(0, 0.2, 1000)
    >>> metrics = uncertainty_metrics(error_m, uncertainty_m)  # the prediction is half of the truth
    >>> round(metrics["z_rms"], 1), round(metrics["ence"], 1)
    (2.0, 1.0)
    """
    whole_number(bins, "bins", 1)
    error, sigma = _paired(error_m, "error_m", uncertainty_m, "uncertainty_m")
    if (np.abs(error) > _MOST_M).any() or ((sigma > _MOST_M) | (sigma < _LEAST_M)).any():
        msg = f"error_m must be within {_MOST_M:g} m, uncertainty_m {_LEAST_M:g} to {_MOST_M:g} m, or NaN"
        raise ValueError(msg)
    known = ~(np.isnan(error) | np.isnan(sigma))
    error, sigma = error[known], sigma[known]
    if len(error) < max(bins, _DECILES):
        msg = f"{len(error)} points are too few for {max(bins, _DECILES)} bins"
        raise ValueError(msg)
    z = error / sigma
    predicted, measured = _by_uncertainty(error, sigma, bins)
    decile_predicted, decile_measured = _by_uncertainty(error, sigma, _DECILES)
    # An error of exactly zero everywhere would be wrong by an infinite factor, which JSON does not have.
    ratio = np.maximum(decile_measured, _LEAST_M * decile_predicted) / decile_predicted
    return UncertaintyMetrics(
        protocol=CALIBRATION_PROTOCOL,
        coverage_50=_coverage(z, 0.5),
        coverage_68=_coverage(z, 0.68),
        coverage_90=_coverage(z, 0.9),
        coverage_95=_coverage(z, 0.95),
        ence=float(np.mean(np.abs(predicted - measured) / predicted)),
        nll=float(np.mean(np.log(sigma) + 0.5 * z**2) + 0.5 * np.log(2 * np.pi)),
        z_mean=float(z.mean()),
        z_rms=_root_mean_square(z),
        mean_error_m=float(error.mean()),
        rmse_m=_root_mean_square(error),
        mean_uncertainty_m=float(sigma.mean()),
        bin_predicted_m=predicted.tolist(),
        bin_rmse_m=measured.tolist(),
        decile_predicted_m=decile_predicted.tolist(),
        decile_rmse_m=decile_measured.tolist(),
        worst_decile_factor=float(np.maximum(ratio, 1 / ratio).max()),
        deciles_in_order=bool((np.diff(decile_measured) >= 0).all()),
        num_points=len(error),
        num_unknown=int(np.count_nonzero(~known)),
    )


def confidence_metrics(confidence: ArrayLike, is_true: ArrayLike, *, bins: int = 10) -> ConfidenceMetrics:
    """Compare confidences in a surface with the share of true surface.

    Parameters
    ----------
    confidence : (N,) array_like
        Probability that there is a surface, in [0, 1]. NaN where nothing was observed.
    is_true : (N,) array_like
        Whether there is one: bool, or 0 and 1.
    bins : int
        Number of bins of equal width from 0 to 1.

    Returns
    -------
    ConfidenceMetrics
        - `bin_count`, `bin_confidence`, `bin_true_share`: number of points, mean confidence and share of true ones in
          each bin. The last two are None in an empty bin. A confidence of 1 is in the last bin.
        - `worst_gap`: largest ``|confidence - share|`` of a bin with at least 1 % of the points. `mean_gap`: mean over all
          bins, weighted by their points; others call it expected calibration error.
        - `brier`: mean squared difference of confidence and truth. Lower is better.
        - `auc`: probability that a true point has a higher confidence than a false one; 0.5 tells nothing. None if all
          are true or all are false.
        - `true_share`: share of true points among all.
        - `num_points`, and `num_unknown` points with NaN as confidence, which do not count.

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
    whole_number(bins, "bins", 1)
    p, truth = _paired(confidence, "confidence", is_true, "is_true")
    if ((p < 0) | (p > 1)).any():
        msg = "confidence must be in [0, 1], or NaN"
        raise ValueError(msg)
    if not ((truth == 0) | (truth == 1)).all():
        msg = "is_true must be True or False"
        raise ValueError(msg)
    known = ~np.isnan(p)
    p, truth = p[known], truth[known]
    if len(p) == 0:
        msg = "no point has a confidence"
        raise ValueError(msg)
    index = np.minimum((p * bins).astype(np.int64), bins - 1)
    count = np.bincount(index, minlength=bins)
    filled = np.maximum(count, 1)
    mean = np.bincount(index, p, minlength=bins) / filled
    share = np.bincount(index, truth, minlength=bins) / filled
    gap = np.abs(mean - share)
    # With many bins, all could be small. The fullest one always counts.
    enough = count >= min(_LEAST_SHARE * len(p), count.max())
    return ConfidenceMetrics(
        protocol=CALIBRATION_PROTOCOL,
        bin_count=count.tolist(),
        bin_confidence=[float(v) if n else None for v, n in zip(mean, count, strict=True)],
        bin_true_share=[float(v) if n else None for v, n in zip(share, count, strict=True)],
        worst_gap=float(gap[enough].max()),
        mean_gap=float(gap @ count / len(p)),
        brier=float(np.mean((p - truth) ** 2)),
        auc=_auc(p, truth == 1),
        true_share=float(truth.mean()),
        num_points=len(p),
        num_unknown=int(np.count_nonzero(~known)),
    )


def _paired(a: ArrayLike, name_a: str, b: ArrayLike, name_b: str) -> tuple[_Floats, _Floats]:
    """Two arguments as arrays (N,)."""
    first, second = real_array(a, name_a), real_array(b, name_b)
    if first.ndim != 1 or first.shape != second.shape:
        msg = f"{name_a} {first.shape} and {name_b} {second.shape} must both be (N,)"
        raise ValueError(msg)
    return first, second


def _coverage(z: _Floats, probability: float) -> float:
    return float(np.mean(np.abs(z) <= ndtri((1 + probability) / 2)))


def _root_mean_square(values: _Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _by_uncertainty(error: _Floats, sigma: _Floats, bins: int) -> tuple[_Floats, _Floats]:
    """Root mean squares (bins,) of uncertainties and errors, in equally filled bins of ascending uncertainty."""
    levels, level, count = np.unique(sigma, return_inverse=True, return_counts=True)
    squared_error = np.bincount(level, error**2) / count
    by_level = [np.repeat(values, count) for values in (levels**2, squared_error)]
    predicted, measured = (
        np.sqrt([part.mean() for part in np.array_split(values, bins)]) for values in by_level
    )
    return predicted, measured


def _auc(p: _Floats, truth: NDArray[np.bool_]) -> float | None:
    """Area under the receiver operating characteristic, by ranks. Equal values count as half."""
    num_true = int(np.count_nonzero(truth))
    num_false = len(p) - num_true
    if num_true == 0 or num_false == 0:
        return None
    _, level, count = np.unique(p, return_inverse=True, return_counts=True)
    rank = (np.cumsum(count) - (count - 1) / 2)[level]
    return float((rank[truth].sum() - num_true * (num_true + 1) / 2) / (num_true * num_false))
