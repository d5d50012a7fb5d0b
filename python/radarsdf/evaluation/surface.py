"""Errors of a mesh against lidar points: accuracy, completion, F-score and smoothness; metrics as text."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from radarsdf.arrays import ArrayLike, Bools, Floats, Ints, Mesh
from radarsdf.checks import check, check_box, positions, whole_number
from radarsdf.core import cell_keys
from radarsdf.threads import resolve_num_threads

PROTOCOL = "radarsdf-surface-1"  # changes with the meaning of a number

# As in the paper: largest distance of a correct point, and of an inlier; cap on the distances of ground-truth points.
_THRESHOLD_M, _OUTLIER_M, _TRUNCATION_M = 0.2, 0.4, 2.0
_CHUNK = 500_000  # samples at a time, to limit memory; the protocol's random numbers depend on it
_ANGLE_NOISE_RAD = 1e-7  # rounding of an angle: 1e-9 m of a UTM northing in float64 over an edge of 1 cm


def surface_metrics(
    mesh: Mesh,
    ground_truth: ArrayLike,
    *,
    box: ArrayLike | None = None,
    samples: int = 10_000_000,
) -> dict[str, Any]:
    """Compute the errors of a mesh against ground-truth points by the paper's definitions.

    Parameters
    ----------
    mesh : trimesh.Trimesh
        The surface, world frame, m, of any orientation. For the angles, neighbouring triangles must share vertices.
    ground_truth : (M, 3) array_like
        Lidar points, world frame, m. Accuracy and completion use the same points.
    box : (2, 3) array_like, optional
        Lower and upper corner, world frame, m. Mesh samples and ground truth outside it are ignored. None uses
        everything, which is rarely fair: radar and lidar have different ranges.
    samples : int
        Points drawn uniformly by area on triangles whose bounds touch the box; `num_mesh_samples` of them lie in it.

    Returns
    -------
    dict of str to float
        - `accuracy_error_m`: mean distance from a mesh sample to the ground truth, over the samples within `outlier_m`,
          0.4 m; None without any. `accuracy_ratio`: share *of these* below `threshold_m`, 0.2 m; 0 without any.
          `outlier_ratio`: share of the samples that were left out.
        - `completion_error_m`: mean distance from a ground-truth point to the nearest mesh sample, at most
          `truncation_m`, 2 m. `completion_ratio`: share below `threshold_m`.
        - `f_score`: harmonic mean of `accuracy_ratio` and `completion_ratio`, as in the paper. It does not penalise
          surface in free space, whose samples are left out as outliers.
        - `precision`: share of *all* samples below `threshold_m`. `f_score_all`: harmonic mean of `precision` and
          `completion_ratio`, which does penalise it.
        - `gamma_mean`, `gamma_variance`: of the angles, rad and rad², between the two triangles at each edge whose
          midpoint is in the box, `num_angles` in all. `gamma_shape`: mean² / variance, that of a Gamma distribution by
          the method of moments, as in all rows of the paper's table. None without an angle or variance.
        - `protocol` and counts. The same arguments give the same numbers.

    Raises
    ------
    ValueError
        If the mesh has no area or the ground truth no point in the box, or an argument has a wrong shape or is not finite.
    TypeError
        If `mesh` has no vertices and faces.

    Notes
    -----
    The completion measures distances to samples, not to triangles. Even a perfect mesh has a completion error of half
    the spacing of the samples, 0.5 · sqrt(area / samples): 5 mm for 1e7 on 1000 m². Compare meshes at equal `samples`.
    """
    whole_number(samples, "samples", 1)
    corners = np.array([[-np.inf] * 3, [np.inf] * 3]) if box is None else check_box(box)
    in_the_box = "" if box is None else " in the box"
    points = positions(ground_truth, "ground_truth")
    points = points[_in_box(points, corners)]
    check(len(points), f"there are no ground-truth points{in_the_box}")
    vertices, faces = _triangles(mesh)
    # From here on relative to the mean: differences of large coordinates would lose precision.
    origin = points.mean(axis=0)
    points, vertices, corners = points - origin, vertices - origin, corners - origin

    workers = resolve_num_threads(0)
    tree = cKDTree(points)
    completion = np.full(len(points), _TRUNCATION_M)
    total = kept = right = 0
    kept_sum = 0.0
    for block in _sample_blocks(vertices, faces, corners, samples):
        # The search finds distances strictly below its bound, and a sample exactly at the limit is an inlier.
        limit_m = np.nextafter(_OUTLIER_M, np.inf)
        distance, _ = tree.query(block, distance_upper_bound=limit_m, workers=workers)
        inliers = distance[np.isfinite(distance)]
        total += len(block)
        kept += len(inliers)
        kept_sum += float(inliers.sum())
        right += int(np.count_nonzero(inliers < _THRESHOLD_M))
        _shorten(completion, points, block, workers)
    check(total, f"the mesh has no surface{in_the_box}")

    accuracy_ratio, precision = right / kept if kept else 0.0, right / total
    completion_ratio = float(np.mean(completion < _THRESHOLD_M))
    angles = _angles(vertices, faces, corners)
    shape = mean = variance = None
    if len(angles):
        mean, variance = float(angles.mean()), float(angles.var())
        shape = mean**2 / variance if variance > _ANGLE_NOISE_RAD**2 else None
    return {
        "protocol": PROTOCOL,
        "accuracy_error_m": kept_sum / kept if kept else None,
        "accuracy_ratio": accuracy_ratio,
        "outlier_ratio": 1.0 - kept / total,
        "completion_error_m": float(completion.mean()),
        "completion_ratio": completion_ratio,
        "f_score": _harmonic_mean(accuracy_ratio, completion_ratio),
        "precision": precision,
        "f_score_all": _harmonic_mean(precision, completion_ratio),
        "gamma_shape": shape,
        "gamma_mean": mean,
        "gamma_variance": variance,
        "num_mesh_samples": total,
        "num_ground_truth": len(points),
        "num_angles": len(angles),
        "threshold_m": _THRESHOLD_M,
        "outlier_m": _OUTLIER_M,
        "truncation_m": _TRUNCATION_M,
    }


def format_metrics(metrics: Mapping[str, Any]) -> str:
    """Format the result of `surface_metrics` or `intensity_metrics` as a few aligned lines of text.

    Surface errors are in centimetres and ratios in percent, as in the paper's tables; intensity errors are in sensor units.
    """
    if "mae" in metrics:
        count = f"({metrics['num_returns']} returns, {metrics['protocol']})"
        return f"intensity error  mean {metrics['mae']:.2f}  median {metrics['medae']:.2f}  {count}"

    def shown(name: str, unit: str = " %", factor: float = 100.0, digits: int = 2) -> str:
        value = metrics[name]
        return "undefined" if value is None else f"{value * factor:.{digits}f}{unit}"

    rows = {
        "accuracy": f"error {shown('accuracy_error_m', ' cm')}  ratio {shown('accuracy_ratio')}"
        f"  outliers beyond {metrics['outlier_m']:g} m {shown('outlier_ratio')}",
        "completion": f"error {shown('completion_error_m', ' cm')}  ratio {shown('completion_ratio')}",
        "F-score": f"{shown('f_score')}  with nothing discarded {shown('f_score_all')} (precision {shown('precision')})",
        "angles": f"gamma shape {shown('gamma_shape', '', 1)}  mean {shown('gamma_mean', ' rad', 1, 3)}"
        f"  variance {shown('gamma_variance', ' rad²', 1, 3)}",
        "protocol": f"{metrics['protocol']}  threshold {metrics['threshold_m']:g} m  {metrics['num_mesh_samples']} mesh"
        f" samples and {metrics['num_ground_truth']} ground-truth points",
    }
    return "\n".join(f"{name:<12}{text}" for name, text in rows.items())


def _harmonic_mean(a: float, b: float) -> float:
    return 2.0 * a * b / (a + b) if a + b > 0 else 0.0


def _triangles(mesh: Mesh) -> tuple[Floats, Ints]:
    """Vertices (V, 3), world, m, and faces (F, 3) of a mesh of any program."""
    is_mesh = hasattr(mesh, "vertices") and hasattr(mesh, "faces")
    check(is_mesh, f"mesh must have vertices and faces, not be {mesh!r:.50}", TypeError)
    vertices, faces = positions(mesh.vertices, "mesh.vertices"), np.asarray(mesh.faces)
    shaped = faces.dtype.kind in "iu" and faces.shape[1:] == (3,)
    fits = faces.size == 0 or (shaped and 0 <= faces.min() <= faces.max() < len(vertices))
    rows = f"rows of the {len(vertices)} vertices"
    check(fits, f"mesh.faces must be (F, 3) {rows}, not {faces.shape} {faces.dtype}")
    return vertices, faces.reshape(-1, 3).astype(np.int64)


def _in_box(points: Floats, corners: Floats) -> Bools:
    return ((points >= corners[0]) & (points <= corners[1])).all(axis=1)


def _sample_blocks(vertices: Floats, faces: Ints, corners: Floats, samples: int) -> Iterator[Floats]:
    """Sample uniformly by area, in blocks of neighbouring triangles, so that searches stay in cache."""
    rng = np.random.default_rng(0)
    x = vertices[faces]
    faces = faces[((x.max(axis=1) >= corners[0]) & (x.min(axis=1) <= corners[1])).all(axis=1)]
    if len(faces) == 0:
        return
    # Sorted along a Morton curve with ten bits per axis.
    middle = vertices[faces].mean(axis=1)
    middle -= middle.min(axis=0)
    faces = faces[np.argsort(cell_keys(middle, max(float(middle.max()), 1e-9) / 1023), kind="stable")]
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    if area.sum() == 0:
        return
    # Samples per triangle, distributed as if they were drawn one by one.
    last = np.cumsum(rng.multinomial(samples, area / area.sum()))
    for start in range(0, samples, _CHUNK):
        index = np.searchsorted(last, np.arange(start, min(start + _CHUNK, samples)), side="right")
        u, v = rng.random((2, len(index), 1))
        root = np.sqrt(u)
        block = (1.0 - root) * a[index] + root * ((1.0 - v) * b[index] + v * c[index])
        block = block[_in_box(block, corners)]
        if len(block):
            yield block


def _shorten(shortest: Floats, points: Floats, block: Floats, workers: int) -> None:
    """Update `shortest` (M,), the distances of points to all samples so far, with the samples of `block`."""
    low, high = block.min(axis=0), block.max(axis=0)
    gap = np.linalg.norm(np.maximum(np.maximum(low - points, points - high), 0.0), axis=1)
    candidates = np.flatnonzero(gap < shortest)
    if len(candidates) == 0:
        return
    tree = cKDTree(block, balanced_tree=False)
    known = shortest[candidates]
    distance, _ = tree.query(points[candidates], distance_upper_bound=known.max(), workers=workers)
    shortest[candidates] = np.minimum(known, distance)


def _angles(vertices: Floats, faces: Ints, corners: Floats) -> Floats:
    """Angles (E,) between the triangles of each edge with two: 0 in a plane, π where one is folded onto the other."""
    from trimesh.graph import face_adjacency  # noqa: PLC0415 - slow to import

    a, b, c = (vertices[faces[:, i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    has_area = np.linalg.norm(normals, axis=1) > 0  # a degenerate triangle has no direction
    faces, normals = faces[has_area], normals[has_area]
    pairs, edges = face_adjacency(faces, return_edges=True)  # type: ignore[no-untyped-call]
    inside = _in_box(vertices[edges].mean(axis=1), corners)
    pairs, edges = pairs[inside], edges[inside]
    # Triangles of the same orientation traverse their common edge in opposite directions. Otherwise flip one normal.
    forward = [
        ((faces[own] == edges[:, :1]) & (np.roll(faces[own], -1, axis=1) == edges[:, 1:])).any(axis=1)
        for own in pairs.T
    ]
    m, n = normals[pairs[:, 0]], normals[pairs[:, 1]]
    n[forward[0] == forward[1]] *= -1
    sine, cosine = np.linalg.norm(np.cross(m, n), axis=1), np.einsum("ij,ij->i", m, n)
    return np.asarray(np.arctan2(sine, cosine), dtype=np.float64)
