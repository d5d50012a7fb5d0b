"""Default and quick fits are not significantly worse than before, and degradations are detected."""

import functools

import pytest
import radarsdf
from radarsdf import FitConfig
from radarsdf.evaluation import KNNIntensity, holdout, intensity_metrics
from radarsdf.io.npz import read_scans
from radarsdf.returns.rays import prepare

from ..conftest import recorded_scans
from .floors import (
    KINDS,
    MEASURED,
    RECORDED,
    SIMULATED,
    VOXEL_M,
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
