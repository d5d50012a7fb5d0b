"""Rigs: radars that differ in noise, field of view and unit of intensity make one map."""

import dataclasses

import numpy as np
import pytest
import radarsdf
from radarsdf import FitConfig
from radarsdf.map.radar_map import parts_of
from radarsdf.returns.noise import RigNoise, SensorNoise
from radarsdf.returns.planes import Surfels
from radarsdf.returns.rays import prepare
from radarsdf.returns.sensor import intensity_units
from radarsdf.returns.sums import WEIGHT_UNIT, ScanSums
from radarsdf.scans import Scans

from tests.conftest import ground_and_wall

QUICK = FitConfig.quick()
GAIN, OFFSET = 1.0, -6.0


def rig(noise_m=(0.02, 0.12), gain=GAIN, offset=OFFSET, away_m=0.0):
    """Two radars: `near` in the first half of the drive, and `far` in the second, with its own unit."""
    scenes = [ground_and_wall(6, 1500 - 100 * i, sigma) for i, sigma in enumerate(noise_m)]
    rows = [0, 1, 2, 3, 4, 5]
    of = [scenes[i // 3] for i in rows]
    poses = np.stack([scene.poses[i] for scene, i in zip(of, rows, strict=True)])
    poses[3:, 1, 3] += away_m
    intensities = [scene.intensities[i] for scene, i in zip(of, rows, strict=True)]
    intensities[3:] = [(gain * own + offset).astype(np.float32) for own in intensities[3:]]
    points = [scene.points[i] for scene, i in zip(of, rows, strict=True)]
    return Scans(points, poses, intensities, sensors=["near"] * 3 + ["far"] * 3)


def rays_of(scans):
    return prepare(scans.points, scans.sensor_poses, scans.intensities, rig=scans.rig)


@pytest.fixture(scope="module")
def rig_map():
    return radarsdf.fit(rig(), config=QUICK, progress=False)


def test_each_radar_has_its_own_noise(rig_map):
    near, far = (rig_map.sensors[label] for label in ("near", "far"))
    assert near.noise.range_m < 0.05
    assert 0.08 < far.noise.range_m < 0.2
    assert near.noise.range_m < rig_map.sensor.noise.range_m < far.noise.range_m
    assert rig_map.report["sensors"]["far"]["noise"] == dataclasses.asdict(far.noise)
    assert rig_map.report["noise"] == dataclasses.asdict(rig_map.sensor.noise)
    assert (near.returns_per_scan, far.returns_per_scan) == (1500, 1400)


def test_returns_are_weighted_by_the_noise_of_their_radar():
    rays = rays_of(rig())
    noise = RigNoise.of([SensorNoise(0.2, 0.0, 0.0), SensorNoise(0.1, 0.0, 0.0)], rays)  # of far and near
    far, near = noise.parts
    assert near == pytest.approx(4 * far, abs=3)
    weights = noise.weights(rays)
    assert weights.mean() == pytest.approx(WEIGHT_UNIT, rel=0.02)
    information = (1 / np.array([0.2, 0.1]) ** 2) @ [1400, 1500] / 2900
    assert noise.range_m == pytest.approx(information**-0.5)
    assert (noise.of_scans(rays)[[0, 5], 0] == np.square([0.1, 0.2])).all()


def test_radars_of_equal_noise_are_one_radar_to_the_bit():
    known = {"range_noise_m": 0.05, "azimuth_noise_rad": 0.01, "elevation_noise_rad": 0.01}
    scans, config = rig(), QUICK.override(returns=known)
    of_rig = radarsdf.fit(Scans(scans.points, scans.poses, sensors=scans.sensors), config=config)
    of_one = radarsdf.fit(scans.points, scans.poses, config=config)
    tensors, expected = (parts_of(m.contents_of_any)[0] for m in (of_rig, of_one))
    assert all((tensors[name] == expected[name]).all() for name in expected)


def test_weighted_sums_have_the_moments_of_repeated_returns():
    rays = rays_of(rig())
    again = rays.select(np.repeat(np.arange(len(rays)), np.where(rays.scans < 3, 2, 1)))
    weights = np.where(rays.scans < 3, 2, 1).astype(np.int32)
    sums, expected = ScanSums.of(rays, 0.2, weights=weights), ScanSums.of(again, 0.2)
    assert (sums.sums == expected.sums).all()
    assert (WEIGHT_UNIT * sums.counts == expected.counts).all()
    assert (WEIGHT_UNIT * sums.merged_moments()[1] == expected.merged_moments()[1]).all()


@pytest.mark.parametrize(("gain", "offset"), [(1.0, -6.0), (1.0, 4.0), (10.0, 30.0)])
def test_units_of_intensity_are_those_of_surfaces_that_both_radars_see(gain, offset):
    """The radars are at other ranges: without the response to it, the offset would be wrong by 3 dB."""
    rays = rays_of(rig((0.02, 0.02), gain, offset))
    far, near = intensity_units(Surfels.of(rays, 0.2), rays)
    # The first label is `far`, so the unit is that of `near` relative to it: (y - offset) / gain.
    assert far == (1.0, 0.0)
    assert near[0] == pytest.approx(1 / gain, rel=0.1)
    assert near[0] * (gain * 50 + offset) + near[1] == pytest.approx(50, abs=0.3 if gain == 1 else 1.0)


def test_radars_that_share_no_surface_keep_their_units():
    radar_map = radarsdf.fit(rig(away_m=50.0), config=QUICK, progress=False)
    assert radar_map.report["sensors"]["near"]["intensity_offset"] is None
    assert radar_map.sensors["near"].unit == (1.0, 0.0)


def test_a_map_answers_for_each_radar(rig_map, tmp_path):
    x, viewpoint = [[20.0, 0.0, 2.0]], [3.0, 0.0, 1.5]
    rig_map.save(tmp_path / "map")
    loaded = radarsdf.load(tmp_path / "map")
    assert loaded.sensors == rig_map.sensors
    near, far = (float(loaded.intensity(x, viewpoint, sensor=label)[0]) for label in ("near", "far"))
    assert far - near == pytest.approx(OFFSET, abs=0.3)
    assert float(loaded.intensity(x, viewpoint)[0]) == far
    pose = np.eye(4)
    pose[:3, 3] = viewpoint
    views = {label: loaded.render(pose, sensor=label) for label in ("near", "far")}
    medians = {label: float(np.nanmedian(view.intensities)) for label, view in views.items()}
    assert medians["far"] - medians["near"] == pytest.approx(OFFSET, abs=1.0)
    with pytest.raises(ValueError, match="rear"):
        loaded.render(pose, sensor="rear")


def test_files_of_one_radar_do_not_mention_units(radar_map):
    description = parts_of(radar_map.contents_of_any)[1]
    assert "sensors" not in description
    assert "unit" not in description["sensor"]
    assert radar_map.sensors == {}
    with pytest.raises(TypeError):
        radar_map.render(np.eye(4), sensor="front")


def test_scans_of_several_radars_are_not_accumulated():
    with pytest.raises(ValueError, match="accumulate_scans"):
        radarsdf.fit(rig(), config=QUICK.override(returns={"accumulate_scans": 2}))


def test_training_weighs_returns_of_each_radar():
    config = FitConfig(training={"sdf_iterations": 60, "intensity_iterations": 60})
    radar_map = radarsdf.fit(rig(), config=config, progress=False)
    assert set(radar_map.sensors) == {"near", "far"}
