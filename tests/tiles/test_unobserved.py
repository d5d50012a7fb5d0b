"""Unobserved places are NaN, for every kind of map and quantity."""

import numpy as np
import pytest
import radarsdf
import torch
from radarsdf import FitConfig

SENSOR = np.array([0.0, 0.0, 1.0])
SHORT = {"sdf_iterations": 3, "intensity_iterations": 3, "batch_size": 256, "intensity_batch_size": 256}
CONFIGS = {
    "quick": FitConfig.quick(training=SHORT),
    "octree": FitConfig.paper(training=SHORT, encoding={"kind": "octree"}),
}
# In free space before the sensor, below the ground, far away, and invalid places.
NAN, INF = np.nan, np.inf
NOWHERE = np.array([
    [2.0, 0, 1], [2, 0, -40], [1e7, 0, 0], [0, -1e30, 0], [1e30, 1e30, 1e30], [0, 0, 1e30],
    [NAN, 0, 0], [0, 0, NAN], [0, INF, 0], [-INF, 0, 0], [0, 0, -INF], [NAN, INF, 1e30],
])  # fmt: skip


@pytest.fixture(scope="module", params=[*CONFIGS, "tiles"])
def any_map(request, drive):
    if request.param == "tiles":
        return radarsdf.load(request.getfixturevalue("folder"))
    return radarsdf.fit(drive, config=CONFIGS[request.param], progress=False)


@pytest.fixture(scope="module")
def returns(drive):
    return np.concatenate([scan.world_points for scan in drive])[::50].astype(np.float64)


@pytest.fixture(scope="module")
def sensors(drive):
    return np.concatenate([np.tile(scan.T_world_sensor[:3, 3], (len(scan), 1)) for scan in drive])[::50]


def answers(any_map, x, sensor=SENSOR, **options):
    like = (lambda a: torch.from_numpy(a).to(x.dtype)) if isinstance(x, torch.Tensor) else x.dtype.type
    return {
        "sdf": any_map.sdf(x, **options),
        "gradient": any_map.gradient(x, **options),
        "intensity": any_map.intensity(x, like(sensor), **options),
        "uncertainty": any_map.uncertainty(x),
        "confidence": any_map.confidence(x),
        "observed": any_map.observed(x),
    }


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("kind", [np.asarray, torch.from_numpy])
def test_unobserved_places_are_nan(any_map, kind, dtype):
    found = answers(any_map, kind(NOWHERE.astype(dtype)))
    for name, answer in found.items():
        assert isinstance(answer, type(kind(NOWHERE)))
        assert not getattr(answer, "requires_grad", False)
        values = np.asarray(answer)
        assert values.dtype == (np.bool_ if name == "observed" else dtype)
        assert len(values) == len(NOWHERE)
        if name == "observed":
            assert not values.any()
        elif name == "confidence":
            assert (values == 0).all()
        else:
            assert np.isnan(values).all(), name


def test_exactly_observed_places_have_values(any_map, returns, sensors):
    moved = np.random.default_rng(0).normal(0, 1.0, (4, 3))
    found = answers(any_map, *((places[:, None] + moved).reshape(-1, 3) for places in (returns, sensors)))
    assert 0.1 < found["observed"].mean() < 0.9
    for name in ("sdf", "gradient", "intensity"):
        known = np.isfinite(found[name]).reshape(len(found["observed"]), -1).all(axis=1)
        np.testing.assert_array_equal(known, found["observed"])


@pytest.mark.parametrize("above_m", [[0, 0, 30.0], [0, 0, 1e4]])
def test_unmeasured_views_have_no_intensity(any_map, returns, above_m):
    if any_map.config.networks.reflectance == "network" and above_m[2] < 100:
        pytest.skip("the elevations of returns are known to the closed form alone")
    x = returns[any_map.observed(returns)]
    assert np.isnan(any_map.intensity(x, x + above_m)).all()
    assert np.isfinite(any_map.intensity(x, x + above_m, extrapolate=True)).all()
    mesh = any_map.mesh(0.2, viewpoint=returns.mean(axis=0) + above_m, progress=False)
    assert np.isnan(mesh.vertex_attributes["intensity"]).all()


def test_extrapolation_has_values_everywhere_near_tiles(any_map, returns, sensors):
    x, sensors = np.concatenate([returns, returns + [0.0, 0.0, 30.0]]), np.tile(sensors, (2, 1))
    found, known = answers(any_map, x, sensors, extrapolate=True), answers(any_map, x, sensors)
    for name in ("sdf", "gradient", "intensity"):
        assert np.isfinite(found[name]).all()
        rows = known["observed"]
        np.testing.assert_allclose(found[name][rows], known[name][rows], rtol=1e-5, atol=2e-4)
    nowhere = answers(any_map, NOWHERE[~np.isfinite(NOWHERE).all(axis=1)], extrapolate=True)
    for name in ("sdf", "gradient", "intensity"):
        assert np.isnan(nowhere[name]).all()


@pytest.mark.parametrize("extrapolate", [False, True])
@pytest.mark.parametrize("wild", [np.nan, np.inf, -np.inf])
def test_a_nan_sensor_position_has_no_intensity(any_map, returns, wild, extrapolate):
    for axis in range(3):
        sensor = SENSOR.copy()
        sensor[axis] = wild
        assert np.isnan(any_map.intensity(returns[:5], sensor, extrapolate=extrapolate)).all()
