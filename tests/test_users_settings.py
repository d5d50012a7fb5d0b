"""Users' settings of PyTorch and NumPy do not change results."""

import contextlib

import numpy as np
import pytest
import radarsdf
import torch
from radarsdf import FitConfig

from .conftest import ground_and_wall


@contextlib.contextmanager
def changed(set_value, value, usual):
    set_value(value)
    try:
        yield
    finally:
        set_value(usual)


SETTINGS = {
    "float64": lambda: changed(torch.set_default_dtype, torch.float64, torch.float32),
    "default device": lambda: changed(torch.set_default_device, "meta", None),
    "deterministic": lambda: changed(torch.use_deterministic_algorithms, True, False),
    "device context": lambda: torch.device("meta"),
    "inference mode": torch.inference_mode,
    "no gradients": torch.no_grad,
    "errors of NumPy": lambda: np.errstate(all="raise"),
}
TRAINING = {"sdf_iterations": 4, "intensity_iterations": 8, "batch_size": 256, "intensity_batch_size": 128}
CONFIGS = {"core": {}, "normals": {"networks": {"normals": True}}}


def answers(scene, path, changes):
    """All query results of a map, as bytes."""
    found = {}
    config = FitConfig(num_threads=2, training=TRAINING).override(**changes)
    for name, intensities in {"geometry": None, "both": scene.intensities}.items():
        fitted = radarsdf.fit(scene.points, scene.poses, intensities, config=config, progress=False)
        fitted.save(path)
        for radar_map in (fitted, radarsdf.load(path)):
            x = scene.points[0][:50].astype(np.float64) @ scene.poses[0, :3, :3].T + scene.poses[0, :3, 3]
            names = "sdf", "gradient", "observed", "confidence", "uncertainty"
            queries = [getattr(radar_map, name) for name in names]
            given = [query(x) for query in queries]
            given += [query(torch.from_numpy(x)).numpy() for query in queries[:2]]
            if intensities is not None:
                given.append(radar_map.intensity(x, scene.poses[0, :3, 3]))
            mesh = radar_map.mesh(0.2, min_component_triangles=0, progress=False)
            given += [np.asarray(mesh.vertices), np.asarray(mesh.faces)]
            numbers = [p.detach().numpy() for p in radar_map.field.parameters()]
            found.setdefault(name, []).append([a.tobytes() for a in (*given, *numbers)])
    return found


@pytest.fixture(scope="module")
def few():
    """Few returns, since quality does not matter here."""
    return ground_and_wall(scans=4, returns_per_scan=300)


@pytest.fixture(scope="module")
def usual(few, tmp_path_factory):
    path = tmp_path_factory.mktemp("maps") / "map.safetensors"
    return {name: answers(few, path, changes) for name, changes in CONFIGS.items()}


@pytest.mark.parametrize(
    ("setting", "config"),
    [*((setting, "core") for setting in SETTINGS), ("float64", "normals"), ("inference mode", "normals")],
)
def test_settings_of_users_change_no_bit(few, tmp_path, usual, setting, config):
    with SETTINGS[setting]():
        found = answers(few, tmp_path / "map.safetensors", CONFIGS[config])
    assert found == usual[config]


@pytest.mark.parametrize("size", [1, 3])
def test_small_batches_give_a_finite_map(few, tmp_path, size):
    small = {"batch_size": size, "intensity_batch_size": size, "sdf_iterations": 3, "intensity_iterations": 6}
    config = FitConfig(num_threads=3, training=small)
    radar_map = radarsdf.fit(few.points, few.poses, few.intensities, config=config, progress=False)
    assert radar_map.report["iterations_done"] == radar_map.report["iterations"]
    radar_map.save(tmp_path / "map.safetensors")  # which rejects values that are not finite


def test_sparse_and_meta_tensors_are_rejected(radar_map):
    for absent in (torch.zeros(2, 3, device="meta"), torch.zeros(2, 3).to_sparse()):
        for query in (radar_map.sdf, radar_map.gradient, radar_map.observed, radar_map.confidence):
            with pytest.raises(TypeError, match="dense tensor on the CPU"):
                query(absent)
