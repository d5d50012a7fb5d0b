"""The probability of a mapped surface: from information, hits, visibility counts, and statistics of all returns."""

import dataclasses
import itertools
import math

import numpy as np
import pytest
import radarsdf
from radarsdf import FitConfig
from radarsdf._core import cell_keys
from radarsdf.map import confidence as confidences
from radarsdf.map.confidence import EvidenceAt
from radarsdf.map.radar_map import RadarMap
from radarsdf.returns.evidence import Evidence, usual_information
from radarsdf.returns.noise import SensorNoise

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
    """Confidence of places with this evidence, in a map with this clutter ratio and number of returns per occupied cell."""
    contents = dataclasses.replace(
        radar_map._contents, clutter_ratio=clutter_ratio, returns_per_cell=returns_per_cell
    )
    found = confidences.confidence(contents, at(information, hits, visibility))
    assert found.dtype == np.float32
    return found


def at(information, hits, visibility, usual=0.0):
    """Evidence at places. `usual`: information nearby, by default less than at the places."""
    given = (information, hits, visibility, usual)
    columns = np.broadcast_arrays(*(np.asarray(a, np.float32) for a in given))
    return EvidenceAt(*map(np.atleast_1d, columns))


@pytest.mark.parametrize("clutter_ratio", [0.0, 1.0])
def test_confidence_is_a_probability_for_any_evidence(radar_map, clutter_ratio):
    counts = [0.0, 1e-6, 1.0, 20.0, LARGEST_COUNT]
    evidence = itertools.product([0.0, SMALLEST, 1.0, 1e4, LARGEST], counts, counts)
    information, hits, visibility = np.array(list(evidence)).T
    found = confidence(radar_map, information, hits, visibility, clutter_ratio)
    assert np.isfinite(found).all()
    assert ((found >= 0) & (found <= 1)).all()
    assert (found[information == 0] == 0).all()
    assert (found[information == 1e4] > 0).all()
    assert found.max() > 0.99
    # Almost none of very many scans had a return.
    assert (found[(information == 1) & (hits <= 1) & (visibility == LARGEST_COUNT)] < 0.1).all()


def test_confidence_of_unobserved_places_is_0(radar_map):
    nowhere = radar_map.origin + [[300.0, 0, 0], [0, 0, 500], [1e9, 0, 0], [np.nan, 0, 0]]
    assert radar_map.confidence(nowhere).tolist() == [0, 0, 0, 0]
    # So is that of open cells without returns in their neighbourhood.
    unknown = Evidence(*(np.zeros_like(column) for column in dataclasses.astuple(radar_map.evidence)))
    contents = dataclasses.replace(radar_map._contents, evidence=unknown)
    cells = radar_map.field.table.leaf_cells()[:100]
    centres = (cells + 0.5) * radar_map.config.leaf_size_m + radar_map.origin
    assert radar_map.observed(centres).all()
    assert RadarMap(contents).confidence(centres).tolist() == [0] * 100


ERROR_OF_A_CELL = 1 / 0.2**2
"""Information of a standard error of a leaf cell's edge, m⁻²."""


@pytest.mark.parametrize(("clutter_ratio", "returns_per_cell"), [(0.0, 0.0), (0.1, 2.0), (0.5, 12.0)])
def test_confidence_is_logistic_in_missing_evidence_and_clutter(radar_map, clutter_ratio, returns_per_cell):
    hits, visibility = np.array([4.0, 9, 1]), np.array([16.0, 3, 80])  # 4, 0.75 and 20 are expected
    error_cells = np.array([0.3, 0.2, 1.0])
    deviations = (visibility / 4 - hits) / np.sqrt(visibility / 4 + 1)
    missing = (deviations + np.hypot(deviations, 0.5)) / 2
    rough, crowded = np.tanh(clutter_ratio / 0.27), returns_per_cell / (returns_per_cell + 4)
    logits = 3.29 - 1.25 * np.log(error_cells) - 0.87 * missing - 3.77 * rough - 3.50 * crowded
    # At low density of information, neighbours constrain a surface to a bend of at most two cells.
    smoothed = np.minimum(error_cells, np.sqrt(2 / 8 * np.sqrt(9) * error_cells))
    reach = np.array([math.erf(math.sqrt(0.5) / cells) for cells in smoothed])
    expected = np.minimum(1 / (1 + np.exp(-logits)), reach)
    information = ERROR_OF_A_CELL / error_cells**2
    found = confidence(radar_map, information, hits, visibility, clutter_ratio, returns_per_cell)
    np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_few_of_many_returns_nearby_are_no_surface(radar_map):
    """Noise spreads returns beyond an edge: of a hundredth of the density there, hundreds of scans are no evidence."""
    information, hits = np.full(4, 1e4), [400.0, 400, 400, 1]
    usual = 1e4 * np.array([1, 5, 100, 100])
    found = confidences.confidence(radar_map._contents, at(information, hits, 400.0, usual))
    alone = confidences.confidence(radar_map._contents, at(information, hits, 400.0))
    shares = np.array([1, 0.2, 0.01, 0.01]) * (1 + 4 / np.sqrt(hits))
    np.testing.assert_allclose(found / alone, 1 / (1 + (0.25 / shares) ** 3), rtol=1e-5)
    assert found[2] < 0.01


def test_usual_information_is_that_of_most_returns_nearby():
    rng = np.random.default_rng(0)
    cells = np.unique(rng.integers(0, 12, (300, 3)), axis=0)
    keys = cell_keys((cells + 0.5).astype(np.float32), 1.0, 1)
    order = np.argsort(keys)
    cells, information = cells[order], rng.lognormal(0, 2, len(cells)).astype(np.float32)
    found = usual_information(information, keys[order])
    pairs = cells // 2
    for i in range(0, len(cells), 17):
        near = information[(np.abs(pairs - pairs[i]) <= 1).all(axis=1)].astype(np.float64)
        assert found[i] == pytest.approx((near**2).sum() / near.sum(), rel=1e-5)
    assert len(usual_information(information[:0], keys[:0])) == 0


def test_places_have_the_evidence_of_their_cells(radar_map):
    """In the middle of a cell, its neighbours have no weight."""
    contents, evidence = radar_map._contents, radar_map.evidence
    centres = (radar_map.field.table.leaf_cells() + 0.5) * radar_map.config.leaf_size_m
    found = confidences.evidence(contents, centres.astype(np.float32))
    columns = *dataclasses.astuple(evidence), contents.evidence_of_cells[1][:, 3]
    for column, expected in zip(found, columns, strict=True):
        assert expected.max() > 0
        np.testing.assert_allclose(column, expected, rtol=1e-3, atol=1e-3 * expected.max())
    known = evidence.information > 0  # elsewhere, rounded positions have a small share of the next cell
    assert 0.5 < known.mean() < 1
    np.testing.assert_allclose(
        radar_map.confidence(centres + radar_map.origin)[known],
        confidences.confidence(contents, at(*columns))[known],
        atol=1e-3,
    )


KNOWN = SensorNoise(range_m=0.1, azimuth_rad=0.006, elevation_rad=0.012)
LEAF_M = 0.2
CONFIG = FitConfig.quick().override(
    num_threads=2,
    returns={
        "min_range_m": 0.0,
        "drop_ghosts": False,
        "range_noise_m": KNOWN.range_m,
        "azimuth_noise_rad": KNOWN.azimuth_rad,
        "elevation_noise_rad": KNOWN.elevation_rad,
    },
    encoding={"bridge_cells": 0},
)


@pytest.fixture(scope="module")
def walls():
    """A wall at x = 5 and one at x = 40, each 4 m wide and 2 m high, seen from the origin by four scans."""
    rng, points = np.random.default_rng(0), []
    for _ in range(4):
        y = np.concatenate([rng.uniform(-4, -0.5, 400), rng.uniform(0.5, 4, 400)])
        points.append(np.column_stack([np.repeat([5.0, 40.0], 400), y, rng.uniform(-1, 1, 800)]))
    return points, radarsdf.fit(points, np.tile(np.eye(4), (4, 1, 1)), config=CONFIG, progress=False)


def test_uncertainty_is_the_standard_error_of_returns_near_a_cell(walls):
    points, radar_map = walls
    returns = np.concatenate(points)
    local = returns - radar_map.origin
    cells = np.floor(local / LEAF_M)
    centres = np.unique(cells, axis=0)[::29]
    variances = KNOWN.variances_m2(np.linalg.norm(returns, axis=1).astype(np.float32))
    floor_m = confidences.floor_cells(radar_map._contents) * LEAF_M  # repetition does not reduce it
    expected = [
        np.hypot(np.sum(1 / variances[(np.abs(cells - centre) <= 1).all(axis=1)]) ** -0.5, floor_m)
        for centre in centres
    ]
    found = radar_map.uncertainty((centres + 0.5) * LEAF_M + radar_map.origin)
    np.testing.assert_allclose(found, expected, rtol=0.01)
    assert found.dtype == np.float64


def test_the_mesh_excludes_uncertain_surface(walls):
    _, radar_map = walls
    kept = {"min_confidence": 0, "min_component_triangles": 0}
    everything = radar_map.mesh(max_uncertainty=math.inf, **kept)
    certain = radar_map.mesh(max_uncertainty=0.035, **kept)
    assert everything.vertices[:, 0].max() > 39
    assert certain.vertices[:, 0].max() < 6
    assert len(certain.faces) > 0
    assert (certain.vertex_attributes["uncertainty_m"] <= 0.035).all()
    np.testing.assert_allclose(
        certain.vertex_attributes["uncertainty_m"], radar_map.uncertainty(certain.vertices), rtol=1e-4
    )
    default = radar_map.mesh(**kept)
    np.testing.assert_array_equal(default.faces, everything.faces)


def test_repetition_reduces_uncertainty_less_on_rough_surfaces(walls):
    """Without roughness, many returns determine the position to a twentieth of a leaf cell."""
    _, radar_map = walls
    contents = radar_map._contents
    information = np.full_like(radar_map.evidence.information, 1e12)
    without_noise = dataclasses.replace(radar_map.evidence, information=information)
    errors_m = []
    for clutter_ratio in (0.0, 0.02, 0.1, 0.25):
        rough = dataclasses.replace(contents, evidence=without_noise, clutter_ratio=clutter_ratio)
        errors_m.append(RadarMap(rough).uncertainty([[5.0, -2.0, 0.0]])[0])
        assert RadarMap(rough).mesh().vertices[:, 0].max() > 39
    assert errors_m[0] == pytest.approx(0.05 * LEAF_M, rel=1e-4)
    assert (np.diff(errors_m) > 0).all()
