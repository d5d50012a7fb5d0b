"""Default and quick fits are not significantly worse than before, and degradations are detected."""

import functools
import math

import numpy as np
import pytest
import radarsdf
import trimesh
from radarsdf import FitConfig
from radarsdf.evaluation import KNNIntensity, holdout, intensity_metrics, surface_metrics
from radarsdf.io.npz import read_scans
from radarsdf.returns.rays import prepare
from scipy.spatial import cKDTree

from ..conftest import recorded_scans
from .floors import (
    KINDS,
    MEASURED,
    RECORDED,
    SIMULATED,
    VOXEL_M,
    Quality,
    config_of,
    failures,
    jittered,
    limits,
    load,
    measure,
    report,
    swapped,
    untrained,
    with_ghosts,
)

scene_of = functools.cache(load)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", [*SIMULATED, *RECORDED])
def test_a_fit_is_no_worse_than_its_floor(name, kind):
    scene = scene_of(name)
    limit = limits(*MEASURED[name, kind])
    quality = measure(scene, config_of(kind, scene), VOXEL_M[kind])
    report(name, kind, quality, limit)
    assert failures(quality, limit) == []


@pytest.mark.parametrize(
    ("spoilt", "kind", "what_fails"),
    [
        (functools.partial(jittered, sigma_m=0.1), "default", ["f_score", "outliers"]),
        (with_ghosts, "default", ["f_score", "outliers"]),
        (untrained, "default", ["f_score", "outliers", "mae"]),
        (swapped, "quick", ["mae"]),
    ],
    ids=["jitter of 10 cm", "ghosts", "untrained", "swapped"],
)
def test_deliberately_bad_fits_fail(spoilt, kind, what_fails):
    quality = spoilt(kind, scene_of("oculii"))
    assert failures(quality, limits(*MEASURED["oculii", kind])) == what_fails


@pytest.mark.parametrize(
    ("quality", "names"),
    [
        (Quality(88.1, 6.9, 4.7), []),
        (Quality(87.9, 6.9, 4.7), ["f_score"]),
        (Quality(88.1, 7.1, 4.7), ["outliers"]),
        (Quality(88.1, 6.9, 4.9), ["mae"]),
        (Quality(math.nan, math.nan, math.nan), ["f_score", "outliers", "mae"]),
    ],
)
def test_each_metric_can_fail_alone(quality, names):
    assert failures(quality, limits((91.0, 4.0, 4.2), (1.0, 1.0, 0.2))) == names


SCENES = ["r0009_0024"]  # others are in test_floors.py


def rays_of(scans):
    """World points, sensor positions and intensities of the returns between 2.5 and 60 m."""
    rays = prepare(scans.points, scans.poses, scans.intensities, min_range_m=2.5, max_range_m=60.0)
    return *rays.in_world(), rays.intensities


@pytest.fixture(scope="module", params=SCENES)
def job(request):
    scans = read_scans(recorded_scans(request.param))
    train, test = (scans.select(frames) for frames in holdout(len(scans.points), 5))
    config = FitConfig().override(returns={"max_range_m": 60.0})
    radar_map = radarsdf.fit(train.points, train.poses, train.intensities, config=config, progress=False)
    return radar_map, train, test


def test_held_out_intensities_are_more_accurate_than_nearest_neighbours(job):
    radar_map, train, test = job
    x, sensors, measured = rays_of(test)
    ours = intensity_metrics(radar_map.intensity(x, sensors, extrapolate=True), measured)
    known = prepare(train.points, train.poses, train.intensities, min_range_m=2.5, max_range_m=60.0)
    knn = KNNIntensity.chosen(*rays_of(train), known.scans)
    neighbours = intensity_metrics(knn.predict(x, sensors), measured)
    assert ours["mae"] < neighbours["mae"]


def test_the_mesh_covers_radar_and_lidar_returns(job, tmp_path):
    radar_map, train, test = job
    viewpoint = train.poses[len(train.poses) // 2, :3, 3]
    extracted = radar_map.mesh(viewpoint=viewpoint, progress=False)
    assert len(extracted.faces) > 1000
    extracted.export(tmp_path / "mesh.ply")
    mesh = trimesh.load_mesh(tmp_path / "mesh.ply", process=False)
    assert len(mesh.faces) == len(extracted.faces)
    assert len(np.unique(mesh.visual.vertex_colors, axis=0)) > 10
    # Lidar sees all directions; a radar map can only cover points within 1 m of a static return.
    returns = np.concatenate([rays_of(scans)[0] for scans in (train, test)])
    lidar = train.ground_truth
    seen = lidar[cKDTree(returns).query(lidar, distance_upper_bound=1.0)[0] <= 1.0]
    in_place = surface_metrics(mesh, seen, samples=100_000)["completion_ratio"]
    # The same mesh shifted by a metre gives the coverage by chance.
    for aside in ([1.0, 0, 0], [0, 1.0, 0]):
        moved = mesh.copy()
        moved.vertices = moved.vertices + aside
        assert in_place > 1.5 * surface_metrics(moved, seen, samples=100_000)["completion_ratio"]
