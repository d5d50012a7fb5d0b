"""What the returns show of each leaf cell, how many scans see it, and which gaps between returns are bridged."""

import dataclasses

import numpy as np
import pytest
import radarsdf
from radarsdf import FitConfig
from radarsdf._core import CellSet, cell_keys
from radarsdf.config.fit_config import LATTICE_BLOCK_CELLS
from radarsdf.returns.evidence import _MAX_SUPPORT, Evidence, ReturnsOfCells, bridged
from radarsdf.returns.rays import prepare
from radarsdf.returns.sums import ReturnCells, lattice_of

from ..conftest import pose
from ..reference_visibility import looks_at

LEAF_M = 0.2
SCANS = 5
CLUTTER = np.array([3.1, 0.1, 0.1])
"""In the middle of a cell, before the wall. All scans look through it, one has returns there."""
SIDE = np.array([5.1, 5.1, 0.1])
"""A part of the wall that one scan sees."""
BEHIND = np.array([10.1, 10.1, 0.1])
"""A false return of another, which looked there. No other ray goes to it."""
VARIANCE_M2 = 0.04


def a_scene():
    """Scans of a wall at x = 5.1: one has six returns in a cell before it, and the last of another is false."""
    rng = np.random.default_rng(0)
    scans = []
    for scan in range(SCANS):
        wall = np.column_stack([np.full(150, 5.1), rng.uniform(-1, 1, (150, 2))])
        wall[0, 1:] = 0.1  # through the clutter
        clutter = CLUTTER + rng.uniform(-0.05, 0.05, (6 if scan == 2 else 0, 3))
        beside = {3: BEHIND[None], 4: SIDE[None]}.get(scan, wall[:0])
        scans.append(np.concatenate([wall, clutter, beside]))
    positions = np.linspace(-0.04, 0.04, SCANS)[:, None] * [0, 1, 1]
    poses = np.tile(np.eye(4), (SCANS, 1, 1))
    poses[:, :3, 3] = positions
    return [p - position for p, position in zip(scans, positions, strict=True)], poses


@pytest.fixture(scope="module")
def rays():
    return prepare(*a_scene(), origin=np.zeros(3))


def is_false(rays):
    return np.linalg.norm(rays.points - BEHIND, axis=1) < 0.1


def cells_of(points):
    """Lattice coordinates (N, 3), as in the core."""
    return lattice_of(cell_keys(np.ascontiguousarray(points), LEAF_M))


def keys_of(cells):
    return np.unique(cell_keys((cells + 0.5) * LEAF_M, LEAF_M))


def keys_round(points):
    """Keys of the cells of points, and of all cells within a distance of two."""
    steps = np.stack(np.meshgrid(*[np.arange(-2, 3)] * 3), -1).reshape(-1, 3)
    return keys_of((np.unique(cells_of(points), axis=0)[:, None] + steps).reshape(-1, 3))


def returns_of(rays, variances_m2):
    """Evidence of returns, counted with dictionaries."""
    keys = cell_keys(np.ascontiguousarray(rays.points), LEAF_M).tolist()
    scans_of_cell, information = {}, {}
    for key, scan, variance_m2 in zip(keys, rays.scans.tolist(), variances_m2.tolist(), strict=True):
        scans_of_cell.setdefault(key, set()).add(scan)
        information[key] = information.get(key, 0) + 1 / variance_m2
    found = sorted(information)
    return ReturnsOfCells(
        keys=np.array(found, np.uint64),
        information=np.array([information[key] for key in found], np.float32),
        scans=np.array([len(scans_of_cell[key]) for key in found], np.uint32),
        counts=np.ones(len(found)),  # not used by evidence
    )


def within_a_cell(points, leaf_keys):
    """(C, N) bool, whether each point is in the neighbourhood of a leaf cell."""
    return (np.abs(lattice_of(leaf_keys)[:, None] - cells_of(points)[None]) <= 1).all(axis=2)


def scans_round(rays, leaf_keys):
    """Numbers (C,) of scans with returns, summed over the neighbourhood of each leaf cell."""
    pairs = np.unique(np.column_stack([cells_of(rays.points), rays.scans]), axis=0)
    return within_a_cell((pairs[:, :3] + 0.5) * LEAF_M, leaf_keys).sum(axis=1)


def visibility(rays, leaf_keys):
    return looks_at(lattice_of(leaf_keys), LEAF_M, rays.points, rays.directions, rays.ranges_m, rays.scans)


def at(evidence, leaf_keys, point):
    """Information, hits and visibility counts of the leaf cell of a point."""
    row = np.searchsorted(leaf_keys, cell_keys(point[None], LEAF_M)[0])
    return tuple(column[row].item() for column in dataclasses.astuple(evidence))


def test_sums_over_neighbourhoods_and_visibility_counts(rays):
    variances_m2 = np.random.default_rng(1).uniform(0.01, 1, len(rays))
    leaf_keys = keys_round(rays.points)
    evidence = Evidence.of(returns_of(rays, variances_m2), rays, leaf_keys, LEAF_M)
    near = within_a_cell(rays.points, leaf_keys)
    np.testing.assert_allclose(evidence.information, near @ (1 / variances_m2), rtol=1e-5)
    np.testing.assert_array_equal(evidence.hits, scans_round(rays, leaf_keys))
    np.testing.assert_array_equal(evidence.visibility, visibility(rays, leaf_keys))
    dtypes = [column.dtype for column in dataclasses.astuple(evidence)]
    assert dtypes == [np.float32, np.uint32, np.uint32]
    assert {0, 1, SCANS} <= set(evidence.visibility.tolist())
    for num_threads in (1, 2, 3):
        again = Evidence.of(returns_of(rays, variances_m2), rays, leaf_keys, LEAF_M, num_threads)
        for a, b in zip(dataclasses.astuple(again), dataclasses.astuple(evidence), strict=True):
            assert a.tobytes() == b.tobytes()


def test_a_false_return_is_no_evidence_but_counts_as_visibility(rays):
    leaf_keys = keys_round(rays.points)
    real = rays.select(~is_false(rays))
    assert len(real) == len(rays) - 1
    returns = returns_of(real, np.full(len(real), VARIANCE_M2))
    assert at(Evidence.of(returns, rays, leaf_keys, LEAF_M), leaf_keys, BEHIND) == (0, 0, 1)
    assert at(Evidence.of(returns, real, leaf_keys, LEAF_M), leaf_keys, BEHIND) == (0, 0, 0)


STARTS = {"average": FitConfig.quick(), "noise": FitConfig(training={"sdf_iterations": 2, "batch_size": 64})}


@pytest.mark.parametrize("start", STARTS)
@pytest.mark.parametrize("drop_ghosts", [False, True])
def test_a_map_has_the_evidence_of_its_returns(rays, start, drop_ghosts, monkeypatch):
    """With noise independent of range, so that all returns have equal information."""

    def cells_of_ghosts(surfels, *_):
        cells = surfels.cells_at(rays.points)
        assert not set(cells[is_false(rays)]) & set(cells[~is_false(rays)])
        return np.isin(np.arange(len(surfels.keys)), cells[is_false(rays)])

    monkeypatch.setattr("radarsdf.fitting.surface_returns.find_ghosts", cells_of_ghosts)
    config = STARTS[start].override(
        num_threads=2,
        returns={
            "min_range_m": 0.0,
            "drop_ghosts": drop_ghosts,
            "onto_planes": False,
            "range_noise_m": VARIANCE_M2**0.5,
            "azimuth_noise_rad": 1e-6,
            "elevation_noise_rad": 1e-6,
        },
        encoding={"bridge_cells": 0},
    )
    radar_map = radarsdf.fit(*a_scene(), config=config, origin=(0, 0, 0), progress=False)
    assert radar_map.report["ghosts"] == drop_ghosts
    leaf_keys = radar_map.field.table.leaf_keys()
    own = rays.select(~is_false(rays)) if drop_ghosts else rays
    evidence = radar_map.evidence
    np.testing.assert_allclose(
        evidence.information, within_a_cell(own.points, leaf_keys).sum(axis=1) / VARIANCE_M2, rtol=1e-4
    )
    np.testing.assert_array_equal(evidence.hits, scans_round(own, leaf_keys))
    np.testing.assert_array_equal(evidence.visibility, visibility(rays, leaf_keys))
    assert at(evidence, leaf_keys, CLUTTER)[1:] == (1, SCANS)
    assert at(evidence, leaf_keys, SIDE)[1:] == (1, 2)


@pytest.mark.parametrize("max_cells", [1, 2, 4, 9])
def test_bridges_equal_a_search_of_all_pairs(max_cells):
    rng = np.random.default_rng(max_cells)
    points = (rng.integers(-6, 6, (150, 3)) + 0.5) * LEAF_M
    # The origin of the local frame is the sensor, a whole number of cells away.
    sensor = np.array([0, 0, 30.0])
    rays = prepare([points - sensor], pose(sensor)[None], min_range_m=1.0, max_range_m=None)
    occupied = CellSet(LEAF_M)
    occupied.insert(np.ascontiguousarray(rays.points), 1)
    leaf_keys = occupied.sorted_keys(1)
    cells = np.unique(np.floor(rays.points / np.float32(LEAF_M)).astype(int), axis=0)
    keys = cell_keys(((cells + 0.5) * LEAF_M), LEAF_M)
    support = within_a_cell(rays.points, keys).sum(axis=1)
    block = cells // LATTICE_BLOCK_CELLS  # the cells lie in eight of them, and every leaf cell holds returns
    same = (block[:, None] == block).all(axis=2)
    least = np.array([0.5 * np.median(support[of_block]) for of_block in same])
    expected = set()
    for i, a in enumerate(cells):
        for j, b in enumerate(cells[:i]):
            way = b - a
            distance = np.abs(way).max()
            if not 2 <= distance <= max_cells + 1 or not np.isin(np.abs(way), (0, distance)).all():
                continue
            if (support[[i, j]] >= least[[i, j]]).all() and support[i] + support[j] < 2 * _MAX_SUPPORT:
                line = a + np.arange(1, distance)[:, None] * (way // distance)
                expected |= set(cell_keys((line + 0.5) * LEAF_M, LEAF_M).tolist())
    returns = ReturnCells.of(rays, LEAF_M)
    found = bridged(leaf_keys, returns.keys, returns.counts, max_cells)
    np.testing.assert_array_equal(found, bridged(leaf_keys, returns.keys, returns.counts, max_cells, 3))
    assert found.tolist() == sorted(expected | set(leaf_keys.tolist()))
