"""Scenes far away, tiny, huge, flat, dense, empty or corrupted: a meaningful map, or a clear error."""

import dataclasses

import numpy as np
import pytest
import radarsdf
from radarsdf import FitConfig
from radarsdf.map.radar_map import parts_of
from radarsdf.returns.noise import SensorNoise
from radarsdf.returns.rays import prepare
from radarsdf.tiles.plan import Plan

from ..conftest import ground_and_wall as any_ground_and_wall

QUICK = FitConfig(
    num_threads=1,
    returns={"min_range_m": 0.0},
    training={
        "sdf_iterations": 60,
        "intensity_iterations": 80,
        "batch_size": 512,
        "intensity_batch_size": 512,
    },
)


def ground_and_wall(scans=3, returns_per_scan=800):
    return any_ground_and_wall(scans, returns_per_scan)


def finite(radar_map, sensor):
    """Queries at the map's own cells, and a mesh, all finite."""
    cells = radar_map.field.table.leaf_cells()[:2000]
    x = (cells + 0.5) * radar_map.config.leaf_size_m + radar_map.origin
    assert radar_map.observed(x).mean() > 0.99  # far out, float32 rounds some centres into the next cell
    assert np.isfinite(radar_map.sdf(x)).all()
    assert np.isfinite(radar_map.gradient(x)).all()
    assert np.isfinite(radar_map.confidence(x)).all()
    if radar_map.has_intensity:
        assert np.isfinite(radar_map.intensity(x, sensor)).all()
    voxel_size = radar_map.config.leaf_size_m / 2
    mesh = radar_map.mesh(voxel_size, min_confidence=0, min_component_triangles=0, progress=False)
    assert np.isfinite(mesh.vertices).all()
    return x, mesh


def moved(scene, T_new_world):
    return dataclasses.replace(scene, poses=T_new_world @ scene.poses)


def wall_error_m(radar_map, T_new_world, scale=1.0):
    """Median distance of the zero level set from the wall x = 20 m, in scene units, also between returns."""
    rng = np.random.default_rng(1)
    wall = np.column_stack([np.full(500, 20.0), rng.uniform(-4, 4, 500), rng.uniform(0.5, 3, 500)]) * scale
    world = wall @ T_new_world[:3, :3].T + T_new_world[:3, 3]
    return float(np.median(np.abs(radar_map.sdf(world, extrapolate=True)))) / scale


@pytest.mark.parametrize("origin", [(5e5, 5.4e6, 300), (1e7, -1e7, 1e7)])
def test_scenes_of_any_scale_and_position_are_fitted(origin):
    T = np.eye(4)
    T[:3, 3] = origin
    scene = moved(ground_and_wall(), T)
    radar_map = radarsdf.fit(scene.points, scene.poses, scene.intensities, config=QUICK, progress=False)
    _, mesh = finite(radar_map, scene.poses[0, :3, 3])
    assert wall_error_m(radar_map, T) < 0.1
    assert (radar_map.sdf(scene.poses[:, :3, 3], extrapolate=True) > 0).all()
    assert np.abs(mesh.vertices - scene.poses[0, :3, 3]).max() < 30


def test_very_many_returns_in_one_cell():
    points = np.random.default_rng(0).uniform([5.0, 0.01, 0.01], [5.15, 0.19, 0.19], (200_000, 3))
    points = points.astype(np.float32)
    config = QUICK.override(training={"sdf_iterations": 30})
    radar_map = radarsdf.fit(
        np.split(points, 100), np.tile(np.eye(4), (100, 1, 1)), config=config, origin=(0, 0, 0)
    )
    finite(radar_map, np.zeros(3))
    assert radar_map.report["leaf_cells"] < 60
    evidence = radar_map.evidence
    variance_m2 = SensorNoise(**radar_map.report["noise"]).variances_m2(np.float32([5.08])).item()
    assert evidence.information.max() == pytest.approx(len(points) / variance_m2, rel=0.01)
    assert evidence.hits.max() == evidence.visibility.max() == 100  # scans, and not returns
    assert radar_map.confidence(points[:10]).min() > 0.97


@pytest.mark.parametrize("distance_m", [1e5, 1e7, 1e11])
def test_a_distant_outlier_opens_no_cells_along_its_ray(distance_m):
    scene = ground_and_wall(scans=2, returns_per_scan=600)
    points = [scene.points[0], np.concatenate([scene.points[1], [[distance_m, 0.0, 0.0]]])]
    config = QUICK.override(training={"sdf_iterations": 10})
    with_it = radarsdf.fit(points, scene.poses, config=config, progress=False)
    without = radarsdf.fit(scene.points, scene.poses, config=config, progress=False)
    assert with_it.report["leaf_cells"] == without.report["leaf_cells"]
    assert with_it.report["returns_used"] == without.report["returns_used"]
    dropped = radarsdf.fit(
        points, scene.poses, config=config.override(returns={"max_range_m": 1000.0}), progress=False
    )
    assert dropped.report["returns"] - dropped.report["returns_used"] == 1


@pytest.mark.parametrize("name", ["huge", "tiny spread", "of both signs and huge", "nearly constant"])
def test_intensities_of_any_scale_are_fitted(name):
    scene = ground_and_wall(scans=2, returns_per_scan=600)
    values = {
        "huge": [v * np.float32(1e30) for v in scene.intensities],
        "tiny spread": [1e-30 * v for v in scene.intensities],
        "of both signs and huge": [np.linspace(-1e38, 1e38, len(v)) for v in scene.intensities],
        "nearly constant": [np.float32(7) + np.float32(1e-6) * (v > 50) for v in scene.intensities],
    }[name]
    radar_map = radarsdf.fit(scene.points, scene.poses, values, config=QUICK, progress=False)
    x, _ = finite(radar_map, scene.poses[0, :3, 3])
    found = radar_map.intensity(x, scene.poses[0, :3, 3])
    low, high = np.concatenate(values).min(), np.concatenate(values).max()
    spread = float(high) - float(low)
    assert (found >= low - spread).all()
    assert (found <= high + spread).all()
    kept = prepare(scene.points, scene.poses, values)
    predicted = radar_map.intensity(*kept.in_world(), extrapolate=True)
    assert np.isfinite(predicted).all()
    if name in ("huge", "tiny spread"):  # a change of units: equally well fitted
        errors = np.abs(predicted - kept.intensities) / spread
        assert np.median(errors) < 0.1


SHORT = {"sdf_iterations": 20, "intensity_iterations": 40, "intensity_batch_size": 256}
CONFIGS = {
    "quick": FitConfig.quick(num_threads=1),
    "default": FitConfig(num_threads=1, training={**SHORT, "batch_size": 512}),
}


@pytest.fixture(scope="module")
def scans():
    return radarsdf.simulate.wall(frames=4, seed=3)


def struck(scans, value):
    """Intensities with every hundredth replaced."""
    whole = np.concatenate(scans.intensities)
    whole[::100] = value
    return np.split(whole, np.cumsum([len(scan) for scan in scans.points])[:-1])


def tensors(radar_map):
    return parts_of(radar_map._contents)[0]


def errors(radar_map, scans):
    """Errors (N,) of all intensities."""
    rays = radarsdf.returns.rays.prepare(scans.points, scans.poses, scans.intensities)
    return np.abs(radar_map.intensity(*rays.in_world(), extrapolate=True) - rays.intensities)


@pytest.mark.parametrize("config", CONFIGS.values(), ids=CONFIGS)
def test_values_of_outliers_do_not_matter(scans, config):
    good, low, high = (
        radarsdf.fit(scans.points, scans.poses, values, config=config, progress=False)
        for values in (scans.intensities, struck(scans, -9999.0), struck(scans, 65535.0))
    )
    assert good.report["intensity_outliers"] == 0
    assert low.report["intensity_outliers"] == -(-sum(map(len, scans.points)) // 100)
    assert low.intensity_scale == good.intensity_scale
    weakest = [np.transpose(radar_map.sensor.thresholds)[1] for radar_map in (low, good)]
    np.testing.assert_allclose(*weakest, atol=2)
    assert low.sensor == high.sensor
    for name, tensor in tensors(low).items():
        assert tensor.equal(tensors(high)[name]), name
    # They are few: excluding them loses no accuracy, even at their positions.
    assert errors(low, scans).mean() < 1.02 * errors(good, scans).mean()
    assert errors(low, scans)[::100].mean() < 1.3 * errors(good, scans)[::100].mean()


def test_all_tiles_exclude_the_same_outliers(scans, tmp_path):
    """The plan decides for all tiles, even for tiles without other intensities."""
    whole = struck(scans, -9999.0)
    far = scans.poses[0].copy()
    far[0, 3] += 200
    points, poses = [*scans.points, scans.points[0][:50]], np.concatenate([scans.poses, far[None]])
    city = radarsdf.fit_tiles(
        radarsdf.io.Scans(points, poses, [*whole, np.full(50, -9999.0)]),
        tmp_path / "city",
        tile_size=25.6,
        halo=6.4,
        config=CONFIGS["quick"],
        progress=False,
    )
    assert city.missing == {}
    plan = Plan.load(tmp_path / "city")
    assert plan.intensity_range == (
        min(v.min() for v in scans.intensities),
        max(v.max() for v in scans.intensities),
    )
    alone = radarsdf.fit(scans.points, scans.poses, whole, config=CONFIGS["quick"], progress=False)
    assert errors(city, scans).mean() < 1.1 * errors(alone, scans).mean()
    # Without any of its own, a tile answers with the middle of the range.
    found = city.intensity(far[:3, 3] + [[5, 0, 0]], far[:3, 3], extrapolate=True)
    assert found == pytest.approx(np.mean(plan.intensity_range), abs=0.1 * np.ptp(plan.intensity_range))


@pytest.mark.parametrize("config", [CONFIGS["quick"], CONFIGS["default"]], ids=["quick", "default"])
def test_intensities_beyond_the_ranges_of_returns_are_clamped(scans, config):
    radar_map = radarsdf.fit(scans.points, scans.poses, scans.intensities, config=config, progress=False)
    points, sensors = radarsdf.returns.rays.prepare(scans.points, scans.poses).in_world()
    rays = points - sensors
    unit = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    nearest, farthest = radar_map.sensor.range_m
    for end, others in ((nearest, (0.1, 0.5)), (farthest, (2, 10, 1e4))):
        expected = radar_map.intensity(points, points - end * unit, extrapolate=True)
        for times in others:
            found = radar_map.intensity(points, points - times * end * unit, extrapolate=True)
            alike = np.abs(found - expected) < 0.1  # a few rounded directions are in other cells
            assert alike.mean() > 0.95
