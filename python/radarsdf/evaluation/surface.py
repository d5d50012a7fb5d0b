# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Errors of a mesh against lidar points: accuracy, completion, F-score and smoothness; metrics as text."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from typing import TYPE_CHECKING, TypedDict, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from radarsdf._core import cell_keys
from radarsdf.checks import check_box, positions, positive, real_array, whole_number
from radarsdf.threads import resolve_num_threads

from .intensity import IntensityMetrics

if TYPE_CHECKING:
    import trimesh

PROTOCOL = "radarsdf-surface-1"  # changes when the meaning of a number changes

_CHUNK = 500_000  # samples at a time. Bounds the memory; the protocol's random numbers depend on it
_ANGLE_NOISE_RAD = 1e-7  # rounding of an angle: 1e-9 m of a UTM northing in float64 over an edge of 1 cm
_Points = NDArray[np.float64]


class SurfaceMetrics(TypedDict):
    """Result of `surface_metrics`: errors in metres, ratios in [0, 1], angles in radians."""

    protocol: str
    accuracy_error_m: float | None
    accuracy_ratio: float
    outlier_ratio: float
    completion_error_m: float
    completion_ratio: float
    f_score: float
    precision: float
    f_score_all: float
    gamma_shape: float | None
    gamma_mean: float | None
    gamma_variance: float | None
    num_mesh_samples: int
    num_ground_truth: int
    num_angles: int
    ground_truth_sha256: str
    samples: int
    seed: int
    threshold_m: float
    outlier_m: float
    truncation_m: float
    box: list[list[float]] | None


def surface_metrics(
    mesh: trimesh.Trimesh,
    ground_truth: ArrayLike,
    *,
    box: ArrayLike | None = None,
    samples: int = 10_000_000,
    seed: int = 0,
    threshold_m: float = 0.2,
    outlier_m: float = 0.4,
    truncation_m: float = 2.0,
    num_threads: int = 0,
) -> SurfaceMetrics:
    """Compute the errors of a mesh against ground-truth points by the paper's definitions.

    Parameters
    ----------
    mesh : trimesh.Trimesh
        The surface, world frame, m. Its orientation does not matter. For the angles, neighbouring triangles must share
        vertices.
    ground_truth : (M, 3) array_like
        Lidar points, world frame, m. Accuracy and completion use the same points.
    box : (2, 3) array_like, optional
        Lower and upper corner, world frame, m. Mesh samples and ground truth outside it do not count. None takes
        everything, which is rarely fair: radar and lidar have different ranges.
    samples : int
        Points drawn uniformly by area on the triangles whose bounds touch the box. Those outside the box are then
        dropped; `num_mesh_samples` remain.
    seed : int
        Seed of the samples. The same arguments give the same numbers, with any `num_threads`.
    threshold_m : float
        A point nearer than this counts as correct.
    outlier_m : float
        The accuracy leaves out mesh samples farther than this from the ground truth.
    truncation_m : float
        A ground-truth point farther than this from the mesh counts with this distance.
    num_threads : int
        Threads of the nearest-neighbour search; 0 means as many as PyTorch uses.

    Returns
    -------
    SurfaceMetrics
        - `accuracy_error_m`: mean distance from a mesh sample to the ground truth, over the samples within `outlier_m`;
          None without any. `accuracy_ratio`: share *of these* below `threshold_m`, 0 without any. `outlier_ratio`:
          share of the samples that were left out.
        - `completion_error_m`: mean truncated distance from a ground-truth point to the nearest mesh sample.
          `completion_ratio`: share below `threshold_m`.
        - `f_score`: harmonic mean of `accuracy_ratio` and `completion_ratio`, as in the paper. It does not punish
          surface in free space, whose samples are left out as outliers.
        - `precision`: share of *all* samples below `threshold_m`. `f_score_all`: harmonic mean of `precision` and
          `completion_ratio`, which does punish it.
        - `gamma_shape`, `gamma_mean`, `gamma_variance`: see `gamma_from_moments`, over the `num_angles` edges that
          have two triangles and their midpoint in the box.
        - `protocol`, the arguments, the counts, and a hash of the ground truth in the box as float64.

    Raises
    ------
    ValueError
        If the mesh has no area or the ground truth no point in the box, or an argument has a wrong shape, is not finite
        or not positive.

    Notes
    -----
    The completion measures distances to samples, not to triangles. Even a perfect mesh has a completion error of half
    the spacing of the samples, 0.5 · sqrt(area / samples): 5 mm for 1e7 samples on 1000 m². Compare meshes at equal
    `samples`.
    """
    whole_number(samples, "samples", 1)
    for name, value in (
        ("threshold_m", threshold_m),
        ("outlier_m", outlier_m),
        ("truncation_m", truncation_m),
    ):
        positive(value, name)
    seed, num_threads = whole_number(seed, "seed", 0), whole_number(num_threads, "num_threads", 0)
    corners = None if box is None else check_box(box)
    in_the_box = "" if corners is None else " in the box"
    points = _in_box(positions(ground_truth, "ground_truth"), corners)
    if len(points) == 0:
        msg = f"there are no ground-truth points{in_the_box}"
        raise ValueError(msg)
    digest = hashlib.sha256(points.tobytes()).hexdigest()
    # From here on relative to the mean: differences of large coordinates would lose digits.
    origin = points.mean(axis=0)
    points = points - origin
    vertices, faces = _triangles(mesh)
    vertices = vertices - origin
    if corners is not None:
        corners = corners - origin

    workers = resolve_num_threads(num_threads)
    reach = max(outlier_m, threshold_m)
    tree = cKDTree(points)
    completion = np.full(len(points), float(truncation_m))
    total = kept = right_kept = right = 0
    kept_sum = 0.0
    for block in _sample_blocks(vertices, faces, corners, samples, np.random.default_rng(seed)):
        # The search finds distances strictly below its bound, and a sample at outlier_m exactly is an inlier.
        distance, _ = tree.query(block, distance_upper_bound=np.nextafter(reach, np.inf), workers=workers)
        inliers = distance[distance <= outlier_m]
        total += len(block)
        kept += len(inliers)
        kept_sum += float(inliers.sum())
        right_kept += int(np.count_nonzero(inliers < threshold_m))
        right += int(np.count_nonzero(distance < threshold_m))
        _shorten(completion, points, block, workers)
    if total == 0:
        msg = f"the mesh has no surface{in_the_box}"
        raise ValueError(msg)

    accuracy_ratio = right_kept / kept if kept else 0.0
    precision = right / total
    completion_ratio = float(np.mean(completion < threshold_m))
    angles = _angles(vertices, faces, corners)
    shape, mean, variance = gamma_from_moments(angles)
    return SurfaceMetrics(
        protocol=PROTOCOL,
        accuracy_error_m=kept_sum / kept if kept else None,
        accuracy_ratio=accuracy_ratio,
        outlier_ratio=1.0 - kept / total,
        completion_error_m=float(completion.mean()),
        completion_ratio=completion_ratio,
        f_score=_harmonic_mean(accuracy_ratio, completion_ratio),
        precision=precision,
        f_score_all=_harmonic_mean(precision, completion_ratio),
        gamma_shape=shape,
        gamma_mean=mean,
        gamma_variance=variance,
        num_mesh_samples=total,
        num_ground_truth=len(points),
        num_angles=len(angles),
        ground_truth_sha256=digest,
        samples=samples,
        seed=seed,
        threshold_m=threshold_m,
        outlier_m=outlier_m,
        truncation_m=truncation_m,
        box=None if box is None else real_array(box, "box").tolist(),
    )


def adjacent_angles(mesh: trimesh.Trimesh, *, box: ArrayLike | None = None) -> NDArray[np.float64]:
    """Angles between the triangles on both sides of each edge, of which the paper shows the histogram.

    Parameters
    ----------
    mesh : trimesh.Trimesh
        As in `surface_metrics`.
    box : (2, 3) array_like, optional
        Lower and upper corner, world frame, m. Only edges with their midpoint in it count. None takes all.

    Returns
    -------
    (E,) float64
        Radians: 0 where two triangles lie in one plane, π where one is folded onto the other. Edges with one triangle,
        or with more than two, have no angle.

    Raises
    ------
    ValueError
        If a vertex is not finite or the box has a wrong shape.
    """
    vertices, faces = _triangles(mesh)
    if len(faces) == 0:
        return np.zeros(0)
    origin = vertices.mean(axis=0)
    return _angles(vertices - origin, faces, None if box is None else check_box(box) - origin)


def gamma_from_moments(angles_rad: ArrayLike) -> tuple[float | None, float | None, float | None]:
    """Fit a Gamma distribution that begins at zero to angles, by the method of moments.

    Parameters
    ----------
    angles_rad : (N,) array_like
        Angles between adjacent triangles, as of `adjacent_angles`.

    Returns
    -------
    shape, mean, variance : float or None
        Mean and variance of the angles, in rad and rad², and shape = mean² / variance. All are None without an angle.
        The shape is None where the variance is zero, as on a plane: no Gamma distribution fits.

    Notes
    -----
    The paper does not name its estimator, but in all twelve rows of its table shape = mean² / variance within rounding.
    Maximum likelihood needs the mean logarithm of the angles, which an angle of zero makes undefined.
    """
    angles = real_array(angles_rad, "angles_rad")
    if angles.size == 0:
        return None, None, None
    mean, variance = float(angles.mean()), float(angles.var())
    return (mean**2 / variance if variance > _ANGLE_NOISE_RAD**2 else None), mean, variance


def format_metrics(metrics: SurfaceMetrics | IntensityMetrics) -> str:
    """Format metrics as a few aligned lines of text.

    Parameters
    ----------
    metrics : SurfaceMetrics or IntensityMetrics
        Result of `surface_metrics` or `intensity_metrics`.

    Returns
    -------
    str
        Lines without a trailing newline. Surface errors are in centimetres and ratios in percent, as in the paper's
        tables; intensity errors are in sensor units.

    Examples
    --------
    >>> from radarsdf.evaluation import intensity_metrics
    >>> print(format_metrics(intensity_metrics([60.0, 70.0], [61.0, 68.0])))
    intensity error  mean 1.50  median 1.50  (2 returns, radarsdf-intensity-1)
    """
    if "mae" in metrics:
        i = cast("IntensityMetrics", metrics)
        count = f"({i['num_returns']} returns, {i['protocol']})"
        return f"intensity error  mean {i['mae']:.2f}  median {i['medae']:.2f}  {count}"
    s = metrics
    shape, mean = _number(s["gamma_shape"], ""), _number(s["gamma_mean"], " rad", digits=3)
    variance = _number(s["gamma_variance"], " rad²", digits=3)
    of = f"{s['num_mesh_samples']} mesh samples and {s['num_ground_truth']} ground-truth points"
    rows = {
        "accuracy": f"error {_number(s['accuracy_error_m'], ' cm', 100)}  ratio {_number(s['accuracy_ratio'], ' %', 100)}"
        f"  outliers beyond {s['outlier_m']:g} m {_number(s['outlier_ratio'], ' %', 100)}",
        "completion": f"error {_number(s['completion_error_m'], ' cm', 100)}"
        f"  ratio {_number(s['completion_ratio'], ' %', 100)}",
        "F-score": f"{_number(s['f_score'], ' %', 100)}  with nothing discarded {_number(s['f_score_all'], ' %', 100)}"
        f" (precision {_number(s['precision'], ' %', 100)})",
        "angles": f"gamma shape {shape}  mean {mean}  variance {variance}",
        "protocol": f"{s['protocol']}  threshold {s['threshold_m']:g} m  {of} ({s['ground_truth_sha256'][:12]})",
    }
    return "\n".join(f"{name:<12}{text}" for name, text in rows.items())


def _number(value: float | None, unit: str, factor: float = 1.0, digits: int = 2) -> str:
    return "undefined" if value is None else f"{value * factor:.{digits}f}{unit}"


def _harmonic_mean(a: float, b: float) -> float:
    return 2.0 * a * b / (a + b) if a + b > 0 else 0.0


def _triangles(mesh: trimesh.Trimesh) -> tuple[_Points, NDArray[np.int64]]:
    """Vertices (V, 3), world, m, and faces (F, 3) of a mesh of any program."""
    if not hasattr(mesh, "vertices") or not hasattr(mesh, "faces"):
        msg = f"mesh must have vertices and faces, not be {mesh!r:.50}"
        raise TypeError(msg)
    vertices, faces = positions(mesh.vertices, "mesh.vertices"), np.asarray(mesh.faces)
    if faces.size == 0:
        return vertices, np.zeros((0, 3), np.int64)
    shaped = faces.dtype.kind in "iu" and faces.ndim == 2 and faces.shape[1] == 3
    if not (shaped and 0 <= faces.min() <= faces.max() < len(vertices)):
        msg = (
            f"mesh.faces must be (F, 3) rows of the {len(vertices)} vertices, not {faces.shape} {faces.dtype}"
        )
        raise ValueError(msg)
    return vertices, faces.astype(np.int64)


def _in_box(points: _Points, corners: _Points | None) -> _Points:
    if corners is None:
        return points
    inside: NDArray[np.bool_] = ((points >= corners[0]) & (points <= corners[1])).all(axis=1)
    return points[inside]


def _sample_blocks(
    vertices: _Points,
    faces: NDArray[np.int64],
    corners: _Points | None,
    samples: int,
    rng: np.random.Generator,
) -> Iterator[_Points]:
    """Samples uniform by area, in blocks of neighbouring triangles, so that searches stay in cache."""
    if corners is not None and len(faces):
        x = vertices[faces]
        faces = faces[((x.max(axis=1) >= corners[0]) & (x.min(axis=1) <= corners[1])).all(axis=1)]
    if len(faces) == 0:
        return
    faces = faces[_morton_order(vertices[faces].mean(axis=1))]
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    if area.sum() == 0:
        return
    # Samples on each triangle, distributed as if they were drawn one by one.
    last = np.cumsum(rng.multinomial(samples, area / area.sum()))
    for start in range(0, samples, _CHUNK):
        index = np.searchsorted(last, np.arange(start, min(start + _CHUNK, samples)), side="right")
        u, v = rng.random((2, len(index), 1))
        root = np.sqrt(u)
        block = (1.0 - root) * a[index] + root * ((1.0 - v) * b[index] + v * c[index])
        inside = _in_box(block, corners)
        if len(inside):
            yield inside


def _morton_order(points: _Points) -> NDArray[np.intp]:
    """Order (N,) of the points along a Morton curve, which keeps neighbours together; ten bits for each axis."""
    low, extent = points.min(axis=0), np.ptp(points, axis=0).max()
    return np.argsort(cell_keys(points - low, max(float(extent), 1e-9) / 1023), kind="stable")


def _shorten(shortest: _Points, points: _Points, block: _Points, workers: int) -> None:
    """Update `shortest` (M,), the distance of each point to all samples so far, with the samples of `block`."""
    low, high = block.min(axis=0), block.max(axis=0)
    gap = np.linalg.norm(np.maximum(np.maximum(low - points, points - high), 0.0), axis=1)
    candidates = np.flatnonzero(gap < shortest)
    if len(candidates) == 0:
        return
    tree = cKDTree(block, balanced_tree=False)
    distance, _ = tree.query(
        points[candidates], distance_upper_bound=shortest[candidates].max(), workers=workers
    )
    shortest[candidates] = np.minimum(shortest[candidates], distance)


def _angles(vertices: _Points, faces: NDArray[np.int64], corners: _Points | None) -> _Points:
    """See `adjacent_angles`. The vertices must be near the origin."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    has_area = np.linalg.norm(normals, axis=1) > 0  # without it, a triangle has no direction
    faces, normals = faces[has_area], normals[has_area]
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    forward = (faces < np.roll(faces, -1, axis=1)).reshape(-1)
    key = edges[:, 0] * len(vertices) + edges[:, 1]
    order = np.argsort(key, kind="stable")
    first = np.flatnonzero(np.diff(key[order], prepend=-1))
    pair = first[np.diff(first, append=len(key)) == 2]
    i, j = order[pair], order[pair + 1]
    if corners is not None:
        middle = vertices[edges[i]].mean(axis=1)
        inside = ((middle >= corners[0]) & (middle <= corners[1])).all(axis=1)
        i, j = i[inside], j[inside]
    # Two triangles of the same orientation run along their common edge in opposite directions. Otherwise one normal is
    # turned round.
    turn = np.where(forward[i] == forward[j], -1.0, 1.0)[:, None]
    m, n = normals[i // 3], turn * normals[j // 3]
    sine, cosine = np.linalg.norm(np.cross(m, n), axis=1), np.einsum("ij,ij->i", m, n)
    return np.asarray(np.arctan2(sine, cosine), dtype=np.float64)
