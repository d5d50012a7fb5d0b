# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Any arguments for the public functions: an answer with the properties that are stated, or a ValueError or TypeError.

The same examples on every run; `python -m bench.stress arguments --count 5000` tries other ones, and more of them.
"""

from __future__ import annotations

import dataclasses
import math
import os
from types import SimpleNamespace

import numpy as np
import pytest
import radarsdf
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from radarsdf import FitConfig
from radarsdf.evaluation import KNNIntensity, holdout, intensity_metrics, surface_metrics
from radarsdf.io.npz import read_scans
from radarsdf.map.marching_cubes import marching_cubes
from radarsdf.returns.rays import prepare
from radarsdf.simulate import SCENES, RadarSensor, simulate

from bench.stress import samples

EXAMPLES = int(os.environ.get("RADARSDF_EXAMPLES", "0"))


def examples(count):
    return settings(
        max_examples=EXAMPLES or count,
        derandomize=not EXAMPLES,
        deadline=None,
        database=None,
        suppress_health_check=list(HealthCheck),
    )


DTYPES = st.one_of(
    st.sampled_from([np.float32, np.float64]),
    st.sampled_from(
        [np.float16, np.int8, np.uint64, np.bool_, np.complex64, np.dtype(">f8"), np.dtype("S3"), np.dtype("U2"),
         np.dtype("M8[s]"), np.longdouble, np.dtype("f4,i2"), np.dtype(object)]
    ),
)  # fmt: skip
FLOATS = st.one_of(
    st.floats(-100, 100),
    st.sampled_from([0.0, -0.0, np.nan, np.inf, -np.inf, 1e-320, 1e30, 1e300, -1e308, 1e12]),
)
NUMBERS = st.one_of(st.integers(-3, 12), FLOATS, st.sampled_from([2**31, 2**63, 2**64, -(2**63), 10**400]))
THINGS = st.one_of(
    NUMBERS, st.sampled_from([None, "", "1.5", b"x", {}, [], (), True, 1j, [[1], [2, 3]], object()])
)


def mostly(usual, odd):
    return st.integers(0, 7).flatmap(lambda i: odd if i == 7 else usual)


@st.composite
def arrays(draw, *shape):
    """An array of the shape, of any layout; or of another shape, or no array at all."""
    kind = draw(st.integers(0, 29))
    if kind == 0:
        return draw(THINGS)
    if kind == 1:
        shape = draw(hnp.array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=4))
    dtype = draw(DTYPES) if kind in (2, 3) else draw(st.sampled_from([np.float32, np.float64]))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    values = rng.uniform(-9, 9, shape)
    for _ in range(draw(st.sampled_from([0, 0, 0, 0, 1, 2]))):
        if values.size:
            values.flat[rng.integers(values.size)] = draw(FLOATS)
    if np.dtype(dtype) == object:
        array = values.astype(object)
        if array.size:
            array.flat[0] = draw(st.sampled_from([10**400, None, "x", {}, 1.5]))
    else:
        with np.errstate(all="ignore"):
            array = values.astype(dtype) if np.dtype(dtype).kind not in "MV" else np.zeros(shape, dtype)
    layout = draw(st.integers(0, 4))
    if layout == 1:
        array = np.asfortranarray(array)
    elif layout == 2 and array.ndim:
        array = np.repeat(array, 2, axis=-1)[..., ::2]
    elif layout == 3:
        array = array[::-1] if array.ndim else array
    elif layout == 4:
        array.flags.writeable = False
    return array.tolist() if draw(st.integers(0, 19)) == 0 and array.dtype.kind in "fiu" else array


def answer(function, *args, **kwargs):
    """What the function returns, or None if it refuses in one of the two ways. Warnings are errors here."""
    try:
        return function(*args, **kwargs)
    except (ValueError, TypeError):
        return None


def pose(x):
    T_world_sensor = np.eye(4)
    T_world_sensor[0, 3] = x
    return T_world_sensor


@examples(120)
@given(
    sizes=st.lists(st.sampled_from([1, 2, 3, 4, 0]), min_size=1, max_size=3),
    ranges=st.tuples(NUMBERS, st.none() | NUMBERS),
    frames=THINGS,
    origin=st.none() | arrays(3),
    odd=st.sampled_from([0, 0, 0, 0, 1, 2, 4, 8, 15]),
    data=st.data(),
)
def test_prepare(sizes, ranges, frames, origin, odd, data):
    points = [data.draw(arrays(size, 3)) for size in sizes]
    intensities = data.draw(st.sampled_from([None, [data.draw(arrays(size)) for size in sizes]]))
    poses = [pose(i) for i in range(len(sizes))]
    if odd & 8:
        points, poses = data.draw(st.just(points) | THINGS), data.draw(arrays(len(sizes), 4, 4))
    keywords = {"min_range_m": ranges[0], "max_range_m": ranges[1]} if odd & 1 else {}
    keywords |= {"accumulate_scans": frames} if odd & 2 else {}
    keywords |= {"origin": origin} if odd & 4 else {}
    rays = answer(prepare, points, poses, intensities, **keywords)
    if rays is None:
        return
    count = len(rays)
    assert 0 < count <= sum(map(len, points))
    assert rays.points.shape == rays.directions.shape == (count, 3)
    assert rays.ranges_m.shape == (count,)
    assert rays.origin.shape == (3,)
    for values in (rays.points, rays.directions, rays.ranges_m):
        assert values.dtype == np.float32
        assert np.isfinite(values).all()
    assert (rays.ranges_m > 0).all()
    if rays.intensities is not None:
        assert not np.isinf(rays.intensities).any()  # NaN: not measured
        assert rays.intensities.min() < rays.intensities.max()


GROUPS = {
    field.name: [own.name for own in dataclasses.fields(group)]
    for field in dataclasses.fields(FitConfig)
    if dataclasses.is_dataclass(group := getattr(FitConfig(), field.name))
}


@examples(300)
@given(
    st.sampled_from(
        [(field.name, None) for field in dataclasses.fields(FitConfig)]
        + [(group, name) for group, names in GROUPS.items() for name in names]
    ),
    THINGS | st.lists(THINGS, max_size=3).map(tuple),
)
def test_config(names, value):
    group, name = names
    try:
        config = FitConfig(**{group: value if name is None else {name: value}})
    except ValueError:
        return
    assert FitConfig.from_dict(config.to_dict()) == config
    if isinstance(value, float):
        assert np.isfinite(value)


@examples(60)
@given(
    volume=hnp.array_shapes(min_dims=3, max_dims=3, min_side=0, max_side=5).flatmap(lambda s: arrays(*s)),
    level=st.floats(-9, 9) | NUMBERS | arrays(1),
    spacing=st.sampled_from([(1, 1, 1), (0.1, 2, 1e5), (1e300, 1, 1)]) | arrays(3),
    origin=st.just((0, 0, 0)) | arrays(3),
    mask=st.none() | arrays(3, 3, 3),
    num_threads=THINGS,
    odd=st.sampled_from([0, 0, 1, 1, 2, 3]),
)
def test_marching_cubes(volume, level, spacing, origin, mask, num_threads, odd):
    if mask is not None and odd & 2 == 0:
        mask = np.random.default_rng(0).random(np.shape(volume)) < 0.9
    keywords = {"spacing": spacing, "origin": origin} if odd & 1 else {"mask": mask}
    keywords |= {"num_threads": num_threads} if odd & 2 else {}
    mesh = answer(marching_cubes, volume, level, **keywords)
    if mesh is None:
        return
    vertices, faces = mesh
    assert vertices.dtype == np.float64
    assert faces.dtype == np.int32
    assert vertices.shape[1:] == faces.shape[1:] == (3,)
    assert np.isfinite(vertices).all()
    assert np.unique(faces).tolist() == list(range(len(vertices)))


@examples(60)
@given(
    vertices=arrays(4, 3),
    faces=mostly(
        st.just([[0, 1, 2], [0, 2, 3]]),
        st.sampled_from([[[0, 1, 9]], [[0, -1, 2]], [[0, 0, 0]], []]) | arrays(2, 3),
    ),
    truth=arrays(5, 3),
    keywords=st.fixed_dictionaries(
        {},
        optional={
            "box": mostly(st.just([[-8, -8, -8], [8, 8, 8]]), arrays(2, 3)),
            "threshold_m": mostly(st.floats(0, 9), THINGS),
            "outlier_m": mostly(st.floats(0, 9), THINGS),
            "truncation_m": mostly(st.floats(0, 9), THINGS),
            "seed": st.integers(-1, 30),
        },
    ),
    count=mostly(st.integers(1, 50), st.sampled_from([None, 2.5, "9", np.int32(7), True, 0, -1])),
)
def test_surface_metrics(vertices, faces, truth, keywords, count):
    mesh = SimpleNamespace(vertices=vertices, faces=faces)
    metrics = answer(surface_metrics, mesh, truth, samples=count, **keywords)
    if metrics is None:
        return
    for name in (
        "accuracy_ratio",
        "outlier_ratio",
        "completion_ratio",
        "f_score",
        "precision",
        "f_score_all",
    ):
        assert 0 <= metrics[name] <= 1
    # A mean of equal numbers may be rounded up.
    assert 0 <= metrics["completion_error_m"] <= metrics["truncation_m"] * (1 + 1e-12)
    assert 0 < metrics["num_mesh_samples"] <= count


@examples(100)
@given(arrays(4), arrays(4))
def test_intensity_metrics(predicted, measured):
    metrics = answer(intensity_metrics, predicted, measured)
    if metrics is not None:
        assert 0 <= metrics["mae"] < np.inf
        assert 0 <= metrics["medae"] < np.inf
        assert metrics["num_returns"] == len(predicted)


@examples(100)
@given(
    points=arrays(6, 3),
    sensors=arrays(3) | arrays(6, 3),
    intensities=arrays(6),
    queries=arrays(2, 3),
    keywords=st.fixed_dictionaries(
        {},
        optional={"k": THINGS, "candidates": THINGS},
    ),
)
def test_nearest_neighbours(points, sensors, intensities, queries, keywords):
    baseline = answer(KNNIntensity, points, sensors, intensities, **keywords)
    if baseline is None:
        return
    predicted = answer(baseline.predict, queries, np.array([50.0, 60, 70]))
    if predicted is None:
        return
    assert predicted.shape == (len(queries),)
    values = np.asarray(intensities, np.float64)
    tolerance = 1e-9 * np.abs(values).max()
    assert ((predicted >= values.min() - tolerance) & (predicted <= values.max() + tolerance)).all()


@examples(100)
@given(
    NUMBERS
    | arrays(5)
    | mostly(st.lists(st.integers(-5, 99), max_size=6), st.lists(st.integers(-5, 2**64), max_size=6)),
    mostly(st.integers(-1, 5), THINGS),
)
def test_holdout(frames, every):
    split = answer(holdout, frames, every)
    if split is None:
        return
    train, test = split
    assert train.dtype == test.dtype == np.int64
    assert len(train) > 0
    assert len(test) > 0
    assert not np.isin(train, test).any()
    numbers = np.arange(frames) if isinstance(frames, int) else np.unique(frames)
    np.testing.assert_array_equal(np.sort(np.concatenate([train, test])), numbers)


@pytest.fixture(scope="module")
def tiny_map(tmp_path_factory):
    path = tmp_path_factory.mktemp("map") / "map.safetensors"
    path.write_bytes(samples.maps()[0])
    return radarsdf.load(path)


@examples(100)
@given(
    x=st.integers(0, 5).flatmap(lambda n: arrays(n, 3)),
    sensor=arrays(3) | arrays(5, 3),
    as_tensor=st.booleans(),
)
def test_queries_of_a_map(tiny_map, x, sensor, as_tensor):
    if (
        as_tensor
        and isinstance(x, np.ndarray)
        and x.dtype.kind in "fc"
        and x.dtype.isnative
        and x.itemsize <= 8
    ):
        x = torch.from_numpy(np.ascontiguousarray(x).copy())
    for query, shape in (("sdf", ()), ("gradient", (3,)), ("observed", ())):
        result = answer(getattr(tiny_map, query), x)
        if result is None:
            continue
        assert isinstance(result, torch.Tensor) == isinstance(x, torch.Tensor)
        assert tuple(result.shape) == (len(x), *shape)
        if query != "observed":
            known = np.asarray(tiny_map.observed(x))
            finite = np.isfinite(np.asarray(result)).reshape(len(x), math.prod(shape))
            assert (finite.all(axis=1) == known).all()
            assert (finite.any(axis=1) == known).all()
            result = getattr(tiny_map, query)(x, extrapolate=True)
            near = np.abs(np.asarray(x, np.float64)) < 1e6
            assert np.isfinite(np.asarray(result)[near.all(axis=1)]).all()
    result = answer(tiny_map.intensity, x, sensor)
    if result is not None:
        assert tuple(result.shape) == (len(x),)


@examples(40)
@given(
    voxel_size=st.sampled_from(
        [0.07, 0.1, 1.0, 1e300, np.inf, np.nan, 0, -1, 1e-9, 1e-320, 10**400, None, "1", [1], 1j]
    ),
    box=st.none() | arrays(2, 3),
    viewpoint=st.none() | arrays(3),
)
def test_meshes_of_a_map(tiny_map, voxel_size, box, viewpoint):
    mesh = answer(tiny_map.mesh, voxel_size, box=box, viewpoint=viewpoint, progress=False)
    if mesh is not None:
        assert np.isfinite(mesh.vertices).all()


@examples(40)
@given(
    field=st.sampled_from(dataclasses.fields(RadarSensor)),
    value=THINGS,
    poses=arrays(1, 4, 4),
    odd=st.booleans(),
)
def test_simulation(field, value, poses, odd):
    sensor = answer(RadarSensor, **({"beams": 20} | {field.name: value}))
    if sensor is None or sensor.clutter_per_scan > 1e4:
        return
    wall = made_wall()
    poses = poses if odd else wall.poses
    simulation = answer(simulate, wall.scene, sensor, poses, name="odd", lidar_rays=5)
    if simulation is not None:
        assert len(simulation) == len(poses)
        for points, values in zip(simulation.points, simulation.intensities, strict=True):
            assert points.shape == (*values.shape, 3)
            assert np.isfinite(points).all()
            assert np.isfinite(values).all()


WALL = []


def made_wall():
    if not WALL:
        WALL.append(SCENES["wall"](frames=2))
    return WALL[0]


@examples(60)
@given(
    st.one_of(
        THINGS, st.text(max_size=5), st.sampled_from(["", ".", "/", "\0", "a" * 5000, "x.npz", b"x.npz", 2.5])
    )
)
def test_paths(path):
    for read in (radarsdf.load, read_scans):
        if isinstance(path, int):  # a file descriptor, which may be open
            continue
        with pytest.raises((ValueError, TypeError, OSError)):
            read(path)
