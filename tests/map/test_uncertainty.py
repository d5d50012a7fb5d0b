# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The standard error of the surface's position: from the noise of the returns, by range and number."""

import dataclasses
import math

import numpy as np
import pytest
import radarsdf
from radarsdf import FitConfig
from radarsdf.map.queries import _floor_m
from radarsdf.map.radar_map import RadarMap
from radarsdf.returns.noise import SensorNoise

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


def floor_m(radar_map):
    """What repetition does not shrink, m."""
    return _floor_m(radar_map._contents)


def two_walls(scans=4, returns=400):
    """A wall at x = 5 and one at x = 40, each 4 m wide and 2 m high, seen from the origin."""
    rng = np.random.default_rng(0)
    points = [
        np.column_stack(
            [
                np.repeat([5.0, 40.0], returns),
                np.concatenate([rng.uniform(-4, -0.5, returns), rng.uniform(0.5, 4, returns)]),
                rng.uniform(-1, 1, 2 * returns),
            ]
        )
        for _ in range(scans)
    ]
    return points, np.tile(np.eye(4), (scans, 1, 1))


@pytest.fixture(scope="module")
def walls():
    points, poses = two_walls()
    return points, radarsdf.fit(points, poses, config=CONFIG, progress=False)


def test_it_is_the_standard_error_of_the_returns_round_a_cell(walls):
    points, radar_map = walls
    returns = np.concatenate(points)
    local = returns - radar_map.origin
    cells = np.floor(local / LEAF_M)
    centres = np.unique(cells, axis=0)[::29]
    variances = KNOWN.variances_m2(np.linalg.norm(returns, axis=1).astype(np.float32))
    expected = [
        np.hypot(np.sum(1 / variances[(np.abs(cells - centre) <= 1).all(axis=1)]) ** -0.5, floor_m(radar_map))
        for centre in centres
    ]
    found = radar_map.uncertainty((centres + 0.5) * LEAF_M + radar_map.origin)
    np.testing.assert_allclose(found, expected, rtol=0.01)
    assert found.dtype == np.float64


def test_the_mesh_leaves_out_what_is_uncertain(walls):
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


def test_the_rougher_the_less_repetition_helps(walls):
    """Where nothing is rough, many returns give the position to a twentieth of a leaf cell."""
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
