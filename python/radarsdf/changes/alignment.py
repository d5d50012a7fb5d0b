# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Where the frame of one map lies in that of another, by their surfaces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from radarsdf.changes.placed import Floats, PlacedMap
from radarsdf.changes.probability import REACH_CELLS, odds_of_differences, posterior, share_of_changes
from radarsdf.map.map import Map
from radarsdf.poses.expected import ExpectedStep
from radarsdf.poses.rates import Rate
from radarsdf.poses.rigid import moved, skew
from radarsdf.poses.tracking import Tracker
from radarsdf.poses.verdict import Verdict
from radarsdf.products import turned
from radarsdf.returns.evidence import CELLS_OF_SURFACE
from radarsdf.returns.surfels import LEAVES_PER_SURFEL

_SEARCHED_M, _SEARCHED_RAD = 3.0, 0.15  # standard deviations of what a search covers
_ITERATIONS = 15
_MOST_VERTICES = 20_000  # that are looked at, evenly spread
_PATCH_M = 4.0  # vertices of a patch have errors in common: patches judge, as scans do of poses
_LEAST_M = 1e-3


@dataclass(frozen=True)
class Alignment:
    """Where one map lies in the frame of another."""

    T_before_after: Floats
    """(4, 4) from the later map's world to that of the earlier one, m. The identity unless `improved`."""
    covariance: Floats
    """(6, 6) of translation, m, and rotation vector about `centre`, rad."""
    centre: Floats
    """(3,) world of the earlier map, m."""
    improved: bool
    """Whether surfaces that took no part are nearer to each other then, by more than chance gives one of a thousand."""
    words: str
    """The verdict in one sentence."""

    def sigma_m(self, x: Floats, normals: Floats) -> Floats:
        """(N,) standard error of the alignment at places (N, 3) along their normals (N, 3), m."""
        rows = _jacobian(x - self.centre, np.nan_to_num(normals))
        variance: Floats = np.einsum("ni,ij,nj->n", rows, self.covariance, rows)
        return np.sqrt(np.maximum(variance, 0))


def unaligned() -> Alignment:
    """Both maps are in one frame, and it is taken as it is."""
    return Alignment(np.eye(4), np.zeros((6, 6)), np.zeros(3), False, "The maps were taken as they are.")


def align(before: PlacedMap, after: PlacedMap) -> Alignment:
    """Move the later map so that its surface lies on that of the earlier one, if that is an improvement.

    Half of its vertices say where, the others judge. It begins where the frames are, and where a search by planes finds most
    agreement within some metres.
    """
    target, vertices = (placed.to_common(placed.vertices) for placed in (before, after))
    if min(len(target), len(vertices)) < CELLS_OF_SURFACE:
        return unaligned()
    vertices = vertices[:: max(1, len(vertices) // _MOST_VERTICES)]
    judge = np.arange(len(vertices)) % 2 == 1
    used, sigma_m = vertices[~judge], after.radar_map.uncertainty(vertices[~judge])
    patches = np.unique(np.floor(vertices / _PATCH_M).astype(np.int64), axis=0, return_inverse=True)[1]
    centre = vertices.mean(axis=0)
    tree = cKDTree(target)

    def far_m(pose: Floats) -> Floats:
        """(N,) distances of the vertices that judge, m."""
        there = after.at(pose).to_common(vertices[judge])
        nearest_m, _ = tree.query(there)
        distance_m, _ = before.distance(there)
        found: Floats = np.where(np.isfinite(distance_m), np.abs(distance_m), nearest_m)
        return np.maximum(found, _LEAST_M)

    starts = [np.eye(4), *_searched(target, vertices, before.radar_map)]
    found = [_settled(before, used, sigma_m, centre, start) for start in starts]
    as_given_m = far_m(np.eye(4))
    gains = [np.log(as_given_m / far_m(pose)) for pose, _ in found]
    best = int(np.argmax([gain.mean() for gain in gains]))
    verdict = Verdict.by_groups(gains[best], patches.reshape(-1)[judge])
    pose, covariance = found[best]
    there = after.at(pose)
    moved_m = float(np.sqrt(((there.to_common(vertices) - vertices) ** 2).sum(1).mean()))
    figures = f"{verdict.gain:+.1%} of their distance, by chance less than {verdict.needed:.1%}"
    if not verdict.improved:
        words = f"The frames were taken as they are: moved onto each other, the surfaces are not nearer ({figures})."
        return Alignment(np.eye(4), covariance, centre, False, words)
    words = f"The later map was moved by {moved_m:.3f} m, root mean square: its surface is nearer then ({figures})."
    return Alignment(pose, covariance, there.to_common(centre[None])[0], True, words)


def _searched(target: Floats, vertices: Floats, before: Map) -> list[Floats]:
    """The pose at which the vertices agree best with the planes of the target, of those within some metres; none if unclear."""
    centre = target.mean(axis=0)
    tracker = Tracker(LEAVES_PER_SURFEL * before.config.leaf_size_m, before.config.returns)
    wide = ExpectedStep(
        Rate(np.zeros(3), np.diag([0.02, 0.02, _SEARCHED_RAD]) ** 2),
        np.zeros(3), np.zeros(3), np.diag([_SEARCHED_M, _SEARCHED_M, 0.5]) ** 2, 1.0,
    )  # fmt: skip
    tracker.follow(np.ascontiguousarray(target - centre), None)
    sought = tracker.seek(np.ascontiguousarray(vertices - centre), wide)
    if np.isnan(sought.agreeing):  # it agrees nowhere
        return []
    pose = sought.pose.copy()
    pose[:3, 3] += centre - np.einsum("ij,j->i", pose[:3, :3], centre)
    return [pose]


def _settled(
    before: PlacedMap, vertices: Floats, sigma_m: Floats, centre: Floats, pose: Floats
) -> tuple[Floats, Floats]:
    """By Gauss and Newton's method; and the covariance. What changed counts as little as it is probable that it did not."""
    information = np.eye(6)
    for _ in range(_ITERATIONS):
        there = turned(vertices, pose[:3, :3]) + pose[:3, 3]
        middle = np.einsum("ij,j->i", pose[:3, :3], centre) + pose[:3, 3]
        distance_m, normals = before.distance(there)
        sigma = np.hypot(sigma_m, before.radar_map.uncertainty(there))
        known = np.isfinite(distance_m) & np.isfinite(sigma)
        if known.sum() < CELLS_OF_SURFACE:
            break
        odds = odds_of_differences(distance_m[known], sigma[known], REACH_CELLS * before.leaf_m)
        weights = (1 - posterior(odds, share_of_changes(odds))) / sigma[known] ** 2
        rows = _jacobian(there[known] - middle, normals[known])
        information = np.einsum("ni,n,nj->ij", rows, weights, rows) / CELLS_OF_SURFACE
        gradient = np.einsum("ni,n,n->i", rows, weights, distance_m[known]) / CELLS_OF_SURFACE
        # What surfaces do not tell, along a corridor say, stays as it is.
        step = -np.linalg.solve(information + np.eye(6), gradient)
        shifted = pose.copy()
        shifted[:3, 3] = middle
        shifted = moved(shifted[None], step[None])[0]
        shifted[:3, 3] -= np.einsum("ij,j->i", shifted[:3, :3], centre)
        pose = shifted
        if np.einsum("i,ij,j->", step, information, step) < 0.01:
            break
    covariance = np.asarray(np.linalg.inv(information + np.eye(6)), np.float64)
    return pose, covariance


def _jacobian(from_centre: Floats, normals: Floats) -> Floats:
    """(N, 6) by how much places move along their normals if all are shifted, and turned about a centre."""
    turns = np.einsum("ni,nij->nj", normals, -skew(from_centre))
    return np.concatenate([normals, turns], axis=1)
