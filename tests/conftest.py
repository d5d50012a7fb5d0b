"""Small analytic scenes shared by several tests."""

import logging
import os
import signal
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import radarsdf
from radarsdf import FitConfig, _core
from radarsdf.io import Scans

SEED = 7


@dataclass(frozen=True)
class Scene:
    points: list
    poses: np.ndarray
    intensities: list


def recorded_scans(name):
    """The file of a recorded drive; without it the test is skipped."""
    return recorded_file(f"astyx/{name}.npz")


def recorded_file(name):
    """A file of recorded data; without it the test is skipped, for its licence keeps it out of the repository.

    It is searched for in the folder RADARSDF_DATA, else in shared/data of a parent folder.
    """
    above = [folder / "shared" / "data" for folder in Path(__file__).resolve().parents]
    named = os.environ.get("RADARSDF_DATA")
    for folder in above if named is None else [Path(named)]:
        if (path := folder / name).exists():
            return path
    return pytest.skip(f"no {name} in RADARSDF_DATA or shared/data of a folder above")


def pose(position, yaw_rad=0.0):
    T_world_sensor = np.eye(4)
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    T_world_sensor[:2, :2] = [[c, -s], [s, c]]
    T_world_sensor[:3, 3] = position
    return T_world_sensor


def ground_and_wall(scans=6, returns_per_scan=1500, noise_m=0.02, offset=(0.0, 0.0, 0.0)):
    """A sensor 1.5 m above the plane z = 0 drives along x towards the wall x = 20.

    The intensity is that of the radar equation on a perfectly rough surface: 100 - 40 log10(range / 1 m).
    """
    rng = np.random.default_rng(SEED)
    points, poses, intensities = [], [], []
    for i in range(scans):
        T_world_sensor = pose(np.array([1.0 * i, 0.3 * np.sin(i), 1.5]), 0.05 * np.cos(i))
        half = returns_per_scan // 2
        ground = np.column_stack([rng.uniform(8, 20, half), rng.uniform(-6, 6, half), np.zeros(half)])
        wall = np.column_stack([np.full(half, 20.0), rng.uniform(-6, 6, half), rng.uniform(0, 4, half)])
        rays = np.concatenate([ground, wall]) - T_world_sensor[:3, 3]
        ranges = np.linalg.norm(rays, axis=1)
        measured = rays * (1 + rng.normal(0, noise_m, len(rays)) / ranges)[:, None]
        points.append((measured @ T_world_sensor[:3, :3]).astype(np.float32))
        T_world_sensor[:3, 3] += offset
        poses.append(T_world_sensor)
        intensities.append((100 - 40 * np.log10(ranges) + rng.normal(0, 0.5, len(ranges))).astype(np.float32))
    return Scene(points, np.stack(poses), intensities)


def with_truth(scene):
    """The scans of a `Scene`, with lidar points on its plane."""
    truth = np.stack(np.meshgrid(np.arange(9, 19, 0.5), np.arange(-5, 5, 0.5), [0.0]), -1).reshape(-1, 3)
    return Scans(scene.points, scene.poses, scene.intensities, truth)


def draw_small(patch):
    """Faster reports, with small pictures and few samples of the ground truth."""
    patch.setattr("radarsdf.report.writing._WIDTH", 160)
    patch.setattr("radarsdf.report.writing._HEIGHT", 100)
    patch.setattr("radarsdf.report.writing._SAMPLES", 20_000)


@pytest.fixture(scope="session", autouse=True)
def ctrl_c():
    """Restores the handler of Ctrl-C, which shells disable in background jobs and their child processes."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture(autouse=True)
def log_as_before():
    """Restores logging, since some benchmarks are programs that silence the notes of readers."""
    log = logging.getLogger("radarsdf.io")
    level = log.level
    yield
    log.setLevel(level)


@pytest.fixture(scope="session")
def scene():
    return ground_and_wall()


@pytest.fixture(scope="session")
def radar_map(scene):
    return radarsdf.fit(scene.points, scene.poses, scene.intensities, progress=False)


@pytest.fixture(scope="session")
def sharp_map(scene):
    """A map of a sharp plane and wall, fitted with its own settings: tests of a map's use must not depend on the
    default schedule."""
    training = {"sdf_iterations": 150, "intensity_iterations": 60, "batch_size": 4096}
    config = FitConfig(training=training | {"learning_rate": 1e-2, "sigma_cells": 0.75})
    # Ground and wall are faces of cells: what tests find is of the mesh, and not of the cells.
    data = (scene.points, scene.poses, scene.intensities)
    return radarsdf.fit(*data, config=config, origin=(0, 0, 0), progress=False)


@pytest.fixture(params=_core.available_instruction_sets())
def instruction_set(request):
    before = _core.instruction_set()
    _core.set_instruction_set(request.param)
    yield request.param
    _core.set_instruction_set(before)
