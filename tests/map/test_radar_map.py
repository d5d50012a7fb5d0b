"""Queries of a map: array types, chunks and threads."""

import numpy as np
import pytest
import torch
from radarsdf.field.field import NeuralField

SENSOR = np.array([0.5, 0.0, 1.5])


def near_surface(count, seed=0):
    """Points near the surface, mostly observed."""
    rng = np.random.default_rng(seed)
    return rng.uniform([8, -5, -0.25], [20.2, 5, 0.25], (count, 3))


def on_surface(radar_map, count):
    """Observed points (N, 3)."""
    x = near_surface(4 * count)
    return x[radar_map.observed(x)][:count]


def queries(radar_map):
    return {
        "sdf": radar_map.sdf,
        "gradient": radar_map.gradient,
        "observed": radar_map.observed,
        "intensity": lambda x: radar_map.intensity(x, SENSOR),
    }


@pytest.fixture(params=["sdf", "gradient", "observed", "intensity"])
def query(request, sharp_map):
    return request.param, queries(sharp_map)[request.param]


def test_sensor_positions_broadcast(sharp_map):
    x = on_surface(sharp_map, 30)
    one = sharp_map.intensity(x, SENSOR)
    np.testing.assert_array_equal(sharp_map.intensity(x, np.tile(SENSOR, (30, 1))), one)
    np.testing.assert_array_equal(sharp_map.intensity(torch.from_numpy(x), torch.from_numpy(SENSOR)), one)
    np.testing.assert_array_equal(sharp_map.intensity(x, SENSOR.tolist()), one)
    sensors = SENSOR + np.random.default_rng(0).uniform(-0.5, 0.5, (30, 3))
    each = sharp_map.intensity(x, sensors)
    for i in (0, 7, 29):
        assert sharp_map.intensity(x[i : i + 1], sensors[i]) == pytest.approx(each[i], abs=1e-3)
    assert not np.allclose(each, one, atol=1e-3)


def test_a_nan_point_does_not_affect_others(query):
    name, function = query
    x = near_surface(9)
    clean = function(x)
    x[4] = np.nan
    x[6] = 1e12
    answer = function(x)
    keep = np.isin(np.arange(9), [4, 6], invert=True)
    np.testing.assert_array_equal(answer[keep], clean[keep])
    if name == "observed":
        assert not answer[[4, 6]].any()
    else:
        assert np.isnan(answer[4]).any()


@pytest.mark.parametrize("extrapolate", [False, True])
def test_distances_and_gradients_in_one_call(sharp_map, extrapolate):
    x = np.concatenate([near_surface(9_000), [[np.nan, 0, 0], [1e12, 0, 0]]])
    for like in (x, x.astype(np.float32), torch.from_numpy(x), x[:0]):
        sdf, gradient = sharp_map.sdf(like, extrapolate=extrapolate, return_gradient=True)
        assert type(sdf) is type(like)
        np.testing.assert_array_equal(sdf, sharp_map.sdf(like, extrapolate=extrapolate))
        np.testing.assert_array_equal(gradient, sharp_map.gradient(like, extrapolate=extrapolate))


def test_gradient_is_the_derivative_of_the_distance(sharp_map):
    x = on_surface(sharp_map, 400)
    local = torch.from_numpy((x - sharp_map.origin).astype(np.float32)).double()
    field = NeuralField(sharp_map.field.table.leaf_keys(), sharp_map.config, with_intensity=True)
    field.load_state_dict(sharp_map.field.state_dict(), assign=True)
    field.double()  # so that differences over a tiny step are exact enough
    step = 1e-6
    with torch.no_grad():
        ends = [
            [field.logit(local + sign * step * torch.eye(3)[axis]) for sign in (1, -1)] for axis in range(3)
        ]
    difference = torch.stack([(a - b) * field.sigma_m / (2 * step) for a, b in ends], 1).numpy()
    gradient = sharp_map.gradient(x)
    # A few steps cross a cell border or the kink of a ReLU.
    assert np.quantile(np.abs(difference - gradient).max(axis=1), 0.95) < 1e-3
    assert np.median(gradient[x[:, 0] < 19.5, 2]) > 0.5
