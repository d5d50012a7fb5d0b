"""Views of a map of a plane and a wall: returns and beams are on the surface, within the limits of the sensor."""

import dataclasses
import pickle

import numpy as np
import pytest
import radarsdf
from radarsdf.map import view as views
from radarsdf.map.view import ViewedMap, _beams, _patches, _spread
from radarsdf.returns.noise import SensorNoise
from radarsdf.returns.sensor import Sensor

from .test_mesh import surface_distance

POSE = np.eye(4)
POSE[:3, 3] = 1.3, 0.4, 1.5


def polar(points):
    """Ranges, azimuths and elevations (N, 3)."""
    x, y, z = points.astype(np.float64).T
    ranges_m = np.sqrt(x**2 + y**2 + z**2)
    return np.column_stack([ranges_m, np.arctan2(y, x), np.arcsin(z / ranges_m)])


SENSOR = Sensor((-1.0, 0.5), (-0.2, 0.3), (2.0, 50.0), 100, SensorNoise(0.1, 0.01, 0.02))


def test_beams_fill_the_field_of_view_and_overlap_by_half(monkeypatch):
    azimuth, elevation = _beams(SENSOR)
    for angles, (low, high), width in zip(
        (azimuth, elevation), (SENSOR.azimuth_rad, SENSOR.elevation_rad), SENSOR.beam_rad, strict=True
    ):
        step = np.diff(angles)
        np.testing.assert_allclose(step, step[0])
        assert 0.9 * width / 2 < step[0] <= width / 2
        np.testing.assert_allclose([angles[0] - low, high - angles[-1]], step[0] / 2)
    sharp = dataclasses.replace(SENSOR, noise=SensorNoise(0, 0, 0))
    assert [len(angles) for angles in _beams(sharp)] == [751, 251]  # at least 2 mrad
    monkeypatch.setattr(views, "_MAX_BEAMS", 20_000)
    assert [len(angles) for angles in _beams(sharp)] == [187, 62]


def test_returns_follow_their_expectation_with_at_most_one_each():
    rng = np.random.default_rng(0)
    expected = rng.uniform(0, 1, 20_000) * (np.arange(20_000) % 2)
    chosen = np.zeros(20_000)
    chosen[_spread(expected, 1000)] = 1
    assert chosen.sum() == 1000
    by_part = [part.sum() for part in np.array_split(chosen, 20)]
    share = [1000 * part.sum() / expected.sum() for part in np.array_split(expected, 20)]
    np.testing.assert_allclose(by_part, share, atol=1.001)
    assert len(_spread(expected, 10**6)) == 10_000  # all with an expectation above zero
    assert _spread(np.array([9.0, 1, 1, 1, 1, 9]), 4).tolist()[::3] == [0, 5]
    assert len(_spread(np.zeros(3), 2)) == 0


@pytest.mark.parametrize("roughness", [0.0, 1.0, 0.5])
def test_density_of_returns_on_surfaces(roughness):
    """Five equal patches repeated: usual, rarely hit, small, oblique, and hidden; distant ones share their beams."""
    kinds = np.tile(np.arange(5), 400)
    order = np.argsort(kinds, kind="stable")
    count, kinds = len(kinds), kinds[order]
    ranges_m = np.tile([10.0, 20.0], count // 2)
    azimuth = np.linspace(-0.9, 0.4, count)
    centres = ranges_m[:, None] * np.column_stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth])
    turn = np.where(kinds == 3, np.pi / 3, 0) + azimuth
    normals = -np.column_stack([np.cos(turn), np.sin(turn), 0 * turn])
    first_m = np.where(kinds == 4, 5.0, ranges_m - 0.4).astype(np.float32)
    seen = np.ones(count, bool)
    seen[::7] = False
    centres[::7] *= 6.0  # beyond the range of the sensor

    class Viewed(ViewedMap):
        def ranges(self, _, directions, max_range_m):
            rows = np.argmax(directions @ (centres / np.linalg.norm(centres, axis=1)[:, None]).T, axis=1)
            assert max_range_m == 50
            return first_m[rows]

    area_m2, rates = np.where(kinds == 2, 0.3, 1.0), np.where(kinds == 1, 0.25, 0.5)
    position = np.array([3.0, 4, 5])
    viewed = Viewed(None, centres + position, normals, area_m2, rates, np.zeros(3), roughness, None, None)
    found = {}

    def spread(expected, _):
        found["expected"] = expected
        return np.arange(len(expected))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(views, "_spread", spread)
        rows = _patches(viewed, np.eye(3), position, SENSOR, 10)
    np.testing.assert_array_equal(np.sort(rows), np.flatnonzero(seen))
    smooth, rough = np.array([[1, 1, 2, 0.01], [2.2, 0.3, 1, 0.65]])
    of_rate, of_cosine, of_range, hidden = (1 - roughness) * smooth + roughness * rough
    density = area_m2 * rates**of_rate / ranges_m**of_range
    density *= np.where(kinds == 3, 0.5, 1.0) ** of_cosine * np.where(kinds == 4, hidden, 1.0)
    np.testing.assert_allclose(found["expected"], density[rows], rtol=1e-6)


@pytest.fixture(scope="module")
def view(sharp_map):
    return sharp_map.render(POSE)


def test_returns_lie_on_the_surface(sharp_map, view):
    assert len(view) > 0.7 * sharp_map.sensor.returns_per_scan
    assert (surface_distance(view.world_points) < 0.15).mean() > 0.95
    assert view.points.dtype == np.float32
    sensor = sharp_map.sensor
    x, y, z = view.points.T
    for values, (low, high) in (
        (view.ranges_m, sensor.range_m),
        (np.arctan2(y, x), sensor.azimuth_rad),
        (np.arcsin(z / view.ranges_m), sensor.elevation_rad),
    ):
        assert values.min() >= low - 1e-3
        assert values.max() <= high + 1e-3


def test_beams_meet_the_first_surface(view):
    assert view.beam_ranges_m.shape == (len(view.elevation_rad), len(view.azimuth_rad))
    elevation, azimuth = np.meshgrid(view.elevation_rad, view.azimuth_rad, indexing="ij")
    met = np.isfinite(view.beam_ranges_m)
    directions = view.sensor.directions(azimuth[met], elevation[met])
    places = POSE[:3, 3] + directions * view.beam_ranges_m[met, None]
    assert met.mean() > 0.2
    assert (surface_distance(places) < 0.15).mean() > 0.95
    # Nothing behind the wall or below the ground.
    assert places[:, 0].max() < 20.3
    assert places[:, 2].min() > -0.3


def test_a_given_sensor_decides(sharp_map):
    limits = {"azimuth_rad": (-0.1, 0.1), "range_m": (1.0, 15.0), "returns_per_scan": 50}
    narrow = dataclasses.replace(sharp_map.sensor, **limits)
    view = sharp_map.render(POSE, narrow)
    assert 0 < len(view) <= 50
    assert np.abs(np.arctan2(view.points[:, 1], view.points[:, 0])).max() <= 0.1 + 1e-6
    assert view.ranges_m.max() <= 15.0 + 1e-3
    deaf = dataclasses.replace(sharp_map.sensor, thresholds=((1.0, 1e6),))
    heard = 0 if sharp_map.has_intensity else len(sharp_map.render(POSE))
    assert len(sharp_map.render(POSE, deaf)) == heard


def test_missing_memory_is_reported_before_the_work(sharp_map, monkeypatch):
    monkeypatch.setattr("radarsdf.memory.available_bytes", lambda: 100_000)
    with pytest.raises(MemoryError, match=r"would take about .* GB, of 0.00: use fewer"):
        sharp_map.render(POSE)
    unseen = pickle.loads(pickle.dumps(sharp_map))  # without a cached surface for rays
    with pytest.raises(MemoryError, match="would take about"):
        unseen.render(POSE)
    assert "_viewed" not in vars(unseen)


def test_noise_is_optional_and_has_its_own_generator(sharp_map, view):
    state = np.random.get_state()[1].copy()  # noqa: NPY002 - the generator that must stay as it is
    noisy = sharp_map.render(POSE, noise=True, seed=1)
    np.testing.assert_array_equal(np.random.get_state()[1], state)  # noqa: NPY002
    np.testing.assert_array_equal(sharp_map.render(POSE).points, view.points)
    np.testing.assert_array_equal(sharp_map.render(POSE, noise=True, seed=1).points, noisy.points)
    assert not np.array_equal(sharp_map.render(POSE, noise=True, seed=2).points, noisy.points)
    noise = sharp_map.sensor.noise
    of_noisy, of_view = polar(noisy.points), polar(view.points)
    for column, sigma in enumerate((noise.range_m, noise.azimuth_rad, noise.elevation_rad)):
        errors = (of_noisy - of_view)[:, column]
        assert errors.std() == pytest.approx(sigma, rel=0.1)
        assert abs(errors.mean()) < 0.2 * sigma


def test_pickled_and_saved_maps_have_the_same_views(sharp_map, view, tmp_path):
    path = tmp_path / "map.safetensors"
    sharp_map.save(path)
    for other in (pickle.loads(pickle.dumps(sharp_map)), radarsdf.load(path)):
        assert other.sensor == sharp_map.sensor
        np.testing.assert_array_equal(other.render(POSE).points, view.points)
