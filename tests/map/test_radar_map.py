# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""A map answers in kind, in any chunks and from any thread."""

from __future__ import annotations

import dataclasses
import threading

import numpy as np
import pytest
import radarsdf
import torch
from radarsdf.field.neural_field import NeuralField
from radarsdf.map.queries import evaluate, evidence, to_local
from radarsdf.map.radar_map import RadarMap
from radarsdf.returns.intensities import IntensityScale

SENSOR = np.array([0.5, 0.0, 1.5])


def near_surface(count, seed=0):
    """Points round the surface, of which most are observed."""
    rng = np.random.default_rng(seed)
    return rng.uniform([8, -5, -0.25], [20.2, 5, 0.25], (count, 3))


def on_surface(radar_map, count):
    """Points (N, 3) of which all are observed."""
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


def test_numpy_in_numpy_out_torch_in_torch_out(query):
    name, function = query
    x = near_surface(50)
    shape = (50, 3) if name == "gradient" else (50,)
    for dtype, torch_dtype in ((np.float32, torch.float32), (np.float64, torch.float64)):
        array, tensor = function(x.astype(dtype)), function(torch.from_numpy(x.astype(dtype)))
        assert type(array) is np.ndarray
        assert type(tensor) is torch.Tensor
        assert array.shape == tuple(tensor.shape) == shape
        assert array.dtype == (np.bool_ if name == "observed" else dtype)
        assert tensor.dtype == (torch.bool if name == "observed" else torch_dtype)
        np.testing.assert_array_equal(array, tensor.numpy())
        assert not tensor.requires_grad


def test_lists_are_double_precision(query):
    name, function = query
    x = near_surface(5)
    answer = function(x.tolist())
    assert answer.dtype == (np.bool_ if name == "observed" else np.float64)
    np.testing.assert_array_equal(answer, function(x))


def test_precision_of_the_answer_does_not_decide_that_of_the_query(sharp_map):
    far = RadarMap(dataclasses.replace(sharp_map._contents, origin=sharp_map.origin + [5e5, 5.4e6, 0]))
    x = near_surface(300)
    for near_query, far_query in ((sharp_map.sdf, far.sdf), (sharp_map.gradient, far.gradient)):
        difference = np.abs(far_query(x + [5e5, 5.4e6, 0]) - near_query(x))
        # float64 at UTM coordinates resolves 1e-9 m, float32 of the local frame 1e-6 m; float32 there half a metre.
        assert np.nanmedian(difference) < 1e-4
    assert (far.observed(x + [5e5, 5.4e6, 0]) == sharp_map.observed(x)).mean() > 0.999


def test_strided_and_read_only_arrays(query):
    _, function = query
    x = near_surface(40)
    wide = np.zeros((80, 6))
    wide[::2, ::2] = x
    view = wide[::2, ::2]
    view.setflags(write=False)
    np.testing.assert_array_equal(function(view), function(x))
    np.testing.assert_array_equal(function(np.asfortranarray(x)), function(x))
    read_only = x.copy()  # as those that trimesh gives
    read_only.setflags(write=False)
    np.testing.assert_array_equal(function(read_only), function(x))
    np.testing.assert_array_equal(function(torch.from_numpy(wide)[::2, ::2]), function(x))


def test_queries_leave_their_input_alone(query):
    _, function = query
    x = torch.from_numpy(near_surface(20)).requires_grad_()
    before = x.detach().clone()
    function(x)
    assert torch.equal(x.detach(), before)
    assert x.grad is None


def test_one_sensor_position_or_one_each(sharp_map):
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


def test_a_point_at_the_sensor_has_a_finite_intensity(sharp_map):
    x = on_surface(sharp_map, 3)
    assert np.isfinite(sharp_map.intensity(x, x)).all()


@pytest.mark.parametrize("shape", [(3,), (5, 2), (5, 4), (2, 5, 3), ()])
def test_wrong_shapes(query, shape):
    _, function = query
    with pytest.raises(ValueError, match=r"positions must have shape \(N, 3\)"):
        function(np.zeros(shape))
    with pytest.raises(ValueError, match=r"positions must have shape \(N, 3\)"):
        function(torch.zeros(shape))


@pytest.mark.parametrize("shape", [(4, 3), (6, 3), (1, 3), (2,), (5, 2), ()])
def test_wrong_sensor_positions(sharp_map, shape):
    with pytest.raises(ValueError, match="positions must have shape"):
        sharp_map.intensity(near_surface(5), np.zeros(shape))


def test_empty_queries(query):
    name, function = query
    for empty in (np.zeros((0, 3)), torch.zeros(0, 3)):
        answer = function(empty)
        assert tuple(answer.shape) == ((0, 3) if name == "gradient" else (0,))
        assert type(answer) is type(empty)


def test_a_point_that_is_nowhere_does_not_spoil_its_neighbours(query):
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


def test_chunks_do_not_change_answers(query):
    name, function = query
    x = near_surface(20_001)  # more than two chunks, and a rest
    whole = function(x)
    pieces = np.concatenate([function(part) for part in np.array_split(x, 11)])
    if name == "observed":
        np.testing.assert_array_equal(whole, pieces)
    else:  # a matrix product of other height may add in another order
        np.testing.assert_allclose(whole, pieces, atol=2e-4 if name == "intensity" else 2e-5, rtol=1e-5)


def test_evaluate_keeps_the_order_and_wants_no_gradient():
    x = torch.arange(50_000.0)[:, None]
    grads = []

    def double(chunk):
        grads.append(torch.is_grad_enabled())
        return 2 * chunk[:, 0]

    assert torch.equal(evaluate(double, x), 2 * x[:, 0])
    assert len(grads) > 2
    assert not any(grads)
    assert torch.is_grad_enabled()


def test_an_error_in_a_chunk_arrives():
    def fail(chunk):
        if chunk[0, 0] > 20_000:
            msg = "broken chunk"
            raise ArithmeticError(msg)
        return chunk[:, 0]

    threads = torch.get_num_threads()
    with pytest.raises(ArithmeticError, match="broken chunk"):
        evaluate(fail, torch.arange(50_000.0)[:, None])
    assert torch.get_num_threads() == threads


def test_many_threads_at_once_get_the_answers_of_one(sharp_map):
    sizes = [10, 9_000, 500, 20_000]
    inputs = [near_surface(size, seed) for seed, size in enumerate(sizes)]
    expected = [{name: f(x) for name, f in queries(sharp_map).items()} for x in inputs]
    failures = []
    start = threading.Barrier(len(inputs))

    def work(i):
        start.wait()
        for _ in range(4):
            for name, function in queries(sharp_map).items():
                answer = function(inputs[i])
                if not np.allclose(answer, expected[i][name], atol=2e-4, equal_nan=True):
                    failures.append((i, name))

    threads = [threading.Thread(target=work, args=(i,)) for i in range(len(inputs))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not failures


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
    # A few steps cross the border of a cell or of a ReLU's linear piece.
    assert np.quantile(np.abs(difference - gradient).max(axis=1), 0.95) < 1e-3
    assert np.median(gradient[x[:, 0] < 19.5, 2]) > 0.5


def test_nbytes_is_that_of_features_and_weights(scene, sharp_map):
    vertices = sharp_map.report["vertices"]
    features = vertices * 8 * 4
    encoding = (
        3 * 8 + 6 * 10
    )  # three levels of eight features, sine and cosine of ten frequencies on three axes
    sdf = (encoding * 32 + 32) + (32 * 32 + 32) + (32 + 1)
    width = sharp_map.field.intensity_network.layers[0].in_features
    intensity = (width * 64 + 64) + 2 * (64 * 64 + 64) + (64 + 1)
    assert sharp_map.nbytes == features + 4 * (sdf + intensity)
    config = radarsdf.FitConfig(training={"sdf_iterations": 1, "batch_size": 64})
    without = radarsdf.fit(scene.points, scene.poses, config=config, origin=sharp_map.origin, progress=False)
    assert without.nbytes == features + 4 * sdf


def test_repr_says_what_it_is_and_what_its_file_takes(scene, sharp_map, tmp_path):
    cells = sharp_map.report["leaf_cells"]
    assert (
        repr(sharp_map)
        == f"RadarMap(surface and reflectance, {cells} cells, {sharp_map.file_bytes / 1e6:.1f} MB)"
    )
    sharp_map.save(tmp_path / "map.safetensors")
    names = (tmp_path / "map.safetensors").stat().st_size - sharp_map.file_bytes
    assert 0 < names < 5000  # with checksums of all arrays
    config = radarsdf.FitConfig(training={"sdf_iterations": 1, "batch_size": 64})
    assert repr(radarsdf.fit(scene.points, scene.poses, config=config)).startswith("RadarMap(surface, ")


def test_the_report_counts(scene, sharp_map):
    report = sharp_map.report
    assert report["returns"] == sum(map(len, scene.points))
    assert report["returns_used"] == report["returns"]  # none is nearer than 2.5 m
    assert report["iterations"] == {"sdf": 150, "intensity": 60}
    assert all(np.isfinite(loss) and loss > 0 for loss in report["losses"].values())
    assert all(report[name] >= 0 for name in ("prepare_s", "occupied_cells_s", "training_s"))


def test_a_map_without_intensities_says_so(scene):
    config = radarsdf.FitConfig(training={"sdf_iterations": 1, "batch_size": 64})
    radar_map = radarsdf.fit(scene.points, scene.poses, config=config, progress=False)
    assert not radar_map.has_intensity
    with pytest.raises(ValueError, match="fitted without intensities"):
        radar_map.intensity(near_surface(3), SENSOR)


def test_intensity_scale():
    values = np.array([-20.0, 5.0, 30.0], np.float32)
    scale = IntensityScale.of(values)
    np.testing.assert_allclose(scale.to_unit(values), [0, 0.5, 1])
    np.testing.assert_allclose(scale.to_sensor(torch.from_numpy(scale.to_unit(values))), values)
    assert IntensityScale.of(None) is None


def test_confidence_is_that_of_the_returns_round_a_point(sharp_map, scene):
    returns = np.concatenate(
        [p @ T[:3, :3].T + T[:3, 3] for p, T in zip(scene.points, scene.poses, strict=True)]
    )
    confidence = sharp_map.confidence(returns)
    assert confidence.dtype == np.float64
    assert (confidence > 0).all()
    assert (confidence < 1).all()
    near = np.abs(returns[:, None] - returns[None, :300]).max(axis=2) < 0.3  # 27 cells of 0.2 m, centred
    # The odds grow with what these tell together. Their number alone counts only where they are too few for a surface.
    ranges_m = np.linalg.norm(np.concatenate(scene.points), axis=1)
    range_m, azimuth_rad, elevation_rad = sharp_map.report["noise"].values()
    information = 1 / (range_m**2 + ranges_m**2 * (azimuth_rad**2 + elevation_rad**2))
    odds = confidence[:300] / (1 - confidence[:300])
    assert np.corrcoef(information @ near, odds)[0, 1] > 0.8
    assert (sharp_map.confidence(returns + [0, 0, 50.0]) == 0).all()
    # Continuous: no step from one cell to the next. It falls steeply only where the information ends.
    line = np.linspace(returns[0] - 0.5, returns[0] + 0.5, 2001)
    found = evidence(sharp_map._contents, to_local(sharp_map._contents, torch.from_numpy(line)))
    for column in found:
        assert column.diff().abs().max() < 0.02 * column.max()
    known = (found.information > 0.01 * found.information.max()).numpy()
    assert 0.1 < known.mean() < 0.9
    assert np.abs(np.diff(sharp_map.confidence(line)))[known[1:] & known[:-1]].max() < 0.02
