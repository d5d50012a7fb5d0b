"""Probabilities of changes against numerical integrals, random draws, and brute-force searches."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from radarsdf.changes.changes import (
    APPEARED,
    GONE,
    MOVED,
    REFLECTANCE_CHANGED,
    SAME,
    UNSEEN,
    ChangedSurface,
    Changes,
    _classify,
    areas_of,
)
from radarsdf.changes.probability import (
    Differences,
    Errors,
    PlaceEvidence,
    Side,
    _free_space_odds,
    _Means,
    odds_of_differences,
    posterior,
    share_of_changes,
)
from scipy.integrate import quad
from scipy.stats import beta, norm
from scipy.stats import t as student


def test_odds_and_the_estimated_share_of_changes():
    rng = np.random.default_rng(0)
    sigma, reach = rng.uniform(0.5, 2, 20_000), 30.0
    changed = rng.random(20_000) < 0.1
    differences = np.where(changed, rng.uniform(-reach, reach, 20_000), rng.normal(0, sigma))
    odds = odds_of_differences(differences, sigma, reach)
    assert_allclose(odds, np.log(1 / (2 * reach)) - norm.logpdf(differences, 0, sigma))
    share = share_of_changes(odds)
    assert share == pytest.approx(0.1, abs=0.01)
    assert_allclose(posterior(odds, 0.1), 1 / (1 + np.exp(-odds) * 0.9 / 0.1))
    assert share_of_changes(odds[~changed]) < 0.002
    assert share_of_changes(odds[:0]) == 1e-6
    assert share_of_changes(np.full(9, 30.0)) == 0.5


def test_free_space_crossings_are_beta_binomial():
    own = SimpleNamespace(hits=np.array([10.0, 4, 2]), passes=np.array([0.0, 6, 16]))
    other = SimpleNamespace(hits=np.array([0.0, 1, 8]), passes=np.array([6.0, 19, 0]))

    def evidence(hits, passes, of):
        return quad(lambda p: p**hits * (1 - p) ** passes * of.pdf(p), 0, 1, limit=500)[0]

    for i, found in enumerate(_free_space_odds(own, other)):
        hits, passes = other.hits[i] / 2, other.passes[i] / 2  # of scans: in two cells each
        same = evidence(hits, passes, beta(own.hits[i] / 2 + 0.5, own.passes[i] / 2 + 0.5))
        expected = np.log(evidence(hits, passes, beta(0.5, 0.5)) / same)
        # More hits: no change.
        assert found == pytest.approx(min(expected, 0) if i == 2 else expected, abs=1e-3)


def evidence(distance_m, normals=None, confidence=1.0):
    count = len(distance_m)
    normals = np.tile([0.0, 0, 1], (count, 1)) if normals is None else np.asarray(normals, float)
    none = np.zeros(count)
    return PlaceEvidence(np.asarray(distance_m, float), normals, none, none + confidence, none, none)


def side(distance_m, sigma_m, **other):
    distance_m = np.asarray(distance_m, float)
    vertices = np.zeros((len(distance_m), 3))
    own = evidence(0 * distance_m)
    return Side(
        vertices, np.zeros((0, 3), np.int32), own, evidence(distance_m, **other), np.asarray(sigma_m), 0.4
    )


def test_odds_of_distances_are_ratios_of_their_densities():
    errors = Errors(3.0, 1.4)
    distances, sigmas = [0.02, -0.1, 0.3, np.nan, 0.2], [0.02, 0.03, 0.05, 0.1, np.nan]
    absent, shifted, _ = errors.log_odds(side(distances, sigmas))
    for i in range(3):
        scaled = student(3.0, scale=1.4 * sigmas[i])

        def mean_density(lower_m, d=distances[i], of=scaled):
            found, _ = quad(lambda at: of.pdf(d - at), lower_m, 0.4, points=[max(d, lower_m)])
            return found / (0.4 - lower_m)

        same = scaled.pdf(distances[i])
        assert absent[i] == pytest.approx(np.log(mean_density(0.0) / same), rel=1e-6)
        assert shifted[i] == pytest.approx(np.log(mean_density(-0.4) / same), rel=1e-6)
    assert absent[3:].tolist() == [0, 0]  # without rays, nothing is known
    assert np.isneginf(shifted[3:]).all()


def test_evidence_adds_up_over_a_region():
    """A few crossings of one place leave a change undecided, but those of 3 x 3 m of wall together show it."""
    y, z = (axis.ravel() for axis in np.indices((101, 101)) * 0.1 + 0.05)
    corner = np.arange(101**2).reshape(101, 101)[:-1, :-1].reshape(-1, 1)
    faces = np.concatenate([corner + [0, 1, 101], corner + [1, 102, 101]]).astype(np.int32)
    hole = (np.abs(y - 5) < 1.5) & (np.abs(z - 5) < 1.5)
    own = dataclasses.replace(evidence(0 * y, np.tile([1.0, 0, 0], (len(y), 1))), hits=0 * y + 6)
    other = dataclasses.replace(own, distance_m=np.where(hole, np.nan, 0), hits=np.where(hole, 0, 6.0))
    other = dataclasses.replace(other, passes=np.where(hole, 4.0, 0))
    wall = Side(np.stack([0 * y, y, z], axis=1), faces, own, other, 0 * y + 0.03, 0.4)
    odds = Errors(3.0, 1.0).log_odds(wall)
    assert posterior(odds[0], share_of_changes(odds[0])).max() < 0.01
    gone = _classify(wall, odds, share_of_changes(odds[2]), GONE).kind == GONE
    assert gone[hole].mean() > 0.9
    assert not gone[~hole].any()


def test_errors_of_distances_are_estimated_despite_changes():
    rng = np.random.default_rng(1)
    sigmas = rng.uniform(0.005, 0.01, 20_000)
    distances = np.where(
        rng.random(20_000) < 0.05, rng.uniform(-0.4, 0.4, 20_000), 2 * sigmas * rng.standard_t(4, 20_000)
    )
    found = Errors.of([side(distances[:9000], sigmas[:9000]), side(distances[9000:], sigmas[9000:])])
    assert found.scale == 2.0
    assert 3 <= found.freedom <= 6
    assert Errors.of([side([np.nan], [0.1])]) == Errors(30.0, 1.0)


@pytest.mark.parametrize(
    ("distance_m", "tilted", "absent", "shifted", "kind"),
    [
        (0.0, False, -5, -5, SAME),
        (np.nan, False, -5, 5, UNSEEN),
        (np.nan, False, 5, 5, GONE),
        (0.3, False, 5, -5, GONE),
        (0.3, False, -5, 5, SAME),  # nothing passed where it was
        (0.3, False, 5, 5, MOVED),
        (0.3, True, 5, 5, GONE),
        (-0.3, False, -5, 5, MOVED),
        (-0.3, True, -5, 5, UNSEEN),
        (-0.3, True, -5, -5, SAME),
        (-0.3, False, 5, -5, SAME),  # hidden: rays do not show it
    ],
)
def test_kinds_of_changes(distance_m, tilted, absent, shifted, kind):
    normals = [[0.8, 0, 0.6]] if tilted else None
    of_side = side([distance_m], [0.01], normals=normals)
    odds = tuple(np.array([value], float) for value in (absent, shifted, np.inf))
    for lost, sign in ((GONE, -1), (APPEARED, 1)):
        found = _classify(of_side, odds, 0.5, lost)
        assert found.kind[0] == (lost if kind == GONE else kind)
        assert_allclose(found.moved_m[0], sign * distance_m if kind == MOVED else np.nan)
        of_moved = shifted if distance_m < 0 else max(absent, shifted)
        probable = of_moved if kind == MOVED else absent
        assert found.probability[0] == pytest.approx(1 / (1 + np.exp(-probable)))
    # Surfaces of low probability have not changed.
    unsure = dataclasses.replace(
        of_side, own=evidence([0.0], confidence=0.4), other=evidence([distance_m], normals)
    )
    assert _classify(unsure, odds, 0.5, GONE).kind[0] in (SAME, UNSEEN)


def test_reflectance_changes_only_if_all_views_agree():
    """Nine views of five places: equal, stronger, stronger but contradictory, contradictory on a day, near a change."""
    rng = np.random.default_rng(3)
    places = 10.0 * np.arange(5)[:, None] * [1, 0, 0]
    points = np.repeat(places, 9, axis=0)
    noise = rng.normal(0, 1, (5, 9))
    values = noise + np.array([0, 6, 6, 6, 6])[:, None]
    values[2] += np.tile([-12, 0, 12], 3)
    of_day = noise.copy()
    of_day[3] += np.tile([-12, 0, 12], 3)
    between, day = (_Means(points, v.ravel(), np.ones(45)) for v in (values, of_day))
    differences = Differences(between, [day, day], 0.0, 0.6, 40.0)
    same = np.ones(5, bool)
    change, probability = differences.probability(places, same, places[4:] + 0.3)
    assert_allclose(change, [*values[:4].mean(axis=1), np.nan])
    assert probability[1] > 0.99
    assert (probability[[0, 2, 3]] < 0.5).all()
    assert probability[4] == 0
    same[1] = False
    assert differences.probability(places, same, np.zeros((0, 3)))[1][1] == 0
    assert np.isfinite(differences.probability(places, same, np.zeros((0, 3)))[0][4])


def squares(*kinds):
    """Disjoint squares of 1, 2, 3 m and so on, with consecutive vertices."""
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    vertices = np.concatenate([corners * (i + 1) + [0, 0, i] for i in range(len(kinds))])
    faces = np.concatenate([np.array([[0, 1, 2], [0, 2, 3]]) + 4 * i for i in range(len(kinds))])
    kind, numbers = np.repeat(np.array(kinds, np.int8), 4), np.arange(len(vertices), dtype=np.float32)
    return ChangedSurface(vertices, faces.astype(np.int32), kind, numbers / 100, numbers - 2, 8 - numbers)


def test_regions_areas_and_colours_of_changes():
    before, after = squares(GONE, SAME, MOVED), squares(MOVED, UNSEEN, REFLECTANCE_CHANGED, APPEARED)
    before.moved_m[8] = np.nan  # unknown for some vertices
    before.kind[4] = GONE  # one vertex of four
    after.kind[12] = SAME  # the first vertex of both triangles; the other two decide
    changes = Changes(before, after, np.eye(4), {})
    found = [(r.kind, r.area_m2, r.probability, r.moved_m, r.intensity_change) for r in changes.regions()]
    expected = [
        ("appeared", 16, 0.135, None, None),
        ("moved", 9, 0.095, 8, None),
        ("reflectance_changed", 9, 0.095, None, -1.5),
        ("gone", 1, 0.015, None, None),
        ("moved", 1, 0.015, -0.5, None),
    ]
    for one, other in zip(found, expected, strict=True):
        assert one == tuple(v if v is None or isinstance(v, str) else pytest.approx(v) for v in other)
    assert_array_equal(changes.regions()[0].box, [[0, 0, 3], [4, 4, 3]])
    assert len(changes.regions(9.0)) == 3
    words = [region.words for region in changes.regions()]
    assert words[1:3] == ["moved by 8.00 m", "reflectance_changed, 1.5 weaker"]
    assert words[4] == "moved by 0.50 m"
    louder = dataclasses.replace(changes.regions()[2], intensity_change=0.5)
    assert louder.words == "reflectance_changed, 0.5 stronger"
    report = areas_of(before, after)
    assert report["areas_m2"] == pytest.approx(
        {"appeared": 16, "gone": 1, "moved": 10, "reflectance_changed": 9}
    )
    assert report["compared_m2"] == pytest.approx(1 + 4 + 9 + 1 + 9 + 16)
    mesh = changes.mesh()
    assert_array_equal(
        mesh.vertices, np.concatenate([after.vertices, before.vertices[[0, 1, 2, 3, 8, 9, 10, 11]]])
    )
    assert_array_equal(mesh.faces[8:], [[16, 17, 18], [16, 18, 19], [20, 21, 22], [20, 22, 23]])
    green, purple = (mesh.visual.vertex_colors[row, :3].tolist() for row in (13, 8))
    assert (green, purple) == ([0, 158, 115], [204, 121, 167])
