"""A fit reconstructs surface and intensities of an analytic scene, rejects bad input, and is deterministic."""

import numpy as np
import pytest
import radarsdf
import torch
from radarsdf import FitConfig
from radarsdf.fitting.sampling import RaySampler
from radarsdf.returns.rays import prepare
from radarsdf.returns.sums import lattice_of

from ..conftest import ground_and_wall

QUICK = FitConfig(training={"sdf_iterations": 20, "intensity_iterations": 20, "batch_size": 1024})


def test_surface_and_free_space_match_the_scene(radar_map):
    rng = np.random.default_rng(0)
    ground = np.column_stack([rng.uniform(9, 18, 500), rng.uniform(-4, 4, 500), np.zeros(500)])
    assert abs(np.median(radar_map.sdf(ground))) < 0.02
    # Grazing incidence: distances along rays, and thus labels, are several times the height.
    for height_m in (-0.05, 0.05):
        assert (np.sign(radar_map.sdf(ground + [0, 0, height_m])) == np.sign(height_m)).mean() > 0.99
    wall = np.column_stack([np.full(500, 20.0), rng.uniform(-4, 4, 500), rng.uniform(0.5, 3, 500)])
    assert abs(np.nanmedian(radar_map.sdf(wall - [0.1, 0, 0])) - 0.1) < 0.03
    assert np.median(radar_map.sdf(wall - [1.0, 0, 0], extrapolate=True)) > 0.2
    assert np.nanmedian(radar_map.sdf(wall + [0.3, 0, 0])) < -0.2


def test_intensity_follows_the_radar_equation(radar_map):
    rng = np.random.default_rng(0)
    wall = np.column_stack([np.full(500, 20.0), rng.uniform(-4, 4, 500), rng.uniform(0.5, 3, 500)])
    for x in (0.5, 3.5):  # between the training positions
        sensor = np.array([x, 0.0, 1.5])
        expected = 100 - 40 * np.log10(np.linalg.norm(wall - sensor, axis=1))
        assert np.median(np.abs(radar_map.intensity(wall, sensor, extrapolate=True) - expected)) < 0.5


def test_fits_are_deterministic_by_seed(scene):
    maps = [radarsdf.fit(scene.points, scene.poses, scene.intensities, config=QUICK) for _ in range(2)]
    other = radarsdf.fit(scene.points, scene.poses, scene.intensities, config=QUICK.override(seed=1))
    for name, value in maps[0].field.state_dict().items():
        assert torch.equal(value, maps[1].field.state_dict()[name])
    assert not torch.equal(maps[0].field.cells.features, other.field.cells.features)


@pytest.mark.parametrize("config", [QUICK, FitConfig.quick()], ids=["trained", "averaged"])
def test_the_number_of_threads_changes_no_bit(scene, config):
    # Batches of more parts than threads, of as many, and of fewer.
    config = config.override(training={"batch_size": 2200, "intensity_batch_size": 1100})
    maps = [
        radarsdf.fit(scene.points, scene.poses, scene.intensities, config=config.override(num_threads=n))
        for n in (1, 3)
    ]
    for other in maps[1:]:
        for name, value in maps[0].field.state_dict().items():
            assert torch.equal(value, other.field.state_dict()[name]), name


def test_without_intensities_a_map_has_no_reflectance(scene):
    radar_map = radarsdf.fit(scene.points, scene.poses, config=QUICK)
    assert radar_map.field.intensity_network is None
    assert radar_map.report["iterations"]["intensity"] == 0
    assert any("intensity network" in words for words in radar_map.report["skipped"])
    assert set(radar_map.report["losses"]) == {"sdf"}
    with pytest.raises(ValueError, match="without intensities"):
        radar_map.intensity(np.zeros((1, 3)), np.zeros(3))


def test_utm_coordinates_change_nothing():
    offset = np.array([5e5, 5.4e6, 320.0])  # multiples of the block: the lattice is the world's
    config = QUICK.override(training={"optimiser": "adam"})  # SOAP's first steps amplify rounding errors
    near, far = (
        radarsdf.fit((s := ground_and_wall(offset=o)).points, s.poses, s.intensities, config=config)
        for o in (np.zeros(3), offset)
    )
    x = np.random.default_rng(0).uniform([8, -5, -0.2], [20, 5, 0.2], (500, 3))
    np.testing.assert_allclose(far.sdf(x + offset), near.sdf(x), atol=1e-3)
    sensor = np.array([0.5, 0, 1.5])
    np.testing.assert_allclose(
        far.intensity(x + offset, sensor + offset), near.intensity(x, sensor), atol=0.05
    )


class TestBadInput:
    """One clear ValueError each, before the work."""

    @staticmethod
    def scans():
        scene = ground_and_wall(scans=3, returns_per_scan=40)
        return [p.copy() for p in scene.points], scene.poses.copy(), [i.copy() for i in scene.intensities]

    def test_mismatched_lengths(self):
        points, poses, intensities = self.scans()
        with pytest.raises(ValueError, match=r"poses must have shape \(3, 4, 4\)"):
            radarsdf.fit(points, poses[:2], intensities)
        with pytest.raises(ValueError, match="intensities holds 2 scans"):
            radarsdf.fit(points, poses, intensities[:2])
        with pytest.raises(ValueError, match=r"intensities of scan 1 must have shape \(40,\)"):
            radarsdf.fit(points, poses, [intensities[0], intensities[1][:5], intensities[2]])
        with pytest.raises(ValueError, match=r"scan 0 must have shape \(N, 3\)"):
            radarsdf.fit([p[:, :2] for p in points], poses)

    def test_invalid_rows_are_excluded_and_counted(self, caplog):
        points, poses, intensities = self.scans()
        points[1][3:5, 0] = np.nan
        points[0] = np.concatenate([points[0], np.zeros((200, 3))])  # as drivers fill clouds of fixed size
        points[2] = np.concatenate([points[2], np.full((200, 3), -1.0)])
        intensities[0] = np.concatenate([intensities[0], np.zeros(200)])
        intensities[2] = np.concatenate([intensities[2], np.zeros(200)])
        intensities[2][7] = np.inf
        rays = prepare(points, poses, intensities)
        assert np.bincount(rays.scans).tolist() == [40, 38, 40]
        assert np.isnan(rays.intensities).sum() == 1
        assert "402 of 520 returns" in caplog.text

    @pytest.mark.parametrize("fault", ["scale", "shear", "mirror", "nan", "row", "zero"])
    def test_scans_with_poses_that_are_not_rigid_are_excluded(self, fault, caplog):
        points, poses, _ = self.scans()
        match fault:
            case "scale":
                poses[1, :3, :3] *= 1.01
            case "shear":
                poses[1, 0, 1] += 0.01
            case "mirror":
                poses[1, :3, 0] *= -1
            case "nan":
                poses[1, 0, 3] = np.nan
            case "row":
                poses[1, 3, 0] = 1
            case "zero":
                poses[1] = 0
        assert radarsdf.fit(points, poses).report["returns_used"] <= 80
        assert "1 scans whose pose is not a rigid transform (the first is scan 1)" in caplog.text
        assert set(prepare(points, poses).scans) == {0, 2}
        poses[2] = 0
        with pytest.raises(ValueError, match="pose 1 is not a rigid transform"):
            radarsdf.fit(points, poses)

    def test_empty_scans(self, caplog):
        points, poses, _ = self.scans()
        with pytest.raises(ValueError, match="no scans"):
            radarsdf.fit([], np.zeros((0, 4, 4)))
        assert set(prepare([*points[:2], np.zeros((0, 3))], poses).scans) == {0, 1}
        assert "1 scans without returns (the first is scan 2)" in caplog.text
        with pytest.raises(ValueError, match="none of 0 returns"):
            radarsdf.fit([p[:0] for p in points], poses)
        with pytest.raises(ValueError, match="none of 120 returns"):
            radarsdf.fit([p * 0.01 for p in points], poses)


def test_ghosts_open_no_cells_but_train_intensities(scene, monkeypatch):
    is_ghost = np.zeros(0, bool)

    def upper_wall(surfels, rays, *_):
        nonlocal is_ghost
        height = lattice_of(surfels.keys)[:, 2]
        high = height > height.min() + 2
        is_ghost = high[surfels.cells_at(rays.points)]
        return high

    monkeypatch.setattr("radarsdf.fitting.surface_returns.find_ghosts", upper_wall)
    drawn_from = []
    spread = RaySampler.spread
    monkeypatch.setattr(
        RaySampler, "spread", lambda self, *args: (drawn_from.append(len(self._rays)), spread(self, *args))[1]
    )
    returns = {"drop_ghosts": True, "onto_planes": False}
    config = QUICK.override(num_threads=1, returns=returns, training={"intensity_iterations": 25})
    with_ghosts = radarsdf.fit(scene.points, scene.poses, scene.intensities, config=config)
    assert 0.1 < is_ghost.mean() < 0.9
    assert with_ghosts.report["ghosts"] == is_ghost.sum()
    assert set(drawn_from) == {len(is_ghost)}
    real = np.split(~is_ghost, np.cumsum([len(p) for p in scene.points])[:-1])
    points = [p[k] for p, k in zip(scene.points, real, strict=True)]
    config = config.override(returns={"drop_ghosts": False})
    without = radarsdf.fit(points, scene.poses, config=config)
    assert with_ghosts.report["leaf_cells"] == without.report["leaf_cells"]
    assert with_ghosts.evidence.hits.tolist() == without.evidence.hits.tolist()
