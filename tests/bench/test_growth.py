# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The street of the growth benches, and their check of the map."""

import numpy as np
import pytest
from radarsdf import FitConfig, RadarMap, fit

from bench.growth.fits import map_errors
from bench.growth.street import street


@pytest.mark.parametrize(
    ("count", "size_m", "frames"), [(1000, 50.0, 5), (20_001, 50.0, 5), (1000, 500.0, 50)]
)
def test_a_street_has_its_returns_and_its_length(count, size_m, frames):
    scans = street(count, size_m)
    assert sum(map(len, scans.points)) == sum(map(len, scans.intensities)) == count
    assert len(scans.points) == len(scans.poses) == frames
    assert {a.dtype for a in (*scans.points, *scans.intensities, scans.hits)} == {np.dtype(np.float32)}
    assert 0 < scans.poses[:, 0, 3].min() < scans.poses[:, 0, 3].max() < size_m
    x, y, z = scans.hits.T
    on = np.stack([np.abs(z), np.abs(np.abs(y) - 25), np.abs(x), np.abs(x - size_m)])
    assert on.min(0).max() < 1e-2
    assert (on < 1e-2).any(1)[: 4 if size_m == 50 else 2].all()  # all surfaces are hit
    range_m = np.linalg.norm(scans.hits - scans.hit_sensors, axis=1)
    assert np.abs(scans.hit_intensities - (100 - 40 * np.log10(range_m))).max() < 6.01


def test_a_map_of_another_street_is_refused():
    scans = street(10_000, 50.0)
    config = FitConfig(
        training={"sdf_iterations": 60, "intensity_iterations": 1}, networks={"reflectance": "network"}
    )
    points = [-scan for scan in scans.points]
    radar_map = fit(points, scans.poses, scans.intensities, config=config, progress=False)
    assert isinstance(radar_map, RadarMap)
    with pytest.raises(RuntimeError, match=r"signs|intensity"):
        map_errors(radar_map, scans)
