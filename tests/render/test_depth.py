"""Depth images against the plane and the wall of a simple scene."""

import numpy as np
import pytest


def test_depth_normals_and_confidence_of_a_wall_and_the_ground(sharp_map):
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    T_world_camera[:3, 3] = [8, 0, 1.5]
    K = [[60, 0, 30], [0, 60, 20], [0, 0, 1]]
    image = sharp_map.render_depth(T_world_camera, K, (61, 41))
    assert image.depth_m.shape == image.confidence.shape == (41, 61)
    wall, ground = image.depth_m[15:20, 20:40], image.depth_m[34:, 20:40]
    assert np.nanmax(np.abs(wall - 12)) < 0.1
    assert np.isfinite(wall).mean() > 0.95
    expected = np.broadcast_to(1.5 * 60 / (np.arange(34, 41) - 20)[:, None], ground.shape)
    assert np.nanmax(np.abs(ground - expected)) < 0.3
    assert np.isfinite(ground).mean() > 0.8
    assert np.nanmin(image.normals[15:20, 20:40] @ [-1, 0, 0]) > 0.97
    assert np.nanmin(image.normals[34:, 20:40] @ [0, 0, 1]) > 0.97
    assert np.nanmedian(image.confidence[15:20, 20:40]) > 0.8
    assert np.isnan(image.depth_m[0]).all()  # the sky
    np.testing.assert_array_equal(np.isnan(image.depth_m), np.isnan(image.confidence))
    nothing = sharp_map.render_depth(T_world_camera, K, (61, 41), max_range_m=2.0)
    assert np.isnan(nothing.depth_m).all()
    for camera, size, match in (
        (np.zeros((3, 3)), (2, 2), "camera"),
        (np.eye(4), (2, 2), "camera"),
        (K, (0, 2), "size"),
    ):
        with pytest.raises(ValueError, match=match):
            sharp_map.render_depth(T_world_camera, camera, size)
