# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Intensities that cannot belong to the others: left out of the reflectance, but not of the surface."""

import numpy as np
import pytest
import radarsdf
from radarsdf import FitConfig
from radarsdf.map.storage import parts_of
from radarsdf.tiles.plan import Plan

SHORT = {"sdf_iterations": 20, "intensity_iterations": 40, "intensity_batch_size": 256}
CONFIGS = {
    "quick": FitConfig.quick(num_threads=1),
    "default": FitConfig(num_threads=1, training={**SHORT, "batch_size": 512}),
}


@pytest.fixture(scope="module")
def scans():
    return radarsdf.simulate.wall(frames=4, seed=3)


def struck(scans, value):
    """The intensities, every hundredth of them replaced."""
    whole = np.concatenate(scans.intensities)
    whole[::100] = value
    return np.split(whole, np.cumsum([len(scan) for scan in scans.points])[:-1])


def tensors(radar_map):
    return parts_of(radar_map._contents)[0]


def errors(radar_map, scans):
    """(N,) of all intensities."""
    rays = radarsdf.returns.rays.prepare(scans.points, scans.poses, scans.intensities)
    return np.abs(radar_map.intensity(*rays.in_world(), extrapolate=True) - rays.intensities)


@pytest.mark.parametrize("config", CONFIGS.values(), ids=CONFIGS)
def test_their_values_do_not_matter(scans, config):
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
    # They are few: without them it is as good, also where they were.
    assert errors(low, scans).mean() < 1.02 * errors(good, scans).mean()
    assert errors(low, scans)[::100].mean() < 1.3 * errors(good, scans)[::100].mean()


def test_all_tiles_leave_out_the_same(scans, tmp_path):
    """The plan decides for all, also where a tile has no other intensities."""
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
    assert np.isfinite(city.intensity(far[:3, 3] + [[5, 0, 0]], far[:3, 3], extrapolate=True)).all()


@pytest.mark.parametrize("config", [CONFIGS["quick"], CONFIGS["default"]], ids=["quick", "default"])
def test_beyond_the_ranges_of_the_returns_an_intensity_is_that_at_their_end(scans, config):
    radar_map = radarsdf.fit(scans.points, scans.poses, scans.intensities, config=config, progress=False)
    points, sensors = radarsdf.returns.rays.prepare(scans.points, scans.poses).in_world()
    rays = points - sensors
    unit = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    nearest, farthest = radar_map.sensor.range_m
    for end, others in ((nearest, (0.1, 0.5)), (farthest, (2, 10, 1e4))):
        expected = radar_map.intensity(points, points - end * unit, extrapolate=True)
        for times in others:
            found = radar_map.intensity(points, points - times * end * unit, extrapolate=True)
            assert (
                np.mean(np.abs(found - expected) < 0.1) > 0.95
            )  # rounded directions are in other cells, a few
