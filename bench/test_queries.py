"""Query times of a fitted map: signed distances near its returns, and meshes."""

from __future__ import annotations

import numpy as np
import pytest
import radarsdf

COUNT = 1_000_000


@pytest.fixture(scope="module")
def drive(request):
    """The drive of `hugin`, shortened if nothing is measured, and its map."""
    scans = radarsdf.simulate.hugin(frames=4 if request.config.getoption("benchmark_disable") else None)
    return scans, radarsdf.fit(scans.points, scans.poses, progress=False)


def test_signed_distances(benchmark, drive):
    scans, radar_map = drive
    rng = np.random.default_rng(0)
    world = scans.world_points()
    near = world[rng.integers(len(world), size=COUNT)] + rng.normal(0, 0.1, (COUNT, 3))
    distances_m = benchmark.pedantic(radar_map.sdf, (near,), rounds=5, warmup_rounds=1)
    known = np.isfinite(distances_m)  # elsewhere nothing was observed
    assert known.mean() > 0.5
    assert np.median(np.abs(distances_m[known])) < 1


@pytest.mark.parametrize("voxel_m", [0.1, 0.05])
def test_mesh(benchmark, drive, voxel_m):
    mesh = benchmark.pedantic(drive[1].mesh, (voxel_m,), {"progress": False}, rounds=5, warmup_rounds=1)
    benchmark.extra_info["vertices"] = len(mesh.vertices)
    assert len(mesh.faces) > 0
