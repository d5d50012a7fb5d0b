"""Scans of a wall, for tests of returns."""

import numpy as np


def a_wall(
    noise_range_m=0.05, noise_angle_rad=0.01, noise_elevation_rad=None, scans=8, returns=1500, ghosts=0
):
    """Scans of the ground and of a wall at x = 15; the last `ghosts` of each lie behind the wall, or below the ground."""
    rng = np.random.default_rng(0)
    points, poses, is_ghost = [], [], []
    for i in range(scans):
        T_world_sensor = np.eye(4)
        T_world_sensor[:3, 3] = [0.5 * i, 0.5 * np.sin(i), 1.5]
        half = returns // 2
        ground = np.column_stack([rng.uniform(4, 15, half), rng.uniform(-5, 5, half), np.zeros(half)])
        wall = np.column_stack([np.full(half, 15.0), rng.uniform(-5, 5, half), rng.uniform(0, 4, half)])
        rays = np.concatenate([ground, wall]) - T_world_sensor[:3, 3]
        range_m = np.linalg.norm(rays, axis=1, keepdims=True)
        errors = noise_angle_rad * rng.normal(size=rays.shape)
        if noise_elevation_rad is not None:
            azimuth = np.cross([0, 0, 1], rays)
            azimuth /= np.linalg.norm(azimuth, axis=1, keepdims=True)
            elevation = np.cross(rays / range_m, azimuth)
            errors = (
                errors[:, :1] * azimuth + noise_elevation_rad * rng.normal(size=range_m.shape) * elevation
            )
        rays = rays / range_m + errors
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        measured = rays * (range_m + noise_range_m * rng.normal(size=range_m.shape))
        mirrored = measured[-ghosts:] * rng.uniform(1.15, 1.5, (ghosts, 1)) if ghosts else measured[:0]
        points.append(np.concatenate([measured, mirrored]))
        is_ghost.append(np.arange(len(points[-1])) >= len(measured))
        poses.append(T_world_sensor)
    return points, np.stack(poses), np.concatenate(is_ghost)


def stated_wall():
    """Scans of a wall; every second return has five times the noise; deviations of elevation are overstated 100 times."""
    walls = [a_wall(scale * 0.03, scale * 0.003) for scale in (1, 5)]
    points = [
        np.where(np.arange(len(a))[:, None] % 2, b, a) for a, b in zip(walls[0][0], walls[1][0], strict=True)
    ]
    scales = [np.where(np.arange(len(scan)) % 2, 5, 1)[:, None] for scan in points]
    return points, walls[0][1], [scale * [0.03, 0.003, 0.3] for scale in scales]


def distance_from_wall_m(mesh):
    x, y, z = mesh.vertices.T
    return np.abs(x[(np.abs(y) < 4) & (z > 0.7) & (z < 3.5)] - 15).mean()
