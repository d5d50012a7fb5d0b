"""Preparation: from sensor frames to rays of one local frame."""

import numpy as np
import pytest
from radarsdf import LiveMap
from radarsdf.returns.rays import check_scans, prepare

from ..conftest import pose


def tilted_pose(seed, position):
    """A rotation about all three axes, which exposes transposed matrices and swapped axes."""
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
    rays = prepare(iter(points), poses)
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


def test_returns_and_intensities_are_selected_by_range_from_the_sensor():
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
    # Both bounds are inclusive.
    assert rays.intensities.tolist() == [2, 3, 4, 6]
    sensors = rays.points - rays.directions * rays.ranges_m[:, None] + rays.origin
    np.testing.assert_allclose(sensors, poses[[0, 0, 1, 1], :3, 3], atol=1e-4)
    np.testing.assert_allclose(rays.ranges_m, [2.5, 7, 60, 5], rtol=1e-6)


def test_accumulated_scans_are_seen_from_the_middle_one():
    points, poses = scans(count=8)
    rays = prepare(points, poses, accumulate_scans=5)
    single = prepare(points, poses)
    # The origin of scans 0 to 4 is that of scan 2; of the last, incomplete group 5 to 7 that of scan 6.
    middle = np.array([2, 2, 2, 2, 2, 6, 6, 6])
    scan = np.repeat(np.arange(8), [len(p) for p in points])  # of each return
    sensors = poses[middle[scan], :3, 3] - rays.origin
    back = rays.points.astype(float) - rays.directions.astype(float) * rays.ranges_m[:, None]
    np.testing.assert_allclose(back, sensors, atol=5e-5)
    np.testing.assert_array_equal(rays.points, single.points)
    np.testing.assert_array_equal(rays.origin, single.origin)


@pytest.mark.parametrize("share", [0.01, 0.8])
@pytest.mark.parametrize("far_m", [6553.5, 65_535.0, 1e6])
def test_returns_that_no_radar_measures_are_left_out_and_counted(share, far_m):
    rng = np.random.default_rng(0)
    scan = rng.normal(size=(2000, 3)) * [20, 20, 2]
    scan[0] = 300.0  # far, but possible
    kept, _, left_out = check_scans([scan])
    assert left_out.notes == []
    assert kept[0] is scan
    far = rng.random(len(scan)) < share
    scan[far] *= far_m / np.linalg.norm(scan[far], axis=1, keepdims=True)
    kept, _, left_out = check_scans([scan.astype(np.float32)])
    assert (left_out.far, left_out.rows) == (far.sum(), 0)
    assert ((kept[0] == 0).all(axis=1) == far).all()
    done = LiveMap().integrate(scan, np.eye(4))
    assert done.far == far.sum()
