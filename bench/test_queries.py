"""Query times of fitted maps near their returns, next to distances to their mesh by Open3D, and times of meshes."""

import numpy as np
import pytest
import radarsdf
from radarsdf import FitConfig

COUNTS = (1, 1_000, 100_000)
CONFIGS = {"quick": FitConfig.quick(num_threads=1), "trained": FitConfig(num_threads=1)}
FEW = {"sdf_iterations": 30, "intensity_iterations": 30}
SENSOR = np.zeros(3)
QUERIES = {
    "sdf": lambda radar_map, x: radar_map.sdf(x),
    "gradient": lambda radar_map, x: radar_map.gradient(x),
    "both": lambda radar_map, x: radar_map.sdf(x, return_gradient=True),
    "confidence": lambda radar_map, x: radar_map.confidence(x),
    "uncertainty": lambda radar_map, x: radar_map.uncertainty(x),
    "intensity": lambda radar_map, x: radar_map.intensity(x, SENSOR),
}


@pytest.fixture(scope="module")
def drive(smoke):
    """The drive of `hugin`."""
    return radarsdf.simulate.hugin(frames=4 if smoke else None)


@pytest.fixture(scope="module", params=CONFIGS)
def radar_map(request, drive, smoke):
    config = CONFIGS[request.param].override(training=FEW if smoke and request.param == "trained" else {})
    return radarsdf.fit(drive.points, drive.poses, drive.intensities, config=config, progress=False)


@pytest.fixture(params=COUNTS)
def near(request, drive):
    """Positions near returns, world, m."""
    rng = np.random.default_rng(0)
    world = drive.world_points()
    return world[rng.integers(len(world), size=request.param)] + rng.normal(0, 0.1, (request.param, 3))


def measure(benchmark, function, near):
    """Measure many repetitions of short calls: the minimum counts, since other processes disturb."""
    rounds = max(5, 300_000 // len(near)) if len(near) > 1 else 2_000
    return benchmark.pedantic(function, (near,), rounds=min(rounds, 2_000), warmup_rounds=2)


@pytest.mark.parametrize("name", QUERIES)
def test_query(benchmark, radar_map, near, name):
    found = measure(benchmark, lambda x: QUERIES[name](radar_map, x), near)
    values = found[0] if name == "both" else found
    assert len(values) == len(near)
    assert len(near) == 1 or np.isfinite(values).mean() > 0.5  # elsewhere nothing was observed


def test_open3d(benchmark, radar_map, near):
    o3d = pytest.importorskip(
        "open3d", reason="Open3D is missing: pip install '.[peers]'", exc_type=ImportError
    )
    mesh = radar_map.mesh(0.2, progress=False)
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32))
    x = near.astype(np.float32)
    found = measure(benchmark, lambda y: scene.compute_signed_distance(y, nthreads=1), x)
    assert np.isfinite(found.numpy()).all()


@pytest.mark.parametrize("voxel_m", [0.1, 0.05])
def test_mesh(benchmark, radar_map, voxel_m, smoke):
    voxel_m = 4 * voxel_m if smoke else voxel_m
    mesh = benchmark.pedantic(radar_map.mesh, (voxel_m,), {"progress": False}, rounds=5, warmup_rounds=1)
    benchmark.extra_info["vertices"] = len(mesh.vertices)
    assert len(mesh.faces) > 0
