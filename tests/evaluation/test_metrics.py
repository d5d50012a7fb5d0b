# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Metrics against values known in closed form and against a plain computation by the definitions."""

import json
import math

import numpy as np
import pytest
import trimesh
from radarsdf.evaluation import KNNIntensity, format_metrics, holdout, intensity_metrics, surface_metrics
from scipy.spatial import cKDTree


def plane(height=0.0, size=4.0, cells=8, offset=(0.0, 0.0, 0.0)):
    x, y = np.meshgrid(np.linspace(0, size, cells + 1), np.linspace(0, size, cells + 1), indexing="ij")
    vertices = np.stack([x, y, np.full_like(x, height)], axis=-1).reshape(-1, 3) + offset
    i = np.arange((cells + 1) ** 2).reshape(cells + 1, cells + 1)
    a, b, c, d = i[:-1, :-1].ravel(), i[1:, :-1].ravel(), i[1:, 1:].ravel(), i[:-1, 1:].ravel()
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return trimesh.Trimesh(vertices, faces, process=False)


def grid(size=4.0, step=0.02, offset=(0.0, 0.0, 0.0)):
    ticks = np.arange(0, size + step / 2, step)
    x, y = np.meshgrid(ticks, ticks, indexing="ij")
    return np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3) + offset


def by_definition(samples, ground_truth):
    """The metrics from all nearest neighbours at once, written without regard to speed."""
    accuracy = cKDTree(ground_truth).query(samples)[0]
    completion = np.minimum(cKDTree(samples).query(ground_truth)[0], 2.0)
    kept = accuracy[accuracy <= 0.4]
    a, p, c = np.mean(kept < 0.2), np.mean(accuracy < 0.2), np.mean(completion < 0.2)
    return {
        "accuracy_error_m": kept.mean(),
        "accuracy_ratio": a,
        "outlier_ratio": np.mean(accuracy > 0.4),
        "completion_error_m": completion.mean(),
        "completion_ratio": c,
        "f_score": 2 * a * c / (a + c),
        "precision": p,
        "f_score_all": 2 * p * c / (p + c),
    }


@pytest.mark.parametrize("offset", [(0.0, 0.0, 0.0), (5e5, 5.4e6, 120.0)], ids=["local", "UTM"])
@pytest.mark.parametrize(
    ("shift", "right", "outlier_ratio"), [(0.1, 1.0, 0.0), (0.3, 0.0, 0.0), (-0.5, 0.0, 1.0)]
)
def test_shifted_plane(shift, right, outlier_ratio, offset):
    # Lidar lies 2 cm apart: a sample is at most 1.4 cm aside, which lengthens its distance by less than 1 %.
    m = surface_metrics(plane(shift, offset=offset), grid(offset=offset), samples=200_000)
    assert (m["protocol"], m["num_mesh_samples"]) == ("radarsdf-surface-1", 200_000)
    for name in ("accuracy_ratio", "completion_ratio", "precision", "f_score", "f_score_all"):
        assert m[name] == right, name
    assert m["outlier_ratio"] == outlier_ratio
    assert m["completion_error_m"] == pytest.approx(abs(shift), rel=0.01)
    if outlier_ratio == 1:
        assert m["accuracy_error_m"] is None
    else:
        assert m["accuracy_error_m"] == pytest.approx(abs(shift), rel=0.01)


def bumpy():
    mesh = plane(0.0, size=10.0, cells=40)
    x, y, _ = mesh.vertices.T
    return trimesh.Trimesh(
        np.stack([x, y, 0.3 * np.sin(2 * x) * np.cos(y)], axis=1), mesh.faces, process=False
    )


@pytest.mark.parametrize(
    "mesh",
    [bumpy(), trimesh.creation.box((3.0, 2.0, 1.0)), trimesh.creation.torus(2.0, 0.7)],
    ids=["bumpy", "box", "torus"],
)
def test_agrees_with_the_definitions(mesh):
    rng = np.random.default_rng(1)
    truth = trimesh.sample.sample_surface(mesh, 700, seed=2)[0]
    truth = truth[truth[:, 0] > np.median(truth[:, 0]) - 0.5]  # lidar saw only a part
    truth += rng.normal(0, 0.08, truth.shape)
    truth = np.vstack([truth, rng.uniform(-4, 4, (40, 3)) + mesh.bounds.mean(axis=0)])
    samples = trimesh.sample.sample_surface(mesh, 200_000, seed=3)[0]  # another sampler, other samples
    m = surface_metrics(mesh, truth, samples=200_000)
    for name, value in by_definition(samples, truth).items():
        tolerance = {"rel": 0.005} if name.endswith("_m") else {"abs": 0.005}
        assert m[name] == pytest.approx(value, **tolerance), name


def test_box_crops_mesh_and_ground_truth():
    right, wrong = plane(0.1), plane(1.0, offset=(4.0, 0.0, 0.0))
    mesh = trimesh.util.concatenate([right, wrong])
    truth = np.vstack([grid(), grid(offset=(20.0, 0.0, 0.0))])
    box = [[0.0, 0.0, -1.0], [3.9, 4.0, 2.0]]
    m = surface_metrics(mesh, truth, box=box, samples=100_000)
    assert m["accuracy_ratio"] == m["precision"] == m["completion_ratio"] == 1.0
    assert m["num_ground_truth"] == 196 * 201  # the 196 columns at x <= 3.9
    # Triangles across the border are sampled whole: 4 m x 4 m, of which 3.9 m lie inside.
    assert m["num_mesh_samples"] == pytest.approx(100_000 * 3.9 / 4.0, rel=0.01)
    everything = surface_metrics(mesh, truth, samples=100_000)
    assert everything["precision"] == pytest.approx(0.5, abs=0.01)
    assert everything["completion_ratio"] == pytest.approx(0.5, abs=0.01)
    assert everything["num_angles"] > m["num_angles"] > 0


def test_discarding_hides_what_f_score_all_shows():
    mesh = trimesh.util.concatenate([plane(0.1), plane(1.5), plane(3.0), plane(4.5)])
    m = surface_metrics(mesh, grid(step=0.05), samples=100_000)
    assert m["accuracy_ratio"] == m["f_score"] == 1.0
    assert m["outlier_ratio"] == pytest.approx(0.75, abs=0.01)
    assert m["precision"] == pytest.approx(1 - m["outlier_ratio"])
    assert m["f_score_all"] == pytest.approx(2 * 0.25 / 1.25, abs=0.01)


def test_the_same_arguments_give_the_same_numbers():
    truth = bumpy().vertices + 0.1
    one, again = (surface_metrics(bumpy(), truth, samples=20_000) for _ in range(2))
    assert one == again


@pytest.mark.parametrize("flip", [False, True], ids=["wound", "some triangles flipped"])
def test_angles_of_a_cube(flip):
    cube = trimesh.creation.box((1.0, 1.0, 1.0))
    faces = np.array(cube.faces)
    if flip:
        faces[::3] = faces[::3, ::-1]
    m = surface_metrics(trimesh.Trimesh(cube.vertices, faces, process=False), cube.vertices, samples=1000)
    # Twelve right angles and six diagonals of the faces: mean π/3, variance (π/2)² · 2/9.
    assert m["num_angles"] == 18
    assert m["gamma_mean"] == pytest.approx(math.pi / 3)
    assert m["gamma_variance"] == pytest.approx(math.pi**2 / 18)
    assert m["gamma_shape"] == pytest.approx(2.0)


def test_angles_without_a_distribution_are_none_not_nan():
    tilted = plane()
    tilted.apply_transform(trimesh.transformations.rotation_matrix(0.3, [1.0, 2.0, 0.5]))
    tilted.apply_translation((5e5, 5.4e6, 120.0))
    m = surface_metrics(tilted, tilted.vertices, samples=1000)
    assert m["gamma_shape"] is None
    assert m["gamma_mean"] == pytest.approx(0.0, abs=1e-7)
    single = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], process=False)
    m = surface_metrics(single, single.vertices, samples=1000)
    assert (m["gamma_shape"], m["gamma_mean"], m["gamma_variance"], m["num_angles"]) == (None, None, None, 0)
    assert "undefined" in format_metrics(m)
    json.dumps(m, allow_nan=False)


@pytest.mark.parametrize(
    ("mesh", "truth", "kwargs", "message"),
    [
        (trimesh.Trimesh(), grid(step=1.0), {}, "no surface"),
        (plane(), np.zeros((0, 3)), {}, "no ground-truth points"),
        (plane(), grid(step=1.0), {"box": [[9, 9, 9], [10, 10, 10]]}, "points in the box"),
        (plane(9.0), grid(step=1.0), {"box": [[0, 0, -1], [4, 4, 1]]}, "no surface in the box"),
        (plane(), grid(step=1.0)[:, :2], {}, r"ground_truth must be \(N, 3\)"),
        (plane(), np.full((3, 3), np.nan), {}, "finite"),
    ],
)
def test_surface_refuses(mesh, truth, kwargs, message):
    with pytest.raises(ValueError, match=message):
        surface_metrics(mesh, truth, **{"samples": 1000, **kwargs})


def test_intensity_metrics():
    m = intensity_metrics(np.array([60, 70, 80, 90], np.float32), [61.0, 68.0, 80.0, 99.0])
    assert m["mae"] == 3.0
    assert m["medae"] == 1.5
    assert "mean 3.00  median 1.50  (4 returns" in format_metrics(m)
    for predicted, measured in [([1.0], [1.0, 2.0]), ([], []), ([np.nan], [1.0])]:
        with pytest.raises(ValueError, match=r"must both be|finite"):
            intensity_metrics(predicted, measured)


def test_holdout():
    train, test = holdout(24, every=5)
    assert test.tolist() == [0, 5, 10, 15, 20]
    assert sorted([*train, *test]) == list(range(24))
    train, test = holdout(np.array([7, 3, 3, 9, 7, 12]), every=2)  # one per return
    assert (train.tolist(), test.tolist()) == ([7, 12], [3, 9])
    assert holdout(30)[1].tolist() == [0, 10, 20]
    for frames, every in [(24, 1), (1, 10), ([], 10), ([0.5, 1.5], 10)]:
        with pytest.raises(ValueError, match=r"hold out|frame numbers"):
            holdout(frames, every)


def scene(num, rng):
    """Returns from a floor whose intensity is a smooth function of position and of the angle of view."""
    points = np.column_stack([rng.uniform(-5, 5, (num, 2)), np.zeros(num)])
    sensors = np.array([0.0, 0.0, 8.0]) + rng.uniform(-4, 4, (num, 3))
    view = (points - sensors) / np.linalg.norm(points - sensors, axis=1, keepdims=True)
    return points, sensors, 60 + 5 * np.sin(points[:, 0]) + 25 * view[:, 1]


def test_knn_is_the_weighted_mean_of_its_neighbours():
    rng = np.random.default_rng(1)
    points, sensors, intensity = scene(300, rng)
    x, at, _ = scene(20, rng)
    knn = KNNIntensity(points, sensors, intensity, candidates=12, k=5)
    expected = []
    for q, s in zip(x, at, strict=True):
        d = np.linalg.norm(points - q, axis=1)
        near = np.argsort(d)[:12]
        u, v = q - s, points[near] - sensors[near]
        angle = np.arccos(v @ u / np.linalg.norm(v, axis=1) / np.linalg.norm(u))
        best = np.argsort(angle)[:5]
        weight = 1 / ((d[near][best] + 0.1) * (angle[best] + 0.1))
        expected.append(np.average(intensity[near][best], weights=weight))
    np.testing.assert_allclose(knn.predict(x, at), expected, rtol=1e-9)


def test_the_choice_is_that_of_an_inner_hold_out():
    points, sensors, intensity = scene(360, np.random.default_rng(1))
    number = np.repeat(np.arange(6) * 7 - 3, 60)  # any numbers
    test = np.isin(number, holdout(number, 5)[1])
    errors = {}
    for k, candidates in ((4, 4), (8, 8), (16, 16), (16, 64), (16, 128)):  # 240 returns remain
        inner = (a[~test] for a in (points, sensors, intensity))
        predicted = KNNIntensity(*inner, k=k, candidates=candidates).predict(points[test], sensors[test])
        errors[k, candidates] = np.abs(predicted - intensity[test]).mean()
    knn = KNNIntensity.chosen(points, sensors, intensity, number)
    assert (knn.k, knn.candidates) == min(errors, key=errors.get)
    whole = KNNIntensity(points, sensors, intensity, k=knn.k, candidates=knn.candidates)  # of all six scans
    assert (knn.predict(points, sensors + 1) == whole.predict(points, sensors + 1)).all()


def test_knn_with_few_returns_and_bad_input():
    one = KNNIntensity([[1.0, 0.0, 0.0]], [0.0, 0.0, 0.0], [55.0])
    assert one.predict([[9.0, 0.0, 0.0], [1.0, 0.0, 0.0]], [0.0, 0.0, 0.0]).tolist() == [55.0, 55.0]
    assert one.predict(np.zeros((0, 3)), np.zeros((0, 3))).shape == (0,)
    with pytest.raises(ValueError, match="viewing direction"):
        one.predict([[1.0, 0.0, 0.0]], [1.0, 0.0, 0.0])
    with pytest.raises(ValueError, match="at least one return"):
        KNNIntensity(np.zeros((0, 3)), [0.0, 0.0, 0.0], [])
    with pytest.raises(ValueError, match="intensities must be"):
        KNNIntensity([[1.0, 0.0, 0.0]], [0.0, 0.0, 0.0], [55.0, 56.0])
    with pytest.raises(ValueError, match="k <= candidates"):
        KNNIntensity([[1.0, 0.0, 0.0]], [0.0, 0.0, 0.0], [55.0], candidates=4, k=5)
