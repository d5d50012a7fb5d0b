# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Statistics of errors that are drawn from known distributions."""

import math

import numpy as np
import pytest
from radarsdf.evaluation import confidence_metrics, uncertainty_metrics


def drawn(count=100_000, seed=0):
    """Uncertainties from 1 cm to 1 m, and errors of exactly these deviations."""
    rng = np.random.default_rng(seed)
    uncertainty_m = 10 ** rng.uniform(-2, 0, count)
    return uncertainty_m * rng.standard_normal(count), uncertainty_m


def test_perfect_uncertainties():
    error_m, uncertainty_m = drawn()
    m = uncertainty_metrics(error_m, uncertainty_m)
    assert m["coverage_68"] == pytest.approx(0.68, abs=0.005)
    assert m["coverage_95"] == pytest.approx(0.95, abs=0.005)
    assert m["ence"] < 0.02
    assert m["z_rms"] == pytest.approx(1, abs=0.01)
    assert m["worst_decile_factor"] < 1.03
    assert (m["num_points"], m["num_unknown"]) == (100_000, 0)


@pytest.mark.parametrize(("factor", "ence"), [(2.0, 1.0), (0.5, 0.5)], ids=["overconfident", "too careful"])
def test_wrong_by_two(factor, ence):
    error_m, uncertainty_m = drawn()
    m = uncertainty_metrics(error_m, uncertainty_m / factor)
    assert m["ence"] == pytest.approx(ence, abs=0.02)
    assert m["z_rms"] == pytest.approx(factor, rel=0.01)
    assert m["worst_decile_factor"] == pytest.approx(2, rel=0.03)
    # Of a Gaussian, 1.96 / 2 deviations hold 67.3 %, and 1.96 · 2 hold 99.99 %.
    assert m["coverage_95"] == pytest.approx(math.erf(1.959964 / factor / math.sqrt(2)), abs=0.005)


def test_bins_agree_with_a_plain_loop():
    error_m, uncertainty_m = drawn(1003)
    order = np.argsort(uncertainty_m)
    predicted, measured = [], []
    for rows in np.array_split(order, 10):
        predicted.append(math.sqrt(sum(uncertainty_m[i] ** 2 for i in rows) / len(rows)))
        measured.append(math.sqrt(sum(error_m[i] ** 2 for i in rows) / len(rows)))
    m = uncertainty_metrics(error_m, uncertainty_m)
    np.testing.assert_allclose(m["decile_predicted_m"], predicted)
    np.testing.assert_allclose(m["decile_rmse_m"], measured)


def test_perfect_confidences():
    rng = np.random.default_rng(0)
    confidence = rng.random(100_000)
    m = confidence_metrics(confidence, rng.random(100_000) < confidence)
    assert sum(m["bin_count"]) == 100_000
    np.testing.assert_allclose(m["bin_confidence"], np.arange(0.05, 1, 0.1), atol=0.005)
    np.testing.assert_allclose(m["bin_true_share"], m["bin_confidence"], atol=0.02)
    assert m["worst_gap"] < 0.02
    assert m["mean_gap"] < 0.01
    assert m["auc"] == pytest.approx(5 / 6, abs=0.005)
    assert m["true_share"] == pytest.approx(0.5, abs=0.01)


def test_auc_agrees_with_all_pairs():
    rng = np.random.default_rng(0)
    confidence, truth = np.round(rng.random(200), 1), rng.random(200) < 0.4
    a, b = confidence[truth][:, None], confidence[~truth]
    assert confidence_metrics(confidence, truth)["auc"] == pytest.approx(np.mean((a > b) + 0.5 * (a == b)))
    assert confidence_metrics(confidence, np.ones(200, bool))["auc"] is None


def test_bins_of_few_points_do_not_make_the_worst_gap():
    confidence, truth = np.append(np.full(1000, 0.95), 0.05), np.append(np.arange(1000) >= 50, True)
    m = confidence_metrics(confidence, truth)
    assert m["worst_gap"] == pytest.approx(0, abs=1e-9)
    assert m["bin_true_share"] == [1.0, *[None] * 8, pytest.approx(0.95)]
    assert m["bin_count"] == [1, *[0] * 8, 1000]


@pytest.mark.parametrize(
    ("function", "arguments", "name"),
    [
        (uncertainty_metrics, (np.zeros(30), np.ones(31)), "uncertainty_m"),
        (uncertainty_metrics, (np.zeros(30), -np.ones(30)), "uncertainty_m"),
        (uncertainty_metrics, (np.full(30, -np.inf), np.ones(30)), "error_m"),
        (uncertainty_metrics, (np.full(30, np.nan), np.ones(30)), "0 points are too few"),
        (confidence_metrics, ([0.5], [True, False]), "is_true"),
        (confidence_metrics, ([1.5], [True]), "confidence"),
        (confidence_metrics, ([0.5], [np.nan]), "is_true"),
        (confidence_metrics, ([np.nan], [True]), "confidence"),
    ],
)
def test_wrong_arguments_are_refused(function, arguments, name):
    with pytest.raises(ValueError, match=name):
        function(*arguments)
