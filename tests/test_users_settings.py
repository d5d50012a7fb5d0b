# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What users set in PyTorch and NumPy for themselves changes no bit of ours. Streams and disks are in test_streams.py and cli."""

from __future__ import annotations

import contextlib
import dataclasses
import pickle

import numpy as np
import pytest
import radarsdf
import torch
import trimesh
from radarsdf import FitConfig, evaluation
from radarsdf.io.npz import read_scans, write_scans
from radarsdf.io.scans import Scans
from radarsdf.render.picture import save_picture

from .conftest import ground_and_wall


@contextlib.contextmanager
def float64():
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    try:
        yield
    finally:
        torch.set_default_dtype(before)


@contextlib.contextmanager
def default_device():
    torch.set_default_device("meta")
    try:
        yield
    finally:
        torch.set_default_device(None)


@contextlib.contextmanager
def deterministic():
    torch.use_deterministic_algorithms(True)
    try:
        yield
    finally:
        torch.use_deterministic_algorithms(False)


SETTINGS = {
    "float64": float64,
    "default device": default_device,
    "device context": lambda: torch.device("meta"),
    "inference mode": torch.inference_mode,
    "no gradients": torch.no_grad,
    "deterministic": deterministic,
    "errors of NumPy": lambda: np.errstate(all="raise"),
}
TRAINING = {"sdf_iterations": 4, "intensity_iterations": 8, "batch_size": 256, "intensity_batch_size": 128}
CONFIGS = {
    "core": {},
    "normals": {"networks": {"normals": True}},
    "all rows of an octree": {"training": {"row_updates": False}, "encoding": {"kind": "octree"}},
}


def answers(scene, path, changes):
    """All that a map says, as bytes."""
    found = {}
    config = FitConfig(num_threads=2, training=TRAINING).override(**changes)
    for name, intensities in {"geometry": None, "both": scene.intensities}.items():
        fitted = radarsdf.fit(scene.points, scene.poses, intensities, config=config, progress=False)
        fitted.save(path)
        for radar_map in (fitted, radarsdf.load(path)):
            x = scene.points[0][:50].astype(np.float64) @ scene.poses[0, :3, :3].T + scene.poses[0, :3, 3]
            given = [radar_map.sdf(x), radar_map.gradient(x), radar_map.observed(x)]
            given += [radar_map.confidence(x), radar_map.uncertainty(x)]
            given += [
                radar_map.sdf(torch.from_numpy(x)).numpy(),
                radar_map.gradient(torch.from_numpy(x)).numpy(),
            ]
            if intensities is not None:
                given.append(radar_map.intensity(x, scene.poses[0, :3, 3]))
            mesh = radar_map.mesh(0.2, min_component_triangles=0, progress=False)
            given += [np.asarray(mesh.vertices), np.asarray(mesh.faces)]
            numbers = [p.detach().numpy() for p in radar_map.field.parameters()]
            found.setdefault(name, []).append([a.tobytes() for a in (*given, *numbers)])
    return found


@pytest.fixture(scope="module")
def few():
    """Few returns: what is fitted many times here need not be good."""
    return ground_and_wall(scans=4, returns_per_scan=300)


@pytest.fixture(scope="module")
def usual(few, tmp_path_factory):
    path = tmp_path_factory.mktemp("maps") / "map.safetensors"
    return {name: answers(few, path, changes) for name, changes in CONFIGS.items()}


@pytest.mark.parametrize("config", CONFIGS)
@pytest.mark.parametrize("setting", SETTINGS)
def test_the_same_bits(few, tmp_path, usual, setting, config):
    with SETTINGS[setting]():
        found = answers(few, tmp_path / "map.safetensors", CONFIGS[config])
    assert found == usual[config]


GRID = np.stack(np.meshgrid(*[np.linspace(-1, 1, 12)] * 3, indexing="ij"))
VOLUME = np.linalg.norm(GRID, axis=0) - 0.63
BOX = trimesh.creation.box((2.0, 2.0, 1.0))
POINTS = np.random.default_rng(0).uniform(-1, 1, (400, 3))
VALUES = np.random.default_rng(1).normal(60, 5, 400)
SENSOR = np.array([0.0, 0.0, 9.0])


def arrays_of(simulation):
    return [*simulation.points, simulation.poses, *simulation.intensities, simulation.ground_truth]


def estimated(scene, config):
    found = radarsdf.estimate(scene.points, scene.poses, scene.intensities, config=config)
    return [np.array([found.peak_memory_bytes, found.leaf_cells, found.vertices, *found.iterations.values()])]


def round_trip(scene, path):
    write_scans(path, Scans(scene.points, scene.poses, scene.intensities, POINTS))
    scans = read_scans(path)
    return [*scans.points, scans.poses, *scans.intensities, scans.ground_truth]


def written(function, path, *arguments):
    function(path, *arguments)
    return [np.frombuffer(path.read_bytes(), np.uint8)]


def small_picture(path, mesh):
    save_picture(path, mesh, width=120, height=80)


def neighbours(make, *more):
    knn = make(POINTS, SENSOR, VALUES, *more)
    return [np.array([knn.k, knn.candidates]), knn.predict(POINTS + 0.1, SENSOR)]


def queries(radar_map, x):
    sensor = np.array([0.0, 0.0, 1.5])
    mesh = radar_map.mesh(0.3, viewpoint=sensor, min_component_triangles=0, progress=False)
    found = [radar_map.sdf(x), radar_map.gradient(x), radar_map.observed(x), radar_map.confidence(x)]
    found += [radar_map.uncertainty(x), radar_map.intensity(x, sensor), mesh.vertices, mesh.faces]
    return [*found, *dataclasses.astuple(radar_map.evidence), *mesh.vertex_attributes.values()]


FUNCTIONS = {
    "estimate": lambda scene, _, __: estimated(scene, FitConfig(num_threads=2)),
    "estimate, normals": lambda scene, _, __: estimated(
        scene, FitConfig(num_threads=2, networks={"normals": True})
    ),
    "estimate, quick": lambda scene, _, __: estimated(scene, FitConfig.quick(num_threads=2)),
    "queries": lambda scene, fitted, _: queries(fitted, np.asarray(scene.points[0][:50])),
    "queries of no points": lambda _, fitted, __: queries(fitted, np.zeros((0, 3))),
    "pickle": lambda scene, fitted, _: queries(pickle.loads(pickle.dumps(fitted)), scene.points[0][:50]),
    "load": lambda scene, fitted, path: (
        fitted.save(path),
        queries(radarsdf.load(path), scene.points[0][:50]),
    )[1],
    "marching_cubes": lambda *_: radarsdf.marching_cubes(VOLUME, 0.1, mask=VOLUME < 0.5),
    "marching_cubes, float32": lambda *_: radarsdf.marching_cubes(
        VOLUME.astype(np.float32), spacing=[2, 1, 1]
    ),
    "marching_cubes, a list": lambda *_: radarsdf.marching_cubes(VOLUME.tolist()),
    "marching_cubes, a tensor": lambda *_: [
        t.numpy() for t in radarsdf.marching_cubes(torch.from_numpy(VOLUME))
    ],
    "hugin": lambda *_: arrays_of(radarsdf.simulate.hugin(frames=2)),
    "oculii": lambda *_: arrays_of(radarsdf.simulate.oculii(frames=2)),
    "wall": lambda *_: arrays_of(radarsdf.simulate.wall(frames=2)),
    "surface_metrics": lambda *_: [
        np.array(str(evaluation.surface_metrics(BOX, POINTS, samples=5000, num_threads=2)))
    ],
    "intensity_metrics": lambda *_: [np.array(str(evaluation.intensity_metrics(VALUES, VALUES[::-1])))],
    "uncertainty_metrics": lambda *_: [
        np.array(str(evaluation.uncertainty_metrics(VALUES - VALUES.mean(), np.abs(VALUES) + 0.1)))
    ],
    "confidence_metrics": lambda *_: [
        np.array(str(evaluation.confidence_metrics(np.linspace(0, 1, len(VALUES)), VALUES > 60)))
    ],
    "adjacent_angles": lambda *_: [evaluation.adjacent_angles(BOX)],
    "gamma_from_moments": lambda *_: [np.array(evaluation.gamma_from_moments(np.abs(VALUES)))],
    "holdout": lambda *_: evaluation.holdout(30),
    "KNNIntensity": lambda *_: neighbours(evaluation.KNNIntensity),
    "KNNIntensity.chosen": lambda *_: neighbours(evaluation.KNNIntensity.chosen, np.arange(400) // 40),
    "read_scans": lambda scene, _, path: round_trip(scene, path.with_suffix(".npz")),
    "write_mesh": lambda _, __, path: written(radarsdf.io.write_mesh, path.with_suffix(".ply"), BOX),
    "save_picture": lambda _, __, path: written(small_picture, path.with_suffix(".png"), BOX),
}


def bits(arrays):
    return [(np.asarray(array).dtype.str, np.shape(array), np.asarray(array).tobytes()) for array in arrays]


@pytest.fixture(scope="module")
def fitted(few):
    config = FitConfig(num_threads=2, training=TRAINING)
    return radarsdf.fit(few.points, few.poses, few.intensities, config=config, progress=False)


@pytest.fixture(scope="module")
def usual_bits(few, fitted, tmp_path_factory):
    path = tmp_path_factory.mktemp("usual") / "file.safetensors"
    return {name: bits(function(few, fitted, path)) for name, function in FUNCTIONS.items()}


@pytest.mark.parametrize("setting", SETTINGS)
@pytest.mark.parametrize("name", FUNCTIONS)
def test_every_function_has_the_same_bits(few, fitted, tmp_path, usual_bits, name, setting):
    with SETTINGS[setting]():
        found = bits(FUNCTIONS[name](few, fitted, tmp_path / "file.safetensors"))
    assert found == usual_bits[name]


@pytest.mark.parametrize(
    "setting", [name for name in SETTINGS if name not in ("no gradients", "inference mode")]
)
def test_gradients_of_marching_cubes(setting):
    def gradient():
        volume = torch.from_numpy(VOLUME).clone().requires_grad_()
        radarsdf.marching_cubes(volume)[0].norm(dim=1).sum().backward()
        return volume.grad.numpy().tobytes()

    usual = gradient()
    with SETTINGS[setting]():
        assert gradient() == usual


@contextlib.contextmanager
def threads(number):
    before = torch.get_num_threads()
    torch.set_num_threads(number)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@pytest.mark.parametrize("number", [1, 3, 16])
def test_any_number_of_threads_gives_the_same_answers(few, fitted, tmp_path, usual_bits, number):
    with threads(number):
        for name, function in FUNCTIONS.items():
            if not name.startswith("estimate"):  # which counts the threads
                assert bits(function(few, fitted, tmp_path / "file.safetensors")) == usual_bits[name], name
        assert torch.get_num_threads() == number


@pytest.mark.parametrize("number", [1, 16])
def test_any_number_of_threads_gives_a_fit_as_good(scene, number):
    training = {"sdf_iterations": 150, "intensity_iterations": 60, "learning_rate": 1e-2}
    config = FitConfig(training=training)
    with threads(number):
        radar_map = radarsdf.fit(scene.points, scene.poses, scene.intensities, config=config, progress=False)
    assert radar_map.report["iterations_done"] == radar_map.report["iterations"]
    ground = np.random.default_rng(0).uniform([10, -5, 0], [18, 5, 0], (300, 3))
    assert np.abs(radar_map.sdf(ground)).mean() < 0.05
    measured = 100 - 40 * np.log10(np.linalg.norm(ground - SENSOR / 6, axis=1))
    assert np.abs(radar_map.intensity(ground, SENSOR / 6) - measured).mean() < 2


@pytest.mark.parametrize("config", CONFIGS)
@pytest.mark.parametrize("size", [1, 2, 3])
def test_small_batches_give_a_finite_map(few, tmp_path, size, config):
    small = {"batch_size": size, "intensity_batch_size": size, "sdf_iterations": 3, "intensity_iterations": 6}
    given = FitConfig(num_threads=3).override(**CONFIGS[config]).override(training=small)
    radar_map = radarsdf.fit(few.points, few.poses, few.intensities, config=given, progress=False)
    assert radar_map.report["iterations_done"] == radar_map.report["iterations"]
    radar_map.save(tmp_path / "map.safetensors")  # which refuses what is not finite
    assert bits(queries(radarsdf.load(tmp_path / "map.safetensors"), POINTS[:size])) == bits(
        queries(radar_map, POINTS[:size])
    )


@pytest.mark.parametrize("given", [torch.zeros(2, 3, device="meta"), torch.zeros(2, 3).to_sparse()])
def test_tensors_that_are_not_here_are_refused(fitted, given):
    here = torch.zeros(2, 3)
    calls = [lambda f=f: f(given) for f in (fitted.sdf, fitted.gradient, fitted.observed, fitted.confidence)]
    calls += [lambda: fitted.intensity(given, here), lambda: fitted.intensity(here, given)]
    for call in calls:
        with pytest.raises(TypeError, match="dense tensor on the CPU"):
            call()
