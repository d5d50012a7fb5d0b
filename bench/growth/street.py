"""A simulated street of any length with any number of returns: fast to compute, with a known true surface.

There are walls 25 m to the left and right of a straight path and one at each end, and flat ground 2 m below the sensor.
Rays without a hit within 100 m give clutter at 30 to 100 m, and a tenth of the returns within 70 m are ghosts. The
intensity in dB follows the radar equation: it falls with the fourth power of the range, and differs between stripes of
the walls.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

_MAX_SCAN = 5000  # returns
_MAX_STEP_M = 10.0  # between scans
_WALL_M = 25.0
_HEIGHT_M = 2.0
_REACH_M = 100.0
_NUM_HITS = 20_000


@dataclass(frozen=True)
class Street:
    """F scans along the street from one end to the other."""

    points: list[NDArray[np.float32]]
    """F arrays (N_i, 3), sensor frame, m, with axes parallel to those of the world."""
    poses: NDArray[np.float64]
    """(F, 4, 4) T_world_sensor."""
    intensities: list[NDArray[np.float32]]
    """F arrays (N_i,), dB."""
    hits: NDArray[np.float32]
    """(M, 3) points on the true surfaces that caused returns, world frame, m."""
    hit_intensities: NDArray[np.float32]
    """(M,) intensities of `hits` without noise, dB."""
    hit_sensors: NDArray[np.float32]
    """(M, 3) positions of the sensor for `hits`, world frame, m."""


def street(count: int, size_m: float | None = None, num_hits: int = _NUM_HITS) -> Street:
    """Simulate a street with `count` returns, with the truth of about `num_hits` of them.

    Its length is `size_m`, by default 200 m + 1 m per 5,000 returns, which keeps their density almost constant.
    """
    poses, points, intensities, truths = [], [], [], []
    for pose, scan, intensity, *truth in street_scans(count, size_m):
        poses.append(pose)
        points.append(scan)
        intensities.append(intensity)
        truths.append(truth)
    some = slice(-(-num_hits // len(poses)))
    truths = [[part[some] for part in truth] for truth in truths]
    hits, hit_intensities, hit_sensors = (np.concatenate(parts) for parts in zip(*truths, strict=True))
    return Street(points, np.stack(poses), intensities, hits, hit_intensities, hit_sensors)


def street_scans(count: int, size_m: float | None = None) -> Iterator[tuple[NDArray[Any], ...]]:
    """Yield the scans of :func:`street`: pose, points, intensities, and the truth of the true returns."""
    size_m = 200 + count / 5000 if size_m is None else size_m
    rng = np.random.default_rng(0)
    frames = max(-(-count // _MAX_SCAN), round(size_m / _MAX_STEP_M), 2)
    for frame in range(frames):
        pose = np.eye(4)
        pose[0, 3], pose[2, 3] = (frame + 0.5) / frames * size_m, _HEIGHT_M
        own = count * (frame + 1) // frames - count * frame // frames
        yield pose, *_scan(own, pose[:3, 3].astype(np.float32), np.float32(size_m), rng)


def _scan(
    count: int, sensor: NDArray[np.float32], size_m: np.float32, rng: np.random.Generator
) -> tuple[NDArray[np.float32], ...]:
    """Points and intensities of one scan; hits, noiseless intensities and sensor positions of the true returns."""
    azimuth = rng.random(count, np.float32) * np.float32(2 * np.pi)
    elevation = rng.random(count, np.float32) * np.float32(0.31) - np.float32(0.06)
    flat = np.cos(elevation)
    rays = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], 1)
    with np.errstate(divide="ignore"):
        walls_m = np.float32(_WALL_M) / np.abs(rays[:, 1])
        ends_m = np.where(rays[:, 0] > 0, size_m - sensor[0], sensor[0]) / np.abs(rays[:, 0])
        ground_m = np.where(rays[:, 2] < 0, -sensor[2] / rays[:, 2], np.float32(np.inf))
    hit_m = np.minimum(np.minimum(walls_m, ends_m), ground_m)
    is_hit = hit_m < _REACH_M
    range_m = np.where(is_hit, hit_m, 30 + 70 * rng.random(count, np.float32))
    is_ghost = is_hit & (hit_m < 0.7 * _REACH_M) & (rng.random(count, np.float32) < 0.1)
    hits = sensor + rays * range_m[:, None]
    stripe = np.sin(hits[:, 0] * np.float32(0.5)) * np.where(ground_m > hit_m, np.float32(6), np.float32(0))
    ideal = (100 + stripe - 40 * np.log10(range_m)).astype(np.float32)
    true = is_hit & ~is_ghost
    range_m *= np.where(is_ghost, 1.1 + np.float32(0.3) * rng.random(count, np.float32), np.float32(1))
    range_m += np.float32(0.05) * rng.standard_normal(count, np.float32)
    noisy = rays + np.float32(0.005) * rng.standard_normal(rays.shape, np.float32)
    noisy *= (range_m / np.linalg.norm(noisy, axis=1))[:, None]
    intensity = ideal + np.float32(2) * rng.standard_normal(count, np.float32)
    return noisy, intensity, hits[true], ideal[true], np.broadcast_to(sensor, hits.shape)[true]
