"""Rigid motions: increments of poses, relative motions, and alignment of trajectories."""

import numpy as np
from scipy.spatial.transform import Rotation

from radarsdf.arrays import Floats


def moved(poses: Floats, increments: Floats) -> Floats:
    """Apply increments (..., 6) to poses (..., 4, 4): a translation, m, and a rotation about the sensor, rad, in world axes."""
    found = poses.copy()
    found[..., :3, :3] = rotation(increments[..., 3:]) @ poses[..., :3, :3]
    found[..., :3, 3] += increments[..., :3]
    return found


def increments(first: Floats, second: Floats) -> Floats:
    """Return the increments (..., 6) from `first` to `second` poses (..., 4, 4), the inverse of :func:`moved`."""
    turns = second[..., :3, :3] @ first[..., :3, :3].swapaxes(-1, -2)
    return np.concatenate([second[..., :3, 3] - first[..., :3, 3], rotation_vector(turns)], axis=-1)


def steps(poses: Floats) -> Floats:
    """Return the motions (F - 1, 4, 4) from each pose to the next, in the frame of the first of the two."""
    return between(poses[:-1], poses[1:])


def lengths_of_steps_m(poses: Floats) -> Floats:
    """Return the distances (F - 1,) from each pose to the next."""
    return np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)


def step_vectors(poses: Floats) -> Floats:
    """Return the translations, m, and rotation vectors, rad, (F - 1, 6) of :func:`steps`."""
    motions = steps(poses)
    return np.concatenate([motions[:, :3, 3], rotation_vector(motions[:, :3, :3])], axis=1)


def between(first: Floats, second: Floats) -> Floats:
    """Return the motions (K, 4, 4) from `first` to `second` poses, in the frames of the first."""
    back = first[:, :3, :3]
    turns = np.einsum("fji,fjk->fik", back, second[:, :3, :3])
    return assembled(turns, np.einsum("fji,fj->fi", back, second[:, :3, 3] - first[:, :3, 3]))


def placed(R: Floats, poses: Floats, reference: Floats) -> Floats:
    """Rotate poses (F, 4, 4) by R (3, 3), and align their mean position with that of `reference`."""
    middle, aim = (each[:, :3, 3].mean(axis=0) for each in (poses, reference))
    return np.einsum("ij,fjk->fik", assembled(R, aim - np.einsum("ij,j->i", R, middle)), poses)


def aligned(poses: Floats, reference: Floats) -> Floats:
    """Rigidly align poses (F, 4, 4) with the mean position and mean rotation of `reference`."""
    turns = np.einsum("fij,fkj->fik", reference[:, :3, :3], poses[:, :3, :3])
    return placed(Rotation.from_matrix(turns).mean().as_matrix(), poses, reference)


def turned_by(poses: Floats, others: Floats) -> Floats:
    """Return the angles (F,) between the rotations of two sets of poses (F, 4, 4), rad."""
    return Rotation.from_matrix(between(poses, others)[:, :3, :3]).magnitude()


def nearest_rotation(matrix: Floats) -> Floats:
    """Return the nearest rotation (3, 3) to a matrix, not a reflection; for Σ b aᵀ, the one that best maps a to b (Kabsch)."""
    u, _, vt = np.linalg.svd(matrix)
    signs = [1, 1, np.sign(np.linalg.det(u) * np.linalg.det(vt))]
    return np.einsum("ij,j,jk->ik", u, signs, vt)


def covariance_in(covariance: Floats, R: Floats) -> Floats:
    """Rotate covariances (..., 6, 6) of translations and rotation vectors by R (3, 3)."""
    whole = np.zeros((6, 6))
    whole[:3, :3] = whole[3:, 3:] = R
    return np.einsum("ij,...jk,lk->...il", whole, covariance, whole)


def skew(vectors: Floats) -> Floats:
    """Return the cross-product matrices (..., 3, 3) of `vectors` (..., 3)."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    o = np.zeros_like(x)
    return np.stack([o, -z, y, z, o, -x, -y, x, o], axis=-1).reshape(*vectors.shape, 3)


def rotation(vector: Floats) -> Floats:
    """Convert rotation vectors (3,) or (N, 3), rad, to matrices (..., 3, 3)."""
    return Rotation.from_rotvec(vector).as_matrix()


def transform(turn: Floats, translation: Floats) -> Floats:
    """Build transforms (..., 4, 4) from rotation vectors (..., 3), rad, and translations (..., 3), m."""
    return assembled(rotation(turn), translation)


def assembled(matrix: Floats, translation: Floats | float = 0.0) -> Floats:
    """Build transforms (..., 4, 4) from matrices (..., 3, 3) and translations (..., 3), m."""
    found = np.zeros((*matrix.shape[:-2], 4, 4))
    found[..., :3, :3] = matrix
    found[..., :3, 3] = translation
    found[..., 3, 3] = 1
    return found


def rotation_vector(matrix: Floats, near: Floats | None = None) -> Floats:
    """Convert rotations (..., 3, 3) to the rotation vectors (..., 3), rad, nearest to `near`, or to 0, up to whole turns."""
    axial = 0.5 * (matrix - matrix.swapaxes(-1, -2))[..., [2, 0, 1], [1, 2, 0]]
    sine = np.sqrt((axial**2).sum(axis=-1, keepdims=True))
    cosine = 0.5 * (np.trace(matrix, axis1=-2, axis2=-1) - 1)
    if np.all(cosine > 0):  # much faster than Rotation, which tests that the matrix is one
        found = axial * (np.arctan2(sine, cosine[..., None]) / np.maximum(sine, 1e-300))
    else:
        found = np.asarray(Rotation.from_matrix(matrix).as_rotvec())
    if near is None:
        return found
    angle = np.linalg.norm(found, axis=-1, keepdims=True)
    axis = found / np.where(angle > 0, angle, 1.0)
    whole_turns = np.round((np.einsum("...i,...i->...", axis, near)[..., None] - angle) / (2 * np.pi))
    return found + 2 * np.pi * whole_turns * axis
