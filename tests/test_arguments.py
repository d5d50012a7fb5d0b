"""Any arguments of public functions give a result with the documented properties, or a ValueError or TypeError.

The examples are the same in every run; RADARSDF_EXAMPLES=5000 tries more of them.
"""

import math
import os

import numpy as np
import pytest
import radarsdf
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from radarsdf import FitConfig, io, simulate
from radarsdf.evaluation import intensity_metrics
from radarsdf.map.marching_cubes import marching_cubes

from . import samples
from .conftest import pose

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
    """The result of the function, or None if it raises a documented error. Warnings are errors here."""
    try:
        return function(*args, **kwargs)
    except (ValueError, TypeError, radarsdf.Diverged):  # one iteration may end above the limit of a loss
        return None


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


TINY = FitConfig(
    num_threads=1,
    max_memory_bytes=10**9,
    returns={"min_range_m": 0.0},
    encoding={"fourier_count": 2},
    networks={"intensity_hidden": (4,)},
    training={"sdf_iterations": 1, "intensity_iterations": 1, "batch_size": 16, "intensity_batch_size": 16},
)


@examples(60)
@given(
    sizes=st.lists(st.integers(1, 4), min_size=1, max_size=3),
    poses=mostly(st.none(), arrays(2, 4, 4)),
    far=mostly(st.just(0.0), FLOATS),
    data=st.data(),
)
def test_fit_and_estimate(sizes, poses, far, data):
    points = [data.draw(arrays(size, 3)) for size in sizes]
    intensities = data.draw(st.sampled_from([None, [data.draw(arrays(size)) for size in sizes]]))
    if poses is None:
        poses = [pose([far * i, 0, 0]) for i in range(len(sizes))]
    radar_map = answer(radarsdf.fit, points, poses, intensities, config=TINY, progress=False)
    estimate = answer(radarsdf.estimate, points, poses, intensities, config=TINY)
    if radar_map is None:
        return
    assert estimate is not None
    assert radar_map.report["returns_used"] <= estimate.returns
    assert 0 < estimate.peak_memory_bytes <= 10**9
    assert 0 < estimate.seconds < 60
    centres = (radar_map.field.cells.table.leaf_cells() + 0.5) * TINY.leaf_size_m + radar_map.origin
    for values in (radar_map.sdf(centres), radar_map.gradient(centres), radar_map.confidence(centres)):
        assert np.isfinite(values).all()


NO_PATH = (None, b"a", 2.5)
NO_ARRAY = ("a", {}, [[1], [2, 3]], np.array([1, {}], object), 1j)
NO_ITERABLE = (np.nan, 3, np.array(1.0))
NO_NUMBER = ("a", [], np.zeros((2, 2)), np.array(["a"]), {}, np.nan)


@pytest.fixture(scope="module")
def wall():
    return simulate.wall(frames=2)


def refused(name, function, values, /, *given, **others):
    """Each of the `values` of the argument is rejected by an error that names it."""
    for value in values:
        with pytest.raises((TypeError, ValueError), match=name.removesuffix("s")):
            function(*given, **others | {name: value})


@pytest.mark.parametrize("function", [radarsdf.fit, radarsdf.estimate, radarsdf.check])
def test_scans(function, wall):
    given = {"points": wall.points, "poses": wall.poses, "intensities": wall.intensities}
    refused("points", function, (None, *NO_ITERABLE), **given)
    refused("intensities", function, NO_ITERABLE, **given)
    refused("poses", function, NO_ARRAY, **given)
    refused("config", function, ("a", {}, FitConfig), **given)


def test_fits(wall, tmp_path):
    given = {"points": wall.points, "poses": wall.poses, "intensities": wall.intensities}
    given["config"] = FitConfig.quick()
    refused("doppler_mps", radarsdf.fit, NO_ITERABLE, **given)
    refused("origin", radarsdf.fit, NO_ARRAY, **given)
    refused("intensity_range", radarsdf.fit, (*NO_ARRAY, 3, (1, 2, 3), (2, 1), (0, np.inf)), **given)
    refused("checkpoint", radarsdf.fit, NO_PATH[1:], **given)
    scans = io.Scans(wall.points, wall.poses)
    refused("out", radarsdf.fit_tiles, NO_PATH, scans)
    refused("config", radarsdf.fit_tiles, ("a",), scans, tmp_path / "city")
    refused("scans", radarsdf.fit_tiles, (None, 3), out=tmp_path / "city")


def test_maps(tiny_map):
    refused("path", radarsdf.load, NO_PATH)
    refused("path", tiny_map.save, NO_PATH)
    for name in ("min_confidence", "max_uncertainty", "voxel_size"):
        refused(name, tiny_map.mesh, NO_NUMBER)
    refused("box", tiny_map.mesh, NO_ARRAY)
    refused("viewpoint", tiny_map.mesh, NO_ARRAY)
    pose = np.eye(4)
    refused("sensor", tiny_map.render, ("a", 3), pose)
    refused("noise", tiny_map.render, (None, "yes", np.zeros(0)), pose)
    refused("seed", tiny_map.render, ("a", -1, 1.5, None), pose, noise=True)


def test_files(wall, tmp_path):
    for function in (io.read_scans, io.read_mesh, io.read_points, io.read):
        refused("path", function, NO_PATH)
    refused("path", io.write_scans, NO_PATH, scans=io.Scans(wall.points, wall.poses))
    refused("scans", io.write_scans, ("a", None), tmp_path / "a.npz")
    refused("points", io.Scans, NO_ITERABLE, poses=wall.poses)
    refused("intensities", io.Scans, NO_ITERABLE, points=wall.points, poses=wall.poses)


def test_arrays_of_other_types_or_with_masked_values():
    for wrong in ([1 + 2j, 2, 3], ["1", "2", "3"], np.array(["2026-01-01"] * 3, "datetime64[D]")):
        with pytest.raises(TypeError, match="real numbers"):
            intensity_metrics(np.array(wrong), [1.0, 2.0, 3.0])
        with pytest.raises(TypeError, match="scan 0 must be real numbers"):
            radarsdf.check([np.array([wrong])], np.eye(4)[None])
    with pytest.raises(ValueError, match="masked"):
        intensity_metrics(np.ma.array([1.0, 2.0, 3.0], mask=[False, True, False]), [1.0, 2.0, 3.0])


def test_generators_of_scans_are_counted(scene):
    config = FitConfig.quick(training={"intensity_iterations": 1})
    points, intensities = iter(scene.points), iter(scene.intensities)
    radar_map = radarsdf.fit(points, scene.poses, intensities, config=config, progress=False)
    assert radar_map.report["returns"] == sum(map(len, scene.points))
