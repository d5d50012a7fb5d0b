# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Preparation: from sensor frames to rays of one local frame."""

from __future__ import annotations

import weakref

import numpy as np
import pytest
from radarsdf.checks import check_poses
from radarsdf.returns.rays import prepare

from ..conftest import pose


def tilted_pose(seed, position):
    """A rotation about all three axes, so that a transposed matrix or a swapped axis shows."""
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    q *= np.sign(np.diag(r))
    q[:, 0] *= np.linalg.det(q)
    T_world_sensor = np.eye(4)
    T_world_sensor[:3, :3], T_world_sensor[:3, 3] = q, position
    return T_world_sensor


def scans(count=7, size=30, offset=(0, 0, 0)):
    rng = np.random.default_rng(3)
    points = [rng.normal(size=(size + i, 3)) * 10 + 1 for i in range(count)]
    poses = np.stack([tilted_pose(i, np.array([5.0 * i, i**2, 1]) + offset) for i in range(count)])
    return points, poses


def world(points, poses):
    return np.concatenate([(T[:3, :3] @ p.T).T + T[:3, 3] for p, T in zip(points, poses, strict=True)])


def test_rays_lead_from_the_sensors_to_the_returns():
    points, poses = scans()
    rays = prepare(points, poses)
    np.testing.assert_allclose(rays.origin, poses[:, :3, 3].mean(axis=0))
    returns_world, sensors_world = rays.in_world()
    np.testing.assert_allclose(returns_world, world(points, poses), atol=1e-5)
    np.testing.assert_allclose(
        sensors_world, np.repeat(poses[:, :3, 3], [len(p) for p in points], axis=0), atol=2e-5
    )
    np.testing.assert_allclose(np.linalg.norm(rays.directions, axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(rays.ranges_m, np.linalg.norm(np.concatenate(points), axis=1), rtol=1e-6)
    assert rays.intensities is None
    assert {rays.points.dtype, rays.directions.dtype, rays.ranges_m.dtype} == {np.dtype(np.float32)}
    assert len(rays) == sum(map(len, points))


def test_ranges_are_measured_from_the_sensor_and_take_the_intensities_along():
    points = [
        np.array([[1.0, 0, 0], [0, 2.5, 0], [0, 0, -7]]),
        np.array([[60, 0, 0], [61.0, 0, 0], [0, 3, 4]]),
    ]
    intensities = [np.array([1.0, 2, 3]), np.array([4.0, 5, 6])]
    poses = np.stack([pose([100.0, 0, 0]), pose([0, 300.0, 0], 1.0)])
    rays = prepare(points, poses, intensities, min_range_m=2.5, max_range_m=60)
    assert rays.scans.tolist() == [0, 0, 1, 1]
    assert prepare(points, poses).scans.tolist() == [0, 0, 0, 1, 1, 1]
    assert rays.select(np.array([3, 0])).scans.tolist() == [1, 0]
    # Both bounds belong to what is kept.
    assert rays.intensities.tolist() == [2, 3, 4, 6]
    sensors = rays.points - rays.directions * rays.ranges_m[:, None] + rays.origin
    np.testing.assert_allclose(sensors, poses[[0, 0, 1, 1], :3, 3], atol=1e-4)
    np.testing.assert_allclose(rays.ranges_m, [2.5, 7, 60, 5], rtol=1e-6)


def test_a_return_at_the_sensor_has_no_direction_and_is_dropped():
    rays = prepare([np.array([[0.0, 0, 0], [1, 0, 0]])], np.eye(4)[None])
    assert len(rays) == len(rays.scans) == 1


def test_accumulated_scans_are_seen_from_the_middle_one():
    points, poses = scans(count=8)
    rays = prepare(points, poses, accumulate_scans=5)
    single = prepare(points, poses)
    # Scans 0 to 4 are seen from 2; of the last, incomplete group, 5 to 7, from 6.
    middle = np.array([2, 2, 2, 2, 2, 6, 6, 6])
    scan = np.repeat(np.arange(8), [len(p) for p in points])  # of each return
    sensors = poses[middle[scan], :3, 3] - rays.origin
    back = rays.points.astype(float) - rays.directions.astype(float) * rays.ranges_m[:, None]
    np.testing.assert_allclose(back, sensors, atol=5e-5)
    np.testing.assert_array_equal(rays.points, single.points)
    np.testing.assert_array_equal(rays.origin, single.origin)


def test_accumulation_does_not_change_who_is_too_near():
    points = [np.array([[1.0, 0, 0], [10, 0, 0]]), np.array([[1.0, 0, 0], [10, 0, 0]])]
    poses = np.stack([pose([0.0, 0, 0]), pose([50.0, 0, 0])])
    rays = prepare(points, poses, min_range_m=2.5, accumulate_scans=2)
    np.testing.assert_allclose(rays.points[:, 0] + rays.origin[0], [10, 60])


def test_utm_coordinates_cost_no_precision():
    offset = np.array([5e5, 5.4e6, 300.0])
    points, poses = scans()
    _, far_poses = scans(offset=offset)
    near, far = prepare(points, poses), prepare(points, far_poses)
    np.testing.assert_allclose(far.origin, near.origin + offset, rtol=1e-15)
    np.testing.assert_allclose(far.points, near.points, atol=1e-5)
    np.testing.assert_allclose(far.directions, near.directions, atol=1e-6)


def test_poses_stay_in_double_precision():
    poses = np.stack([pose([5.4e6 + 0.123, 0, 0]), pose([5.4e6 + 1.456, 0, 0])])
    rays = prepare([np.ones((1, 3), np.float32)] * 2, poses.tolist())
    assert rays.points[1, 0] - rays.points[0, 0] == pytest.approx(1.333, abs=1e-5)
    assert check_poses(np.eye(4, dtype=np.float32)[None], 1).dtype == np.float64


def test_slightly_rounded_rotations_pass():
    poses = np.stack([tilted_pose(1, [0, 0, 0])]).astype(np.float32)
    assert len(prepare([np.ones((5, 3))], poses)) == 5


def test_a_given_origin_is_used():
    points, poses = scans()
    rays = prepare(points, poses, origin=[1.0, 2.0, 3.0])
    np.testing.assert_allclose(rays.points + np.array([1.0, 2, 3]), world(points, poses), atol=1e-5)


def test_input_is_left_alone():
    points, poses = scans()
    copies = [p.copy() for p in points], poses.copy()
    for array in (*points, poses):
        array.setflags(write=False)
    prepare(points, poses, min_range_m=5)
    for before, after in zip((*copies[0], copies[1]), (*points, poses), strict=True):
        np.testing.assert_array_equal(before, after)


def test_lists_are_arrays_too():
    rays = prepare([[[1, 2, 3], [4, 5, 6]]], np.eye(4)[None].tolist(), [[1, 2]])
    assert rays.points.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert rays.intensities.tolist() == [1, 2]


@pytest.mark.parametrize("changes", [{}, {"accumulate_scans": 3}, {"min_range_m": 12.0}])
def test_scans_one_after_another_give_the_same_bits(changes):
    points, poses = scans()
    values = [np.arange(len(p), dtype=float) for p in points]
    whole = prepare(points, poses, values, **changes)
    assert whole.num_given == sum(map(len, points))
    streamed = prepare((p for p in points), poses, (v for v in values), **changes)
    for name in ("points", "directions", "ranges_m", "intensities", "scans", "origin"):
        np.testing.assert_array_equal(getattr(streamed, name), getattr(whole, name))


def test_wrong_numbers_of_scans_one_after_another():
    points, poses = scans()
    for some, values, said in (
        (points[:5], None, r"poses must have shape \(5, 4, 4\)"),
        ([*points, points[0]], None, r"poses must have shape \(8, 4, 4\)"),
        (points, [np.arange(len(p)) for p in points[:6]], "intensities holds 6 scans, points 7"),
        (points[:6], [np.arange(len(p)) for p in points], "intensities holds 7 scans, points 6"),
        ([], None, "no scans"),
    ):
        with pytest.raises(ValueError, match=said):
            prepare(iter(some), poses, None if values is None else iter(values))


def test_no_more_than_two_scans_are_held():
    points, poses = scans()
    given = []

    def stream():
        for scan in points:
            own = scan.copy()
            given.append(weakref.ref(own))
            yield own
            del own
            assert sum(scan() is not None for scan in given) <= 2

    prepare(stream(), poses)


def test_select_takes_some_rays():
    points, poses = scans()
    values = [np.arange(len(p), dtype=float) for p in points]
    rays = prepare(points, poses, values)
    parts = [rays.select(slice(first, None, 3)) for first in range(3)]
    assert sum(map(len, parts)) == len(rays)
    for name in ("points", "directions", "ranges_m", "intensities"):
        for first, part in enumerate(parts):
            np.testing.assert_array_equal(getattr(part, name), getattr(rays, name)[first::3])
    assert parts[1].directions.flags.c_contiguous
    assert prepare(points, poses).select(slice(2)).intensities is None


@pytest.mark.parametrize("chunk", [1, 7, 100, 1 << 20])
def test_points_along_rays(chunk):
    points, poses = scans(count=2)
    rays = prepare(points, poses)
    offsets = [-0.3, 0.0, 0.5]
    chunks = list(rays.along(offsets, chunk))
    assert all(len(c) <= max(chunk, len(offsets)) for c in chunks)
    along = np.concatenate(chunks).reshape(len(rays), 3, 3)
    np.testing.assert_array_equal(along[:, 1], rays.points)
    sensors = rays.points - rays.directions * rays.ranges_m[:, None]
    # Negative is before the return, positive behind it.
    for i, offset in enumerate(offsets):
        distance = np.linalg.norm(along[:, i] - sensors, axis=1)
        np.testing.assert_allclose(distance, rays.ranges_m + offset, atol=1e-5)
