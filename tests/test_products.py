"""Maps do not depend on the number of BLAS threads, because only `products` multiplies matrices."""

import ast
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import radarsdf
from radarsdf.products import normal_matrix, product, turned

ROOT = Path(radarsdf.__file__).parent
# Subpackages that compute or query maps.
ROOMS = ("returns", "field", "fitting", "map", "tiles")
CALLS = {"dot", "vdot", "inner", "matmul", "tensordot", "lstsq", "polyfit", "cov"}
# Three equations: LAPACK uses a single thread.
ALLOWED = {"returns/noise.py: lstsq"}

# Large enough for OpenBLAS to use a second thread; with Doppler, for velocities.
FIT = """
import hashlib, sys
import numpy as np, radarsdf
from radarsdf.map.radar_map import parts_of
from tests.conftest import ground_and_wall

scene = ground_and_wall(scans=2, returns_per_scan=40_000)
sensor_mps = np.array([1.0, 0.0, 0.0])
doppler = [-scan @ sensor_mps / np.linalg.norm(scan, axis=1) for scan in scene.points]
for config in (radarsdf.FitConfig.quick(), radarsdf.FitConfig(effort=0.02)):
    found = radarsdf.fit(scene.points, scene.poses, scene.intensities, doppler_mps=doppler, config=config)
    tensors, _ = parts_of(found._contents)
    at = scene.points[0][:20_000] @ scene.poses[0, :3, :3].T + scene.poses[0, :3, 3]
    answers = {"confidence": found.confidence(at), "sdf": found.sdf(at), "uncertainty": found.uncertainty(at)}
    for name, numbers in (tensors | answers).items():
        print(name, hashlib.sha256(np.asarray(numbers).tobytes()).hexdigest()[:16])
"""


def uses(path):
    """Calls of BLAS and LAPACK in a file that may have many rows."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.MatMult):
            yield "@"
        if isinstance(node, ast.Call) and getattr(node.func, "attr", None) in CALLS:
            yield node.func.attr
        if isinstance(node, ast.keyword) and node.arg == "optimize":
            yield "optimize"


def test_only_products_multiplies_matrices():
    found = {
        f"{path.relative_to(ROOT).as_posix()}: {use}"
        for room in ROOMS
        for path in sorted((ROOT / room).rglob("*.py"))
        for use in uses(path)
    }
    assert found == ALLOWED


def test_products_equal_blas():
    rng = np.random.default_rng(0)
    a, b, c = rng.normal(size=(50, 4)), rng.normal(size=(4, 3)), rng.normal(size=(50, 2))
    np.testing.assert_allclose(product(a, b), a @ b, rtol=1e-12)
    np.testing.assert_allclose(normal_matrix(a, c), a.T @ c, rtol=1e-12)
    points, R = rng.normal(size=(50, 3)).astype(np.float32), rng.normal(size=(3, 3))
    found = turned(points, R)
    assert found.dtype == np.float64
    np.testing.assert_allclose(found, points @ R.T, rtol=1e-12)
    assert turned(points[:0], R).shape == (0, 3)


def run_fit(threads):
    names = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS")
    # Not all kernels of OpenBLAS depend on threads: those of old processors do, and run on all.
    environment = os.environ | dict.fromkeys(names, str(threads)) | {"OPENBLAS_CORETYPE": "Prescott"}
    options = {"cwd": Path(__file__).parents[1], "capture_output": True, "text": True}
    done = subprocess.run([sys.executable, "-c", FIT], env=environment, **options, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@pytest.mark.skipif(os.cpu_count() == 1, reason="BLAS has one thread on one processor")
def test_a_map_has_the_same_bits_with_any_number_of_threads_of_blas():
    one, two = run_fit(1), run_fit(2)
    assert len(one) > 20
    assert one == two
