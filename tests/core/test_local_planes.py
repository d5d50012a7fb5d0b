# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The planes that a scan is held against, while others come and go."""

import numpy as np
import pytest
from radarsdf._core import LocalPlanes
from radarsdf.poses.rigid import moved

VARIANCES = [0.02**2, 0.002**2, 0.002**2]


def room(seed, count=12000):
    """Returns of a room of 18 x 14 x 10 m from its middle."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (count, 3)) * [9, 7, 5]
    wall = rng.integers(0, 3, count)
    rows = np.arange(count)
    points[rows, wall] = np.sign(points[rows, wall]) * np.array([9, 7, 5])[wall]
    return points + rng.normal(0, 0.02, (count, 3))


def planes_of(*scans):
    planes = LocalPlanes(0.8)
    for scan in scans:
        planes.add(scan)
    return planes


def pose(*increment):
    return moved(np.eye(4)[None], np.array([increment], float))[0]


def test_what_is_taken_out_was_never_there():
    rng = np.random.default_rng(0)
    scans = [room(seed) + rng.normal(0, 20, 3) for seed in range(6)]
    kept = planes_of(scans[1], scans[4])
    changed = planes_of(*scans)
    for i in (5, 0, 3, 2):
        changed.add(scans[i], -1)
    assert changed.num_cells == kept.num_cells
    scan = scans[1] - scans[1].mean(axis=0)
    at = np.eye(4)
    at[:3, 3] = scans[1].mean(axis=0)
    for one, other in zip(
        changed.agreement(scan, at, VARIANCES), kept.agreement(scan, at, VARIANCES), strict=True
    ):
        np.testing.assert_array_equal(one, other)


def test_what_was_never_added_cannot_be_taken_out():
    planes = planes_of(room(0))
    cells = planes.num_cells
    with pytest.raises(ValueError, match="never added"):
        planes.add(np.concatenate([room(0), [[50.0, 0, 0]]]), -1)
    assert planes.num_cells == cells
    with pytest.raises(ValueError, match="too far"):
        planes.add(np.array([[1e9, 0, 0]]))
    with pytest.raises(ValueError, match="sign"):
        planes.add(room(0), 2)


def test_steps_by_gradient_and_hessian_lead_to_the_pose():
    planes, scan = planes_of(room(0), room(1)), room(2)
    true = pose(0.05, -0.04, 0.03, 0.01, -0.008, 0.012)
    seen = np.ascontiguousarray((scan - true[:3, 3]) @ true[:3, :3])
    found = np.eye(4)
    for _ in range(8):
        hessian, gradient, doubt, weight = planes.agreement(seen, found, VARIANCES)
        found = moved(found[None], -np.linalg.solve(hessian, gradient)[None])[0]
    np.testing.assert_allclose(found, true, atol=4e-3)
    assert weight > 0.6 * len(scan)
    assert np.linalg.eigvalsh(hessian - doubt).min() > 0


def test_along_a_wall_all_is_doubt():
    rng = np.random.default_rng(0)

    def wall():
        return np.column_stack([rng.normal(5, 0.1, 2000), rng.uniform(-5, 5, 2000), rng.uniform(-1, 1, 2000)])

    planes = planes_of(wall(), wall())
    hessian, _, doubt, _ = planes.agreement(wall(), np.eye(4), VARIANCES)
    across, along = doubt[0, 0] / hessian[0, 0], doubt[1, 1] / hessian[1, 1]
    assert across < 0.05
    assert 0.4 < along < 2.5


def test_scores_fall_with_the_distance():
    planes, scan = planes_of(room(0), room(1)), room(2)
    poses = np.stack([pose(x, 0, 0, 0, 0, yaw) for x, yaw in [(0, 0), (0.1, 0), (0.4, 0), (0, 0.2)]])
    scores = planes.scores(scan, poses, VARIANCES).mean(axis=1)
    assert scores[0] > 0.6
    assert (np.diff(scores[:3]) < -0.03).all()
    assert scores[3] < 0.5 * scores[0]
    assert not planes.scores(scan + [500.0, 0, 0], poses, VARIANCES).any()
