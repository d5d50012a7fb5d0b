"""Data shared by benchmarks, fixed by seeds, with memory accesses as in a real fit."""

import ctypes
import os
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
from radarsdf._core import CellSet, VertexTable, cell_keys

LEAF_M = 0.2
NUM_LEVELS = 3
FEATURE_DIM = 8
PLANES = ((0, 1), (0, 2), (1, 2))
_HALF_M = 24.0  # half the width of the scene of `surface_points`
_BIAS = 1 << 20  # added to lattice coordinates, as in `VertexTable`, to make them non-negative


def surface_points(count, seed=0, dtype=np.float32):
    """Points (count, 3), m, on rolling ground with two walls, with the noise of radar returns."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-_HALF_M, _HALF_M, (2, count))
    z = 0.8 * np.sin(0.3 * x) + 0.5 * np.cos(0.2 * y)
    wall = rng.random(count) < 0.2
    z = np.where(wall, rng.uniform(0, 5, count), z)
    x = np.where(wall & (y > 0), _HALF_M / 2 + 0 * x, x)
    y = np.where(wall & (y <= 0), _HALF_M / 3 + 0 * y, y)
    points = np.column_stack([x, y, z]) + rng.uniform(-0.25, 0.25, (count, 3))
    return points.astype(dtype)


def _spread(values):
    """Interleave the bits of non-negative integers with two zeros each, as in a Morton code."""
    out = np.zeros(values.shape, np.uint64)
    for bit in range(21):
        out |= ((values >> bit & 1).astype(np.uint64)) << np.uint64(3 * bit)
    return out


@dataclass(frozen=True)
class Surface:
    """A vertex table with features, and a reference for its rows and weights in NumPy."""

    table: VertexTable
    features: torch.Tensor

    def rows_and_weights(self, points):
        """Rows and weights, (N, levels, 12) each, in the order that `VertexTable` documents."""
        leaf = self._leaf_cells()
        u = points.astype(np.float32) * np.float32(1 / LEAF_M)
        cell = np.floor(u).astype(np.int64) + _BIAS
        fraction_of_leaf = u.astype(np.float64) + _BIAS
        rows, weights, first = [], [], 0
        for level in range(NUM_LEVELS):
            cells, own = np.unique(leaf >> level, axis=0), cell >> level
            fraction = fraction_of_leaf / 2**level - own
            for axes in PLANES:
                corners = [(i, j) for j in (0, 1) for i in (0, 1)]
                keys = [self._key(cells, axes, corner) for corner in corners]
                vertices = np.unique(np.concatenate(keys))
                for corner in corners:
                    rows.append(first + np.searchsorted(vertices, self._key(own, axes, corner)))
                    factors = [
                        fraction[:, a] if c else 1 - fraction[:, a] for a, c in zip(axes, corner, strict=True)
                    ]
                    weights.append(factors[0] * factors[1])
                first += len(vertices)
        assert first == self.table.num_rows
        shape = (-1, NUM_LEVELS, 12)
        return np.stack(rows, 1).reshape(shape), np.stack(weights, 1).astype(np.float32).reshape(shape)

    def _leaf_cells(self):
        return self.table.leaf_cells().astype(np.int64) + _BIAS

    @staticmethod
    def _key(cells, axes, corner):
        a, b = ((cells[:, axis] + step).astype(np.uint64) for axis, step in zip(axes, corner, strict=True))
        return _spread(a) << np.uint64(axes[0]) | _spread(b) << np.uint64(axes[1])


@pytest.fixture(scope="session")
def smoke(request):
    """Whether nothing is measured: small sizes suffice to check that the benchmarks run."""
    return request.config.getoption("benchmark_disable")


@pytest.fixture(scope="session")
def surface(smoke):
    cells = CellSet(LEAF_M)
    cells.insert(surface_points(50_000 if smoke else 1_500_000))
    keys = cells.sorted_keys()
    assert smoke or 1.5e5 < len(keys) < 2.5e5
    table = VertexTable(keys, LEAF_M, NUM_LEVELS)
    generator = torch.Generator().manual_seed(0)
    return Surface(table, torch.randn(table.num_rows, FEATURE_DIM, generator=generator))


@dataclass(frozen=True)
class Batch:
    """Points of a training batch, and a checksum of their interpolated features from NumPy."""

    points: torch.Tensor
    rows: torch.Tensor
    weights: torch.Tensor
    total: float
    """Sum of the interpolated features."""
    scale: float
    """Expected size of `total` for features of random sign: the scale for its error."""


@pytest.fixture(scope="session", params=[8192, 262144])
def batch(request, surface, smoke):
    """Points in the cells of the surface, in the order of a training batch (Morton)."""
    points = (
        surface_points(50_000)[: request.param // 16] if smoke else surface_points(1_500_000)[: request.param]
    )
    points = np.ascontiguousarray(points[np.argsort(cell_keys(points, LEAF_M), kind="stable")])
    rows, weights = surface.rows_and_weights(points)
    features = surface.features.numpy().astype(np.float64)
    total = sum(
        (weights[:, :, k, None].astype(np.float64) * features[rows[:, :, k]]).sum() for k in range(12)
    )
    scale = np.sqrt((weights.astype(np.float64) ** 2).sum() * FEATURE_DIM)
    return Batch(torch.from_numpy(points), torch.from_numpy(rows), torch.from_numpy(weights), total, scale)


@pytest.fixture(scope="session")
def roofline(tmp_path_factory):
    """Library of `roofline.cpp`, compiled for this machine."""
    compiler = shutil.which(os.environ.get("CXX", "c++"))
    if compiler is None:
        pytest.skip("no C++ compiler for roofline.cpp")
    library = tmp_path_factory.mktemp("roofline") / "roofline.so"
    flags = ["-O3", "-march=native", "-fopenmp", "-shared", "-fPIC"]
    source = Path(__file__).with_name("roofline.cpp")
    subprocess.run([compiler, *flags, str(source), "-o", str(library)], check=True)
    return ctypes.CDLL(str(library))
