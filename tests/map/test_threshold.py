"""The confidence threshold of a mesh maximises its expected F-score, and is reported with its expectations."""

import numpy as np
import pytest
import radarsdf
from radarsdf import FitConfig
from radarsdf.map.threshold import Limits, Tally, Threshold

WALL_X_M = 10.1
PATCH_X_M = 6.1
MESH = {"min_component_triangles": 0, "progress": False}


def plane(rng, x_m, half_m, count):
    """Returns (N, 3) of a square facing the sensor."""
    return np.column_stack([rng.normal(x_m, 0.03, count), rng.uniform(-half_m, half_m, (count, 2))])


def fit(points):
    """Fits scans from the origin."""
    config = FitConfig.quick(num_threads=2)
    poses = np.tile(np.eye(4), (len(points), 1, 1))
    # Wall and patch are in the middle of cells.
    return radarsdf.fit(points, poses, config=config, origin=(0, 0, 0), progress=False)


def wall_and_patch(scans):
    """All scans see a wall, one of them a dense patch before it, which the rays of the others cross."""
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


def test_a_patch_with_hits_of_one_scan_of_many_is_removed(of_many):
    everything = of_many.mesh(min_confidence=0, **MESH)
    assert triangles_near(everything, PATCH_X_M) > 200
    default = of_many.mesh(**MESH)
    assert triangles_near(default, PATCH_X_M) == 0
    assert triangles_near(default, WALL_X_M) == triangles_near(everything, WALL_X_M) > 2000


def test_a_patch_with_hits_of_one_scan_of_few_is_kept(of_few):
    everything, default = of_few.mesh(min_confidence=0, **MESH), of_few.mesh(**MESH)
    assert triangles_near(default, PATCH_X_M) == triangles_near(everything, PATCH_X_M) > 200


def test_the_mesh_has_its_threshold_and_expectations(of_many):
    default = of_many.mesh(**MESH)
    threshold = Threshold.of_mesh(default.metadata)
    given = of_many.mesh(min_confidence=threshold.min_confidence, **MESH)
    np.testing.assert_array_equal(default.triangles, given.triangles)
    assert Threshold.of_mesh(given.metadata) == threshold
    everything = of_many.mesh(min_confidence=0, **MESH)
    area = everything.area_faces / 3
    p = everything.vertex_attributes["confidence"][everything.faces].sum(axis=1)
    # Surface beyond the limit of uncertainty is removed from this mesh, but is counted there.
    assert threshold.whole_precision == pytest.approx((p * area).sum() / everything.area, abs=0.02)
    assert threshold.expected_precision > threshold.whole_precision
    assert threshold.coverage_of_observed < threshold.whole_coverage_of_observed


def tally(area_m2, confidence, covering, existing=1.0, once=0.0, twice=0.0):
    """A tally of surface with these confidences (N,); `existing` as a multiple of the true surface that is reachable."""
    area, p = np.array(area_m2, float), np.array(confidence)
    rows = np.round(p * 1000).astype(int)
    sums = (np.bincount(rows, values, 1000).astype(float) for values in (area, area * p, covering))
    return Tally(np.concatenate([*sums, [existing * float((area * p).sum()), once, twice]]))


def test_the_threshold_maximises_the_expected_f_score():
    # Precisions are 0.9, 0.85, 0.7 and recalls 0.5, 0.8, 1 in order: F-scores 0.643, 0.824, 0.824 and less.
    found = tally([1, 1, 1, 10], [0.9, 0.8, 0.4, 0.1], [5, 3, 2, 0]).threshold()
    assert found.min_confidence == 0.8
    assert found.expected_precision == pytest.approx(0.85)
    assert found.coverage_of_observed == pytest.approx(0.8)
    assert found.whole_precision == pytest.approx(3.1 / 13)
    assert found.whole_coverage_of_observed == 1


def test_lower_reachable_recall_keeps_more_surface():
    surface = [1, 1, 1, 10], [0.9, 0.8, 0.4, 0.1], [5, 3, 1, 1]
    half_seen = tally(*surface, once=3.1, twice=1.55)  # an equal area was seen by no scan
    assert half_seen.reachable == pytest.approx(0.5)
    assert tally(*surface, existing=2).reachable == pytest.approx(0.5)
    assert tally(*surface).reachable == 1
    seen, unseen = (tally(*surface, existing=existing).threshold() for existing in (1, 3))
    assert unseen.min_confidence == 0.4 < seen.min_confidence
    assert unseen.coverage_of_observed == pytest.approx(0.9 / 3)


def test_a_tally_sums_areas_by_confidence():
    area_m2, confidence = np.array([2.0, 3, 4, 5]), np.array([0.1, 0.25, 0.9995, 1.0])
    covering, reach, hits = (
        np.array([0.5, 0.2, 0.3, 1]),
        np.array([0.05, 0.5, 1, 1]),
        np.array([1.2, 2, 1, 3]),
    )
    found = Tally.of(area_m2, confidence, covering, reach, hits)
    expected = np.zeros((3, 1000))
    for row, number in zip((100, 250, 999, 999), range(4), strict=True):
        expected[:, row] += area_m2[number] * np.array([1, confidence[number], covering[number]])
    np.testing.assert_allclose(found.sums[:-3], expected.ravel())
    # Unlocated surface is no more than the surface that was found.
    assert found.sums[-3:] == pytest.approx([2 + 1.5 + 4 * 0.9995 + 5, 0.2 + 4 * 0.9995, 0.75])
    assert tally([1], [0.5], [1], once=1.0).reachable == 0  # nothing was seen twice
    assert tally([0], [0.5], [0]).threshold().expected_precision == 0


def test_limits_of_a_mesh():
    assert Limits.of(0.1) == (None, np.inf, 30)
    assert Limits.of(0.05).min_component_triangles == 30
    assert Limits.of(0.2).min_component_triangles == 15
    edges = {"min_confidence": 1, "max_uncertainty": 0, "min_component_triangles": 0}
    assert Limits.of(0.1, **edges) == (1, 0, 0)
    assert Limits.of(0.1, min_confidence=0).min_confidence == 0
