# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The probability that a surface is where a map says: from information, detections, looks, and what all returns tell."""

import dataclasses
import itertools
import math

import numpy as np
import pytest
import radarsdf
import torch
from radarsdf import FitConfig
from radarsdf.map import queries
from radarsdf.map.queries import EvidenceAt
from radarsdf.map.radar_map import RadarMap
from radarsdf.returns.evidence import Evidence

from ..conftest import ground_and_wall

LARGEST_COUNT = 2.0**32 - 1
LARGEST = float(np.finfo(np.float32).max)
SMALLEST = float(np.finfo(np.float32).tiny)


@pytest.fixture(scope="module")
def scene():
    return ground_and_wall(scans=5, returns_per_scan=600)


@pytest.fixture(scope="module")
def radar_map(scene):
    return radarsdf.fit(scene.points, scene.poses, config=FitConfig.quick(num_threads=2), progress=False)


def confidence(radar_map, information, hits, visibility, clutter_ratio=0.1, returns_per_cell=2.0):
    """Of places with this evidence, in a map with this clutter ratio, and returns in each cell that has any."""
    contents = dataclasses.replace(
        radar_map._contents, clutter_ratio=clutter_ratio, returns_per_cell=returns_per_cell
    )
    found = queries.confidence(contents, at(information, hits, visibility))
    assert found.dtype == torch.float32
    return found.numpy()


def at(information, hits, visibility):
    """The evidence of places."""
    columns = np.broadcast_arrays(*(np.asarray(a, np.float32) for a in (information, hits, visibility)))
    return EvidenceAt(*(torch.from_numpy(np.atleast_1d(column).copy()) for column in columns))


@pytest.mark.parametrize("clutter_ratio", [0.0, 1.0])
def test_it_is_a_probability_whatever_the_evidence(radar_map, clutter_ratio):
    counts = [0.0, 1e-6, 1.0, 20.0, LARGEST_COUNT]
    evidence = itertools.product([0.0, SMALLEST, 1.0, 1e4, LARGEST], counts, counts)
    information, hits, visibility = np.array(list(evidence)).T
    found = confidence(radar_map, information, hits, visibility, clutter_ratio)
    assert np.isfinite(found).all()
    assert ((found >= 0) & (found <= 1)).all()
    assert (found[information == 0] == 0).all()
    assert (found[information == 1e4] > 0).all()
    assert found.max() > 0.99
    # Hardly one of very many scans had a return.
    assert (found[(information == 1) & (hits <= 1) & (visibility == LARGEST_COUNT)] < 0.1).all()


def test_it_is_0_where_nothing_was_observed(radar_map):
    nowhere = radar_map.origin + [[300.0, 0, 0], [0, 0, 500], [1e9, 0, 0], [np.nan, 0, 0]]
    assert radar_map.confidence(nowhere).tolist() == [0, 0, 0, 0]
    # An open cell without returns in the 27 cells round it knows nothing, too.
    unknown = Evidence(*(np.zeros_like(column) for column in dataclasses.astuple(radar_map.evidence)))
    contents = dataclasses.replace(radar_map._contents, evidence=unknown)
    cells = radar_map.field.table.leaf_cells()[:100]
    centres = (cells + 0.5) * radar_map.config.leaf_size_m + radar_map.origin
    assert radar_map.observed(centres).all()
    assert RadarMap(contents).confidence(centres).tolist() == [0] * 100


ERROR_OF_A_CELL = 1 / 0.2**2
"""Information of a standard error of a leaf cell's edge, m⁻²."""


@pytest.mark.parametrize(("clutter_ratio", "returns_per_cell"), [(0.0, 0.0), (0.1, 2.0), (0.5, 12.0)])
def test_it_is_the_logistic_function_of_what_is_missing_and_how_rough_the_map_is(
    radar_map, clutter_ratio, returns_per_cell
):
    hits, visibility = np.array([4.0, 9, 1]), np.array([16.0, 3, 80])  # 4, 0.75 and 20 are expected
    error_cells = np.array([0.3, 0.2, 1.0])
    deviations = (visibility / 4 - hits) / np.sqrt(visibility / 4 + 1)
    missing = (deviations + np.hypot(deviations, 0.5)) / 2
    rough, crowded = np.tanh(clutter_ratio / 0.27), returns_per_cell / (returns_per_cell + 4)
    logits = 3.29 - 1.25 * np.log(error_cells) - 0.87 * missing - 3.77 * rough - 3.50 * crowded
    # Where the density of information is low, that of the neighbours holds a surface that bends by at most two cells.
    smoothed = np.minimum(error_cells, np.sqrt(2 / 8 * np.sqrt(9) * error_cells))
    reach = np.array([math.erf(math.sqrt(0.5) / cells) for cells in smoothed])
    expected = np.minimum(1 / (1 + np.exp(-logits)), reach)
    information = ERROR_OF_A_CELL / error_cells**2
    found = confidence(radar_map, information, hits, visibility, clutter_ratio, returns_per_cell)
    np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_places_have_the_evidence_of_their_cells(radar_map):
    """In the middle of a cell, none of its neighbours counts."""
    contents, evidence = radar_map._contents, radar_map.evidence
    centres = (radar_map.field.table.leaf_cells() + 0.5) * radar_map.config.leaf_size_m
    found = queries.evidence(contents, torch.from_numpy(centres.astype(np.float32)))
    for column, expected in zip(found, dataclasses.astuple(evidence), strict=True):
        assert expected.max() > 0
        np.testing.assert_allclose(column, expected, rtol=1e-3, atol=1e-3 * expected.max())
    known = evidence.information > 0  # elsewhere a rounded position has a little of the next cell's
    assert 0.5 < known.mean() < 1
    np.testing.assert_allclose(
        radar_map.confidence(centres + radar_map.origin)[known],
        queries.confidence(contents, at(*dataclasses.astuple(evidence))).numpy()[known],
        atol=1e-3,
    )
