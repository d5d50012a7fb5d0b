# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""A mesh against lidar points: accuracy, completion, F-score and smoothness."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from typing import TYPE_CHECKING, TypedDict

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from radarsdf._core import cell_keys
from radarsdf.checks import positions, positive, real_array, whole_number

if TYPE_CHECKING:
    import trimesh

PROTOCOL = "radarsdf-surface-1"
"""Name and version of the definitions in `surface_metrics`; a change of any number's meaning changes it."""

_CHUNK = 500_000  # samples at a time: bounds the memory, and part of the protocol's random sequence
_ANGLE_NOISE_RAD = 1e-7  # what float64 leaves of equal angles: 1e-9 m of a UTM northing over an edge of 1 cm
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
    num_threads: int = -1,
) -> SurfaceMetrics:
    """Measure a mesh against ground-truth points by the paper's definitions.

    Parameters
    ----------
    mesh
        The surface, world frame, metres. Orientation does not matter; vertices must be shared between
        neighbouring triangles for the angles (a soup of triangles has none).
    ground_truth
        (M, 3) lidar points, world frame, metres. The same points serve accuracy and completion.
    box
        (2, 3) lower and upper corner, world frame; only what lies in it counts, bounds included, of mesh samples
        and ground truth alike. None takes everything, which is rarely fair: radar and lidar see differently far.
    samples
        Points drawn uniformly by area on the triangles whose bounds touch the box; those outside the box are
        then dropped (`num_mesh_samples` remain).
    seed
        Of the random samples. The same arguments give the same numbers, whatever `num_threads` is.
    threshold_m
        Distance below which a point counts as right.
    outlier_m
        Mesh samples farther than this from the ground truth are left out of the accuracy.
    truncation_m
        A ground-truth point farther than this from the mesh counts as this far.
    num_threads
        Threads of the nearest-neighbour search; below 1 means all.

    Returns
    -------
    SurfaceMetrics
        - `accuracy_error_m`: mean distance mesh sample → ground truth of those within `outlier_m`, None if there
          are none; `accuracy_ratio`: share *of these* below `threshold_m`, 0 if there are none;
          `outlier_ratio`: share of the samples that was left out.
        - `completion_error_m`: mean distance ground truth → nearest mesh sample, truncated;
          `completion_ratio`: share below `threshold_m`.
        - `f_score`: harmonic mean of `accuracy_ratio` and `completion_ratio`. It is blind to a mesh that fills
          the void, hence `precision`, the share of *all* samples below `threshold_m`, and `f_score_all`,
          the harmonic mean of `precision` and `completion_ratio`.
        - `gamma_shape`, `gamma_mean`, `gamma_variance`: see `gamma_from_moments`, over the `num_angles` edges
          with two triangles and their midpoint in the box.
        - `protocol`, the arguments, the counts, and a hash of the ground truth used (in the box, as float64).

    Raises
    ------
    ValueError
        If the mesh has no area in the box or the ground truth no point in it, or an argument has a wrong
        shape, is not finite or not positive.

    Notes
    -----
    Memory is bounded: beside mesh and ground truth, a block of samples and its search tree at a time (200 MB in
    all for 400,000 triangles and 300,000 points).
    A ground-truth point's distance is the exact one to the nearest of all samples, not to the triangles: even a
    perfect mesh has a completion error of half the samples' spacing, 0.5 · sqrt(area / samples), 5 mm for 1e7 on
    1000 m². Compare at equal `samples`.
    """
    whole_number(samples, "samples", 1)
    positive(threshold_m, "threshold_m")
    positive(outlier_m, "outlier_m")
    positive(truncation_m, "truncation_m")
    corners = None if box is None else _check_box(box)
    points = _in_box(positions(ground_truth, "ground_truth"), corners)
    if len(points) == 0:
        msg = "there are no ground-truth points" + ("" if corners is None else " in the box")
        raise ValueError(msg)
    digest = hashlib.sha256(points.tobytes()).hexdigest()
    # Near the origin from here on, where differences of coordinates lose nothing.
    origin = points.mean(axis=0)
    points = points - origin
    vertices = positions(mesh.vertices, "mesh.vertices") - origin
    faces = _faces(mesh)
    if corners is not None:
        corners = corners - origin

    workers = num_threads if num_threads > 0 else -1
    reach = max(outlier_m, threshold_m)
    tree = cKDTree(points)
    completion = np.full(len(points), float(truncation_m))
    total = kept = right_kept = right = 0
    kept_sum = 0.0
    for block in _sample_blocks(vertices, faces, corners, samples, np.random.default_rng(seed)):
        # The search looks strictly below its bound; a sample at outlier_m still counts.
        distance, _ = tree.query(block, distance_upper_bound=np.nextafter(reach, np.inf), workers=workers)
        inliers = distance[distance <= outlier_m]
        total += len(block)
        kept += len(inliers)
        kept_sum += float(inliers.sum())
        right_kept += int(np.count_nonzero(inliers < threshold_m))
        right += int(np.count_nonzero(distance < threshold_m))
        _shorten(completion, points, block, workers)
    if total == 0:
        msg = "the mesh has no surface" + ("" if corners is None else " in the box")
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
        box=None if box is None else np.asarray(box, dtype=np.float64).tolist(),
    )


def adjacent_angles(mesh: trimesh.Trimesh, *, box: ArrayLike | None = None) -> NDArray[np.float64]:
    """Angles between the triangles on both sides of an edge: the histogram that the paper shows.

    Parameters
    ----------
    mesh
        As of `surface_metrics`.
    box
        (2, 3) lower and upper corner, world frame; only edges with their midpoint in it count. None takes all.

    Returns
    -------
    (E,) float64
        Radians: 0 where two triangles continue each other, π where they fold. Edges of one or more than two triangles
        have no angle.

    Raises
    ------
    ValueError
        If a vertex is not finite or the box has a wrong shape.
    """
    vertices, faces = positions(mesh.vertices, "mesh.vertices"), _faces(mesh)
    if len(faces) == 0:
        return np.zeros(0)
    origin = vertices.mean(axis=0)
    return _angles(vertices - origin, faces, None if box is None else _check_box(box) - origin)


def gamma_from_moments(angles_rad: ArrayLike) -> tuple[float | None, float | None, float | None]:
    """Fit a Gamma distribution that begins at zero to angles, by the method of moments.

    Parameters
    ----------
    angles_rad
        (N,) angles between adjacent triangles, radians: 0 where they continue each other, π where they fold.

    Returns
    -------
    shape, mean, variance : float or None
        Mean and variance are those of the angles, shape = mean² / variance. All None without an angle; shape is
        None if the variance is zero, as on a plane, where no Gamma distribution fits.

    Notes
    -----
    The paper does not name its estimator. In all twelve rows of its table shape = mean² / variance within
    rounding, so the distribution begins at zero (no free location), which any estimator with that would obey.
    Maximum likelihood needs the mean logarithm of the angles: one angle of exactly zero makes it undefined, and
    on flat walls its shape would be decided by rounding errors of 1e-8 rad. Moments exist always.
    """
    angles = np.asarray(angles_rad, dtype=np.float64)
    if angles.size == 0:
        return None, None, None
    mean, variance = float(angles.mean()), float(angles.var())
    return (mean**2 / variance if variance > _ANGLE_NOISE_RAD**2 else None), mean, variance


def _harmonic_mean(a: float, b: float) -> float:
    return 2.0 * a * b / (a + b) if a + b > 0 else 0.0


def _check_box(box: ArrayLike) -> _Points:
    corners = real_array(box, "box")
    if corners.shape != (2, 3) or not (corners[0] < corners[1]).all():
        msg = "box must be (2, 3): a lower corner and an upper one above it"
        raise ValueError(msg)
    return corners


def _faces(mesh: trimesh.Trimesh) -> NDArray[np.int64]:
    faces = np.asarray(mesh.faces)
    if faces.size and (faces.dtype.kind not in "iu" or faces.ndim != 2 or faces.shape[1] != 3):
        msg = f"mesh.faces must be (F, 3) integers, not {faces.shape} {faces.dtype}"
        raise ValueError(msg)
    if faces.size and not 0 <= faces.min() <= faces.max() < len(mesh.vertices):
        msg = f"mesh.faces must be rows of the {len(mesh.vertices)} vertices"
        raise ValueError(msg)
    return faces.astype(np.int64).reshape(-1, 3)


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
    """Draw samples uniformly by area, in blocks of neighbouring triangles, so that searches stay in cache."""
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
    # How many of independent uniform samples fall on each triangle: the same set as drawing one by one.
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
    """Order points along a curve that keeps neighbours together (ten bits an axis, interleaved)."""
    low, extent = points.min(axis=0), np.ptp(points, axis=0).max()
    return np.argsort(cell_keys(points - low, max(float(extent), 1e-9) / 1023), kind="stable")


def _shorten(shortest: _Points, points: _Points, block: _Points, workers: int) -> None:
    """Lower `shortest`, each point's distance to all samples so far, where `block` has a nearer one."""
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
    """See `adjacent_angles`; vertices near the origin."""
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
    # Consistently wound neighbours run along their edge in opposite directions; turn those that do not.
    turn = np.where(forward[i] == forward[j], -1.0, 1.0)[:, None]
    m, n = normals[i // 3], turn * normals[j // 3]
    sine, cosine = np.linalg.norm(np.cross(m, n), axis=1), np.einsum("ij,ij->i", m, n)
    return np.asarray(np.arctan2(sine, cosine), dtype=np.float64)
