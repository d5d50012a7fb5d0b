# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Rigid motions: increments of poses, relative motions, and the motion that brings one trajectory onto another."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Floats = NDArray[np.float64]


def moved(poses: Floats, increments: Floats) -> Floats:
    """The poses (F, 4, 4) with increments (F, 6): each adds a translation, m, and turns about the sensor, rad, both in world axes."""
    found = poses.copy()
    turn = Rotation.from_rotvec(increments[:, 3:]).as_matrix()
    found[:, :3, :3] = np.einsum("fij,fjk->fik", turn, poses[:, :3, :3])
    found[:, :3, 3] += increments[:, :3]
    return found


def increments(first: Floats, second: Floats) -> Floats:
    """(F, 6) from poses to others (F, 4, 4), as :func:`moved` takes them."""
    turns = np.einsum("fij,fkj->fik", second[:, :3, :3], first[:, :3, :3])
    translations = second[:, :3, 3] - first[:, :3, 3]
    return np.concatenate([translations, Rotation.from_matrix(turns).as_rotvec()], axis=1)


def steps(poses: Floats) -> Floats:
    """(F - 1, 4, 4) motion from each pose to the next, in the frame of the first of the two."""
    return between(poses[:-1], poses[1:])


def step_vectors(poses: Floats) -> Floats:
    """(F - 1, 6) translations, m, and rotation vectors, rad, of these motions."""
    motions = steps(poses)
    return np.concatenate([motions[:, :3, 3], Rotation.from_matrix(motions[:, :3, :3]).as_rotvec()], axis=1)


def between(first: Floats, second: Floats) -> Floats:
    """(K, 4, 4) motion from each pose to the other one, in the frame of the first of the two."""
    found = np.tile(np.eye(4), (len(first), 1, 1))
    back = first[:, :3, :3]
    found[:, :3, :3] = np.einsum("fji,fjk->fik", back, second[:, :3, :3])
    found[:, :3, 3] = np.einsum("fji,fj->fi", back, second[:, :3, 3] - first[:, :3, 3])
    return found


def alignment(poses: Floats, reference: Floats) -> Floats:
    """(4, 4) motion that brings the mean position and the mean rotation of poses (F, 4, 4) to those of `reference`."""
    turns = np.einsum("fij,fkj->fik", reference[:, :3, :3], poses[:, :3, :3])
    whole = np.eye(4)
    whole[:3, :3] = Rotation.from_matrix(turns).mean().as_matrix()
    return placed(whole, poses, reference)


def placed(turn: Floats, poses: Floats, reference: Floats) -> Floats:
    """(4, 4) motion with the rotation of `turn` that brings the mean position of poses (F, 4, 4) to that of `reference`."""
    whole = turn.copy()
    middle = poses[:, :3, 3].mean(axis=0)
    whole[:3, 3] = reference[:, :3, 3].mean(axis=0) - np.einsum("ij,j->i", whole[:3, :3], middle)
    return whole


def aligned(poses: Floats, reference: Floats) -> Floats:
    """The poses (F, 4, 4), as a whole moved and turned so that their mean position and mean rotation are those of `reference`."""
    found: Floats = np.einsum("ij,fjk->fik", alignment(poses, reference), poses)
    return found


def turned_by(poses: Floats, others: Floats) -> Floats:
    """(F,) angles between the rotations of poses and others (F, 4, 4), rad."""
    found: Floats = Rotation.from_matrix(between(poses, others)[:, :3, :3]).magnitude()
    return found


def moved_by(before: Floats, after: Floats) -> dict[str, float]:
    """By how much poses (F, 4, 4) differ, root mean square, for a report: `moved_m` and `moved_rad`."""
    return {
        "moved_m": float(np.sqrt(((after - before)[:, :3, 3] ** 2).sum(axis=1).mean())),
        "moved_rad": float(np.sqrt((turned_by(before, after) ** 2).mean())),
    }


def nearest_rotation(matrix: Floats) -> Floats:
    """(3, 3) rotation, not a reflection, that is nearest to a matrix: of sums b aᵀ, the one that best turns each a to its b (Kabsch)."""
    u, _, vt = np.linalg.svd(matrix)
    found: Floats = np.einsum("ij,j,jk->ik", u, [1, 1, np.sign(np.linalg.det(u) * np.linalg.det(vt))], vt)
    return found


def covariance_in(covariance: Floats, R: Floats) -> Floats:
    """Covariances (F, 6, 6) of translations and rotation vectors in the axes of a frame that is turned by R (3, 3)."""
    whole = np.zeros((6, 6))
    whole[:3, :3] = whole[3:, 3:] = R
    found: Floats = np.einsum("ij,fjk,lk->fil", whole, covariance, whole)
    return found


def skew(vectors: Floats) -> Floats:
    """(N, 3, 3) matrices that are the cross products with `vectors` (N, 3)."""
    x, y, z = vectors.T
    o = np.zeros(len(vectors))
    return np.stack([o, -z, y, z, o, -x, -y, x, o], 1).reshape(-1, 3, 3)


def rotation(vector: Floats) -> Floats:
    """(..., 3, 3) rotations by rotation vectors (..., 3), rad. There are no dimensions before the last, or one."""
    found: Floats = Rotation.from_rotvec(vector).as_matrix()
    return found


def transform(turn: Floats, translation: Floats) -> Floats:
    """(..., 4, 4) of rotation vectors (..., 3), rad, and translations (..., 3), m."""
    found = np.zeros((*turn.shape[:-1], 4, 4))
    found[..., :3, :3] = rotation(turn)
    found[..., :3, 3] = translation
    found[..., 3, 3] = 1
    return found


def rotation_vector(matrix: Floats, near: Floats | None = None) -> Floats:
    """(3,) of a rotation (3, 3), rad. Of those that differ by whole turns, the one nearest to `near`, or to 0."""
    found: Floats = Rotation.from_matrix(matrix).as_rotvec()
    angle = float(np.linalg.norm(found))
    if near is None or angle == 0:
        return found
    axis = found / angle
    whole_turns = np.round((np.einsum("i,i->", axis, near) - angle) / (2 * np.pi))
    unwound: Floats = found + 2 * np.pi * whole_turns * axis
    return unwound
