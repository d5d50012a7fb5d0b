# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Views of a map of a plane and a wall: returns and beams lie on them, within the sensor's limits."""

from __future__ import annotations

import dataclasses
import pickle

import numpy as np
import pytest
import radarsdf

from .test_mesh import surface_distance

POSE = np.eye(4)
POSE[:3, 3] = 1.3, 0.4, 1.5


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
    # Nothing behind the wall, nor under the ground.
    assert places[:, 0].max() < 20.3
    assert places[:, 2].min() > -0.3


def test_a_given_sensor_decides(sharp_map):
    narrow = dataclasses.replace(
        sharp_map.sensor, azimuth_rad=(-0.1, 0.1), range_m=(1.0, 15.0), returns_per_scan=50
    )
    view = sharp_map.render(POSE, narrow)
    assert 0 < len(view) <= 50
    assert np.abs(np.arctan2(view.points[:, 1], view.points[:, 0])).max() <= 0.1 + 1e-6
    assert view.ranges_m.max() <= 15.0 + 1e-3
    deaf = dataclasses.replace(sharp_map.sensor, thresholds=((1.0, 1e6),))
    assert len(sharp_map.render(POSE, deaf)) == (
        0 if sharp_map.has_intensity else len(sharp_map.render(POSE))
    )


def test_memory_that_is_not_there_is_said_before_the_work(sharp_map, monkeypatch):
    monkeypatch.setattr("radarsdf.memory.available_bytes", lambda: 100_000)
    with pytest.raises(MemoryError, match=r"would take about .* GB, of 0.00: ask for fewer"):
        sharp_map.render(POSE)
    unseen = pickle.loads(pickle.dumps(sharp_map))  # whose surface has yet to be made for rays
    with pytest.raises(MemoryError, match="would take about"):
        unseen.render(POSE)
    assert "_viewed" not in vars(unseen)


def test_noise_only_if_asked_and_from_its_own_generator(sharp_map, view):
    state = np.random.get_state()[1].copy()  # noqa: NPY002 - the generator that must stay as it is
    noisy = sharp_map.render(POSE, noise=True, seed=1)
    np.testing.assert_array_equal(np.random.get_state()[1], state)  # noqa: NPY002
    np.testing.assert_array_equal(sharp_map.render(POSE).points, view.points)
    np.testing.assert_array_equal(sharp_map.render(POSE, noise=True, seed=1).points, noisy.points)
    assert not np.array_equal(sharp_map.render(POSE, noise=True, seed=2).points, noisy.points)
    errors_m = noisy.ranges_m - view.ranges_m
    assert errors_m.std() == pytest.approx(sharp_map.sensor.noise.range_m, rel=0.3)


def test_pickled_and_saved_maps_see_the_same(sharp_map, view, tmp_path):
    path = tmp_path / "map.safetensors"
    sharp_map.save(path)
    for other in (pickle.loads(pickle.dumps(sharp_map)), radarsdf.load(path)):
        assert other.sensor == sharp_map.sensor
        np.testing.assert_array_equal(other.render(POSE).points, view.points)


@pytest.mark.parametrize(
    ("pose", "options", "said"),
    [
        (np.eye(3), {}, "shape"),
        (np.zeros((4, 4)), {}, "rigid"),
        (POSE, {"returns": -1}, "returns"),
        (POSE, {"returns": np.nan}, "returns"),
    ],
)
def test_wrong_arguments(sharp_map, pose, options, said):
    with pytest.raises(ValueError, match=said):
        sharp_map.render(pose, **options)
