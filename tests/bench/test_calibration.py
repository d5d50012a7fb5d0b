"""The calibration experiment, with uncertainties that are known to be correct, too small, or missing."""

import numpy as np
import pytest

from bench.paper.calibration import compared
from bench.truth import along_normals
from scenes.scene import load_scene


@pytest.fixture(scope="module")
def scene():
    return load_scene("wall", frames=10)


@pytest.fixture(scope="module")
def surface(scene):
    """Points of the wall's front with Gaussian errors of known standard deviations along its normal."""
    rng = np.random.default_rng(0)
    y, z = rng.uniform(-6, 6, 6000), rng.uniform(0.6, 2.5, 6000)
    x = np.column_stack([np.zeros(6000), y, z])
    normals = np.tile([1.0, 0.0, 0.0], (6000, 1))
    # Exclude windows and the reflector, which stand out.
    x -= along_normals(scene.simulation.scene, x + 0.2 * normals, normals)[:, None] * normals - 0.2 * normals
    sigma_m = rng.uniform(0.01, 0.1, 6000)
    return x + (sigma_m * rng.standard_normal(6000))[:, None] * normals, normals, sigma_m


def test_a_calibrated_map_has_nominal_coverage(scene, surface):
    x, normals, sigma_m = surface
    row = compared(scene, x, normals, sigma_m, np.ones(len(x)), 0.2)
    assert row["coverage_95"] == pytest.approx(0.95, abs=0.01)
    assert row["ence"] < 0.06
    assert row["worst_decile_factor"] < 1.1
    assert (row["false_share"], row["unobserved_share"]) == (0, 0)
    assert row["aside_share"] < 0.05
    assert row["confidence_worst_gap"] < 0.01


def test_false_surface_and_unknown_points_are_shares(scene, surface):
    x, normals, sigma_m = (array.copy() for array in surface)
    x[:600, 0] += 2.0  # in free space
    sigma_m[600:900] = np.nan
    row = compared(scene, x, normals, sigma_m, np.where(np.arange(6000) < 600, 0.05, 0.95), 0.2)
    assert row["false_share"] == pytest.approx(0.1, abs=0.02)  # some reach the ground or the reflector
    assert row["unobserved_share"] == pytest.approx(0.05)
    assert row["coverage_95"] == pytest.approx(0.95, abs=0.01)  # of the other points
    assert row["num_points"] + row["num_unknown"] == 6000
    assert row["confidence_auc"] > 0.95
