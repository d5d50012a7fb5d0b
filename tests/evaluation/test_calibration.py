# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Statistics of errors that are drawn from known distributions."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from radarsdf.evaluation import CALIBRATION_PROTOCOL, confidence_metrics, uncertainty_metrics

LEVELS = {"coverage_50": 0.5, "coverage_68": 0.68, "coverage_90": 0.9, "coverage_95": 0.95}
WITHOUT_UNIT = (*LEVELS, "ence", "z_mean", "z_rms", "worst_decile_factor")
METRES = ("mean_error_m", "rmse_m", "mean_uncertainty_m")
METRES_BY_BIN = ("bin_predicted_m", "bin_rmse_m", "decile_predicted_m", "decile_rmse_m")


def drawn(count=100_000, seed=0):
    """Uncertainties from 1 cm to 1 m, and errors of exactly these deviations."""
    rng = np.random.default_rng(seed)
    uncertainty_m = 10 ** rng.uniform(-2, 0, count)
    return uncertainty_m * rng.standard_normal(count), uncertainty_m


def test_perfect_uncertainties():
    error_m, uncertainty_m = drawn()
    m = uncertainty_metrics(error_m, uncertainty_m)
    assert m["protocol"] == CALIBRATION_PROTOCOL
    for name, level in LEVELS.items():
        assert m[name] == pytest.approx(level, abs=0.005), name
    assert m["ence"] < 0.02
    assert m["z_rms"] == pytest.approx(1, abs=0.01)
    assert m["z_mean"] == pytest.approx(0, abs=0.01)
    assert m["worst_decile_factor"] < 1.03
    assert m["deciles_in_order"]
    assert len(m["bin_rmse_m"]) == 20
    assert len(m["decile_rmse_m"]) == 10
    np.testing.assert_allclose(m["bin_rmse_m"], m["bin_predicted_m"], rtol=0.05)
    # The entropy of a Gaussian, and the mean logarithm of the uncertainties.
    assert m["nll"] == pytest.approx(0.5 * math.log(2 * math.pi * math.e) - math.log(10), abs=0.01)
    assert (m["num_points"], m["num_unknown"]) == (100_000, 0)


@pytest.mark.parametrize(("factor", "ence"), [(2.0, 1.0), (0.5, 0.5)], ids=["overconfident", "too careful"])
def test_wrong_by_two(factor, ence):
    error_m, uncertainty_m = drawn()
    m = uncertainty_metrics(error_m, uncertainty_m / factor)
    assert m["ence"] == pytest.approx(ence, abs=0.02)
    assert m["z_rms"] == pytest.approx(factor, rel=0.01)
    assert m["worst_decile_factor"] == pytest.approx(2, rel=0.03)
    assert m["deciles_in_order"]  # the order is right all the same
    # Of a Gaussian, 1.96 / 2 deviations hold 67.3 %, and 1.96 · 2 hold 99.99 %.
    assert m["coverage_95"] == pytest.approx(math.erf(1.959964 / factor / math.sqrt(2)), abs=0.005)
    assert m["nll"] > uncertainty_metrics(error_m, uncertainty_m)["nll"] + 0.3


def test_one_uncertainty_for_all_hides_nothing():
    """The mean is right, so one global factor would be 1. But no bin can tell good points from bad ones."""
    error_m, uncertainty_m = drawn()
    m = uncertainty_metrics(error_m, np.full(len(error_m), np.sqrt(np.mean(uncertainty_m**2))))
    assert m["ence"] < 0.02
    assert m["coverage_50"] > 0.7  # heavy tails
    assert m["nll"] > uncertainty_metrics(error_m, uncertainty_m)["nll"] + 0.3


def test_a_bias_shows():
    error_m, uncertainty_m = drawn()
    m = uncertainty_metrics(error_m + uncertainty_m, uncertainty_m)
    assert m["z_mean"] == pytest.approx(1, abs=0.02)
    assert m["z_rms"] == pytest.approx(math.sqrt(2), abs=0.02)


def test_wrong_order_shows():
    error_m, uncertainty_m = drawn()
    m = uncertainty_metrics(error_m, 0.01 / uncertainty_m)
    assert not m["deciles_in_order"]
    assert m["worst_decile_factor"] > 50


@pytest.mark.parametrize("factor", [0.01, 3.281, 1000.0])
def test_other_units_change_only_what_has_a_unit(factor):
    error_m, uncertainty_m = drawn(5000)
    m, other = (uncertainty_metrics(s * error_m, s * uncertainty_m) for s in (1.0, factor))
    for name in WITHOUT_UNIT:
        assert other[name] == pytest.approx(m[name], rel=1e-9), name
    for name in METRES:
        assert other[name] == pytest.approx(factor * m[name], rel=1e-9), name
    for name in METRES_BY_BIN:
        np.testing.assert_allclose(other[name], factor * np.array(m[name]), rtol=1e-9)
    assert other["nll"] == pytest.approx(m["nll"] + math.log(factor), abs=1e-9)
    assert other["deciles_in_order"] == m["deciles_in_order"]


def test_signs_and_order_of_the_points_do_not_matter():
    error_m, uncertainty_m = drawn(3000)
    uncertainty_m = np.round(uncertainty_m, 1) + 0.05  # most are equal to many others
    order = np.random.default_rng(1).permutation(3000)
    m = uncertainty_metrics(error_m, uncertainty_m)
    shuffled = uncertainty_metrics(error_m[order], uncertainty_m[order])
    mirrored = uncertainty_metrics(-error_m, uncertainty_m)
    for name in (*LEVELS, "ence", "nll", "z_rms", "rmse_m", "worst_decile_factor"):
        assert shuffled[name] == pytest.approx(m[name], rel=1e-12), name
        assert mirrored[name] == pytest.approx(m[name], rel=1e-12), name
    assert mirrored["mean_error_m"] == -m["mean_error_m"]


def test_bins_agree_with_a_plain_loop():
    error_m, uncertainty_m = drawn(1003)
    order = np.argsort(uncertainty_m)
    predicted, measured = [], []
    for rows in np.array_split(order, 7):
        predicted.append(math.sqrt(sum(uncertainty_m[i] ** 2 for i in rows) / len(rows)))
        measured.append(math.sqrt(sum(error_m[i] ** 2 for i in rows) / len(rows)))
    m = uncertainty_metrics(error_m, uncertainty_m, bins=7)
    np.testing.assert_allclose(m["bin_predicted_m"], predicted)
    np.testing.assert_allclose(m["bin_rmse_m"], measured)
    assert m["ence"] == pytest.approx(np.mean(np.abs(np.subtract(predicted, measured)) / predicted))


def test_unknown_points_do_not_count():
    error_m, uncertainty_m = drawn(500)
    m = uncertainty_metrics(error_m, uncertainty_m)
    more_error = np.append(error_m, [np.nan, 9.0, np.nan])
    more_uncertainty = np.append(uncertainty_m, [0.1, np.nan, np.nan])
    assert uncertainty_metrics(more_error, more_uncertainty) == {**m, "num_unknown": 3}


def test_results_are_json_also_without_any_error():
    m = uncertainty_metrics(np.zeros(50), np.full(50, 0.1))
    assert m["coverage_50"] == 1
    assert m["ence"] == 1
    assert math.isfinite(m["worst_decile_factor"])
    json.dumps(m, allow_nan=False)
    json.dumps(confidence_metrics([0.3], [True]), allow_nan=False)


@pytest.mark.parametrize(
    ("error_m", "uncertainty_m", "message"),
    [
        (np.zeros(30), np.ones(31), "must both be"),
        (np.zeros((30, 1)), np.ones((30, 1)), "must both be"),
        (0.0, 1.0, "must both be"),
        (np.zeros(30), np.zeros(30), "uncertainty_m must be"),
        (np.zeros(30), -np.ones(30), "uncertainty_m must be"),
        (np.zeros(30), np.full(30, np.inf), "uncertainty_m must be"),
        (np.full(30, -np.inf), np.ones(30), "error_m must be"),
        (np.zeros(19), np.ones(19), "19 points are too few"),
        (np.full(30, np.nan), np.ones(30), "0 points are too few"),
    ],
)
def test_wrong_errors_are_refused(error_m, uncertainty_m, message):
    with pytest.raises(ValueError, match=message):
        uncertainty_metrics(error_m, uncertainty_m)


def test_perfect_confidences():
    rng = np.random.default_rng(0)
    confidence = rng.random(100_000)
    m = confidence_metrics(confidence, rng.random(100_000) < confidence)
    assert m["protocol"] == CALIBRATION_PROTOCOL
    assert sum(m["bin_count"]) == m["num_points"] == 100_000
    np.testing.assert_allclose(m["bin_confidence"], np.arange(0.05, 1, 0.1), atol=0.005)
    np.testing.assert_allclose(m["bin_true_share"], m["bin_confidence"], atol=0.02)
    assert m["worst_gap"] < 0.02
    assert m["mean_gap"] < 0.01
    assert m["brier"] == pytest.approx(1 / 6, abs=0.005)  # mean of p (1 - p)
    assert m["auc"] == pytest.approx(5 / 6, abs=0.005)
    assert m["true_share"] == pytest.approx(0.5, abs=0.01)


def test_too_high_confidences():
    rng = np.random.default_rng(0)
    confidence = rng.random(50_000)
    m = confidence_metrics(confidence, rng.random(50_000) < confidence / 2)
    assert m["worst_gap"] == pytest.approx(0.475, abs=0.03)  # of the last bin
    assert m["mean_gap"] == pytest.approx(0.25, abs=0.02)


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
    # However many bins there are, some bin counts.
    confidence = np.linspace(0, 1, 1001)
    assert confidence_metrics(confidence, confidence > 2, bins=1000)["worst_gap"] > 0.9


def test_points_without_confidence_do_not_count():
    m = confidence_metrics([0.0, 1.0, np.nan], [0, 1, 1])
    assert (m["num_points"], m["num_unknown"], m["brier"], m["auc"]) == (2, 1, 0.0, 1.0)


@pytest.mark.parametrize(
    ("confidence", "is_true", "message"),
    [
        ([0.5], [True, False], "must both be"),
        ([[0.5]], [[True]], "must both be"),
        ([1.5], [True], r"in \[0, 1\]"),
        ([-0.1], [True], r"in \[0, 1\]"),
        ([0.5], [0.5], "True or False"),
        ([0.5], [np.nan], "True or False"),
        ([np.nan], [True], "no point has a confidence"),
        ([], [], "no point has a confidence"),
    ],
)
def test_wrong_confidences_are_refused(confidence, is_true, message):
    with pytest.raises(ValueError, match=message):
        confidence_metrics(confidence, is_true)
