"""Rays per second through the surface of a map, from a sensor's pose, on one thread and on two.

The extra information lists rays per second. Each case checks that most rays end near a return's range or nowhere, so
that a wrong result cannot be fast.
"""

import numpy as np
import pytest
import radarsdf
import torch
from radarsdf import FitConfig
from radarsdf.map.view import ViewedMap


@pytest.fixture(scope="module")
def rays(smoke):
    """Numbers of elevations and of azimuths."""
    return (60, 200) if smoke else (600, 2000)


@pytest.fixture(scope="module")
def scene(smoke):
    scans = radarsdf.simulate.hugin(frames=12 if smoke else 60)
    radar_map = radarsdf.fit(scans.points, scans.poses, config=FitConfig.quick(), progress=False)
    return radar_map, scans.poses[len(scans.poses) // 2]


@pytest.mark.parametrize("order", ["in order", "shuffled"])
@pytest.mark.parametrize("threads", [1, 2])
def test_first_hits(benchmark, scene, rays, threads, order):
    benchmark.group = f"{rays[0] * rays[1]:,} rays through a map, {order}"
    radar_map, pose = scene
    surface = ViewedMap.of(radar_map._contents)
    low, high = np.transpose([radar_map.sensor.elevation_rad, radar_map.sensor.azimuth_rad])
    axes = [np.linspace(*limits) for limits in zip(low, high, rays, strict=True)]
    elevation, azimuth = (grid.ravel() for grid in np.meshgrid(*axes, indexing="ij"))
    directions = (radar_map.sensor.directions(azimuth, elevation) @ pose[:3, :3].T).astype(np.float32)
    if order == "shuffled":
        directions = np.random.default_rng(0).permutation(directions)
    origin = (pose[:3, 3] - radar_map.origin).tolist()
    ranges_m, _ = benchmark(surface.tracer.first_hits, origin, directions, 60.0, num_threads=threads)
    benchmark.extra_info["million_rays_per_s"] = (
        len(directions) / benchmark.stats["median"] / 1e6 if benchmark.stats else 0
    )
    met = np.isfinite(ranges_m)
    assert 0.3 < met.mean() < 0.95
    places = torch.from_numpy(np.array(origin) + directions[met][::997] * ranges_m[met][::997, None])
    distance_m = radar_map.sdf(places + torch.from_numpy(radar_map.origin)).numpy()
    assert np.nanmedian(np.abs(distance_m)) < 0.05
