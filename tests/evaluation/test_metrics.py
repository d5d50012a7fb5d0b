"""Metrics against closed forms and a plain computation by their definitions."""

import json
import math

import numpy as np
import pytest
import trimesh
from radarsdf.evaluation import (
    KNNIntensity,
    confidence_metrics,
    format_metrics,
    holdout,
    intensity_metrics,
    surface_metrics,
    trajectory_metrics,
    uncertainty_metrics,
)
from radarsdf.poses.rigid import moved
from radarsdf.simulate import drifted
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from ..poses.drift import trajectory


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
    """The metrics from all nearest neighbours, without regard to speed."""
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
    # Lidar points are 2 cm apart: a lateral offset of at most 1.4 cm adds less than 1 % to distances.
    m = surface_metrics(plane(shift, offset=offset), grid(offset=offset), samples=50_000)
    assert (m["protocol"], m["num_mesh_samples"]) == ("radarsdf-surface-1", 50_000)
    for name in ("accuracy_ratio", "completion_ratio", "precision", "f_score", "f_score_all"):
        assert m[name] == right, name
    assert m["outlier_ratio"] == outlier_ratio
    assert m["completion_error_m"] == pytest.approx(abs(shift), rel=0.01)
    inlier_m = None if outlier_ratio == 1 else pytest.approx(abs(shift), rel=0.01)
    assert m["accuracy_error_m"] == inlier_m


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
    truth = truth[truth[:, 0] > np.median(truth[:, 0]) - 0.5]  # partial ground truth
    truth += rng.normal(0, 0.08, truth.shape)
    truth = np.vstack([truth, rng.uniform(-4, 4, (40, 3)) + mesh.bounds.mean(axis=0)])
    samples = trimesh.sample.sample_surface(mesh, 200_000, seed=3)[0]  # an independent sampler
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
        (plane(9.0), grid(step=1.0), {"box": [[0, 0, -1], [4, 4, 1]]}, "no surface in the box"),
        (plane(), grid(step=1.0)[:, :2], {}, r"ground_truth must be \(N, 3\)"),
        (plane(), np.full((3, 3), np.nan), {}, "finite"),
    ],
)
def test_wrong_arguments_of_surface_are_rejected(mesh, truth, kwargs, message):
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
    """Returns from a floor with an intensity that is smooth in position and viewing angle."""
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


def test_the_number_of_neighbours_is_chosen_by_an_inner_hold_out():
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


WHOLE = moved(np.eye(4)[None], np.array([[30.0, -20, 10, 0.4, -0.3, 2.1]]))[0]


def test_the_same_trajectory_in_another_frame_has_no_error():
    true = trajectory(50)
    for align in ("positions", "poses"):
        metrics = trajectory_metrics(WHOLE @ true, true, align=align)
        errors = {n: metrics[n] for n in metrics if n.startswith(("absolute_", "step_", "relative_"))}
        assert errors == pytest.approx(dict.fromkeys(errors, 0), abs=1e-6)
        assert len(errors) == 6
    assert trajectory_metrics(WHOLE @ true, true, align="none")["absolute_m"] > 10


def test_errors_of_a_too_sharp_turn_grow_with_the_segment_length():
    true = np.tile(np.eye(4), (101, 1, 1))
    true[:, 0, 3] = np.arange(101)
    found = drifted(true, 0, 0, 0, yaw_rad=0.001)
    metrics = trajectory_metrics(found, true, align="none")
    assert metrics["step_rad"] == pytest.approx(0.001)
    assert metrics["step_m"] == pytest.approx(0, abs=1e-9)
    assert metrics["relative_rad_per_m"] == pytest.approx(0.001)
    # Lateral errors of arcs: half of the angle, 5 to 25 thousandths of 10 to 50 m; 91 to 51 segments of each.
    counts, angles = np.arange(91, 50, -10), 0.001 * np.arange(10, 51, 10) / 2 - 0.0005
    assert metrics["relative_ratio"] == pytest.approx(counts @ angles / counts.sum(), rel=0.02)
    assert metrics["length_m"] == pytest.approx(100)


def test_errors_of_a_drift_are_root_mean_squares():
    true = trajectory(200)
    found = drifted(true, 0.03, 0.004, 7)
    metrics = trajectory_metrics(found, true, align="none")
    apart, steps = np.linalg.inv(true) @ found, [np.linalg.inv(p[:-1]) @ p[1:] for p in (true, found)]
    for name, errors in (("absolute", apart), ("step", np.linalg.inv(steps[0]) @ steps[1])):
        angles = Rotation.from_matrix(errors[:, :3, :3]).magnitude()
        assert metrics[f"{name}_m"] == pytest.approx(np.sqrt((errors[:, :3, 3] ** 2).sum(axis=1).mean()))
        assert metrics[f"{name}_rad"] == pytest.approx(np.sqrt((angles**2).mean()))
    brought = trajectory_metrics(WHOLE @ found, true)["absolute_m"]
    assert brought == pytest.approx(trajectory_metrics(found, true)["absolute_m"])
    assert brought < metrics["absolute_m"]


def drawn(count=100_000, seed=0):
    """Uncertainties from 1 cm to 1 m, and errors with these standard deviations."""
    rng = np.random.default_rng(seed)
    uncertainty_m = 10 ** rng.uniform(-2, 0, count)
    return uncertainty_m * rng.standard_normal(count), uncertainty_m


def test_perfect_uncertainties():
    error_m, uncertainty_m = drawn()
    m = uncertainty_metrics(error_m, uncertainty_m)
    assert m["coverage_68"] == pytest.approx(0.68, abs=0.005)
    assert m["coverage_95"] == pytest.approx(0.95, abs=0.005)
    assert m["ence"] < 0.02
    assert m["z_rms"] == pytest.approx(1, abs=0.01)
    assert m["worst_decile_factor"] < 1.03
    assert (m["num_points"], m["num_unknown"]) == (100_000, 0)


@pytest.mark.parametrize(("factor", "ence"), [(2.0, 1.0), (0.5, 0.5)], ids=["overconfident", "too careful"])
def test_uncertainties_wrong_by_a_factor_of_two(factor, ence):
    error_m, uncertainty_m = drawn()
    m = uncertainty_metrics(error_m, uncertainty_m / factor)
    assert m["ence"] == pytest.approx(ence, abs=0.02)
    assert m["z_rms"] == pytest.approx(factor, rel=0.01)
    assert m["worst_decile_factor"] == pytest.approx(2, rel=0.03)
    # A Gaussian has 67.3 % within 1.96 / 2 standard deviations, and 99.99 % within 1.96 · 2.
    assert m["coverage_95"] == pytest.approx(math.erf(1.959964 / factor / math.sqrt(2)), abs=0.005)


def test_perfect_confidences():
    rng = np.random.default_rng(0)
    confidence = rng.random(100_000)
    m = confidence_metrics(confidence, rng.random(100_000) < confidence)
    assert sum(m["bin_count"]) == 100_000
    np.testing.assert_allclose(m["bin_confidence"], np.arange(0.05, 1, 0.1), atol=0.005)
    np.testing.assert_allclose(m["bin_true_share"], m["bin_confidence"], atol=0.02)
    assert m["worst_gap"] < 0.02
    assert m["mean_gap"] < 0.01
    assert m["auc"] == pytest.approx(5 / 6, abs=0.005)
    assert m["true_share"] == pytest.approx(0.5, abs=0.01)


def test_auc_agrees_with_all_pairs():
    rng = np.random.default_rng(0)
    confidence, truth = np.round(rng.random(200), 1), rng.random(200) < 0.4
    a, b = confidence[truth][:, None], confidence[~truth]
    assert confidence_metrics(confidence, truth)["auc"] == pytest.approx(np.mean((a > b) + 0.5 * (a == b)))
    assert confidence_metrics(confidence, np.ones(200, bool))["auc"] is None
