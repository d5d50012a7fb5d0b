# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The mesh leaves out what few of the scans saw that looked there."""

from __future__ import annotations

import dataclasses
import itertools
import math

import numpy as np
import pytest
import radarsdf
import torch
from radarsdf import FitConfig
from radarsdf.map.queries import EvidenceAt, answers
from radarsdf.map.radar_map import RadarMap

WALL_X_M = 10.1
PATCH_X_M = 6.1
MESH = {"min_component_triangles": 0, "progress": False}


def plane(rng, x_m, half_m, count):
    """Returns (N, 3) of a square that faces the sensor."""
    return np.column_stack([rng.normal(x_m, 0.03, count), rng.uniform(-half_m, half_m, (count, 2))])


def fit(points):
    """Seen from the origin."""
    config = FitConfig.quick(num_threads=2)
    poses = np.tile(np.eye(4), (len(points), 1, 1))
    # Wall and patch are in the middle of cells.
    return radarsdf.fit(points, poses, config=config, origin=(0, 0, 0), progress=False)


def wall_and_patch(scans):
    """All scans see a wall, one of them a dense patch before it: the others look through there."""
    rng = np.random.default_rng(0)
    points = [plane(rng, WALL_X_M, 2.0, 60) for _ in range(scans)]
    points[scans // 2] = np.concatenate([points[scans // 2], plane(rng, PATCH_X_M, 0.6, 400)])
    return fit(points)


def triangles_near(mesh, x_m):
    return int((np.abs(mesh.triangles_center[:, 0] - x_m) < 0.5).sum()) if len(mesh.faces) else 0


@pytest.fixture(scope="module")
def of_many():
    return wall_and_patch(100)


@pytest.fixture(scope="module")
def of_few():
    return wall_and_patch(4)


def test_a_patch_that_one_scan_of_many_saw_is_left_out(of_many):
    everything = of_many.mesh(min_detection_rate=0, **MESH)
    assert triangles_near(everything, PATCH_X_M) > 200
    default = of_many.mesh(**MESH)
    assert triangles_near(default, PATCH_X_M) == 0
    assert triangles_near(default, WALL_X_M) == triangles_near(everything, WALL_X_M) > 2000


def test_a_patch_that_one_scan_of_few_saw_is_kept(of_few):
    everything, default = of_few.mesh(min_detection_rate=0, **MESH), of_few.mesh(**MESH)
    assert triangles_near(default, PATCH_X_M) == triangles_near(everything, PATCH_X_M) > 200


def test_a_patch_is_kept_where_few_of_many_scans_looked(of_many):
    """As the first test, but for the looks: only every tenth scan looked there."""
    contents = of_many._contents
    few = dataclasses.replace(of_many.evidence, looks=of_many.evidence.looks // 10)
    mesh = RadarMap(dataclasses.replace(contents, evidence=few)).mesh(**MESH)
    everything = of_many.mesh(min_detection_rate=0, **MESH)
    assert triangles_near(mesh, PATCH_X_M) == triangles_near(everything, PATCH_X_M) > 200


@pytest.mark.parametrize("name", ["of_many", "of_few"])
def test_a_larger_rate_never_keeps_more(name, request):
    radar_map = request.getfixturevalue(name)
    kept = []
    for rate in (0, 1e-6, 1e-4, 1e-3, 0.01, 0.03, 0.06, 0.1, 0.2, 0.6, 1e3, 1e300):
        mesh = radar_map.mesh(min_detection_rate=rate, **MESH)
        kept.append({tuple(corners) for corners in mesh.triangles.reshape(-1, 9).tolist()})
    assert all(more >= less for more, less in itertools.pairwise(kept))
    assert len({len(triangles) for triangles in kept}) > 4
    assert len(kept[-1]) == 0
    everything = radar_map.mesh(min_detection_rate=0, max_uncertainty=math.inf, **MESH)
    assert len(everything.faces) >= len(kept[0]) > 0


def test_the_default_rate(of_many):
    default, given = of_many.mesh(**MESH), of_many.mesh(min_detection_rate=0.028, **MESH)
    np.testing.assert_array_equal(default.triangles, given.triangles)
    assert len(of_many.mesh(min_detection_rate=0.011, **MESH).faces) > len(default.faces)


def test_the_fewer_looks_the_more_is_left_to_chance():
    """Half a Poisson deviation less than expected is enough: 25 - 2.5, 250 - 7.9, 1 - 0.5.

    A rate is that of one cell. A surface has nine round a point.
    """
    for rate, looks, least in ((0.25, 100, 22.5), (0.25, 1000, 242.1), (0.25, 4, 0.5), (1.0, 100, 95.0)):
        detections = torch.tensor([0.0, least - 0.1, least + 0.1, looks])
        evidence = EvidenceAt(torch.ones(4), detections, torch.full((4,), float(looks)))
        assert answers(evidence, rate / 9).tolist() == [False, False, True, True]
        assert answers(evidence, 0.0).all()
    one_look, no_look = (EvidenceAt(*torch.tensor([[1.0], [0.0], [looks]])) for looks in (1.0, 0.0))
    assert answers(one_look, 0.25 / 9)
    assert answers(no_look, 0.25 / 9)


@pytest.mark.parametrize("wrong", [-0.1, -1e-9, math.nan, math.inf, "often", None, [0.1, 0.2]])
def test_wrong_rates_are_refused(of_few, wrong):
    with pytest.raises((ValueError, TypeError), match="min_detection_rate"):
        of_few.mesh(min_detection_rate=wrong)


def wall_and_clutter(scans):
    """A wall, and before it 30 places where a scan in 25 has four returns."""
    places = np.random.default_rng(5).uniform([4, -1.5, -1.5], [8, 1.5, 1.5], (30, 3))
    places[:, 1:] *= places[:, :1] / WALL_X_M  # all scans look through them at the wall
    rng = np.random.default_rng(0)
    points = []
    for _ in range(scans):
        here = places[rng.random(len(places)) < 0.04]
        clutter = here[:, None] + rng.uniform(-0.2, 0.2, (len(here), 4, 3))
        points.append(np.concatenate([plane(rng, WALL_X_M, 2.0, 50), clutter.reshape(-1, 3)]))
    return fit(points)


def test_ten_times_the_scans_bring_no_more_false_surface():
    false_m2, all_of_it_m2 = [], []
    for scans in (15, 150):
        radar_map = wall_and_clutter(scans)
        for found, arguments in ((false_m2, {}), (all_of_it_m2, {"min_detection_rate": 0})):
            mesh = radar_map.mesh(progress=False, **arguments)
            is_false = mesh.triangles_center[:, 0] < WALL_X_M - 0.6
            found.append(mesh.area_faces[is_false].sum())
            assert mesh.area_faces[~is_false].sum() > 13  # of 16 m² of wall
    assert false_m2[1] < 0.5 * false_m2[0]
    assert all_of_it_m2[1] > 3 * all_of_it_m2[0] > 0  # repeated often enough to be meshed
