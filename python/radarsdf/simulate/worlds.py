# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Ready-made simulations: a lane among buildings, a sports court, a corner reflector on a wall, and a street."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from radarsdf.checks import whole_number

from . import materials
from .primitives import Box, CornerReflector, Primitive
from .radar import RadarSensor, generator
from .scene import Scene
from .simulation import Simulation, simulate
from .site import Site, vary
from .terrain import Terrain
from .trajectory import along_path

__all__ = ["SCENES", "astyx", "hugin", "oculii", "wall"]

FloatArray = NDArray[np.float64]

_LAYOUT, _TRAJECTORY = 2**31 + 1, 2**31 + 2  # streams of random numbers that no scan has

# The ranges of intensities are those of the paper (Table II). Everything else is assumed, not measured: the fields of
# view are usual ones, and noise and gain are chosen so that the kNN baseline has errors as on the paper's data sets.
HUGIN_A3 = RadarSensor(
    azimuth_fov_rad=np.deg2rad(110), elevation_fov_rad=np.deg2rad(30), beams=2950, max_range_m=50.0,
    sigma_range_m=0.06, sigma_azimuth_rad=np.deg2rad(0.4), sigma_elevation_rad=np.deg2rad(0.6), sigma_power_db=1.0,
    gain_db=138.0, threshold_db=64.0, saturation_db=118.0, step_db=0.1, clutter_per_scan=25.0, ghost_share=1.0,
)  # fmt: skip
HUGIN_A4 = replace(
    HUGIN_A3, azimuth_fov_rad=np.deg2rad(90), beams=1500, max_range_m=30.0, gain_db=152.0,
    threshold_db=80.0, saturation_db=133.0, clutter_per_scan=8.0,
)  # fmt: skip
OCULII_EAGLE = RadarSensor(
    azimuth_fov_rad=np.deg2rad(113), elevation_fov_rad=np.deg2rad(44), beams=1040, max_range_m=50.0,
    sigma_range_m=0.1, sigma_azimuth_rad=np.deg2rad(0.9), sigma_elevation_rad=np.deg2rad(1.3), sigma_power_db=2.5,
    gain_db=66.0, threshold_db=-1.0, floor_db=0.0, saturation_db=36.0, step_db=0.5,
    clutter_per_scan=30.0, ghost_share=0.5,
)  # fmt: skip
# Fitted by hand to four drives of the Astyx HiRes2019 dataset, until `python -m bench.sensor` showed about the same
# figures; docs/simulation.md has them. The receiver makes up for nearly all loss by range.
ASTYX_HIRES = RadarSensor(
    azimuth_fov_rad=np.deg2rad(115), elevation_fov_rad=np.deg2rad(13), beams=2400, min_range_m=2.0, max_range_m=102.0,
    sigma_range_m=0.093, sigma_range_per_m=0.0026, sigma_azimuth_rad=0.0036, sigma_elevation_rad=0.014, weak_noise=2.1,
    sigma_power_db=1.0, gain_db=69.0, range_loss_db=8.0, threshold_db=45.0, saturation_db=102.0, step_db=0.5,
    clutter_per_scan=10.0, clutter_near_share=0.0, clutter_power_db=9.0, phantoms_per_scan=1150.0,
    phantom_lasting_share=0.6, phantom_depth=0.05, ghost_share=0.5, sidelobe_share=0.05,
    sidelobe_fov_rad=np.deg2rad(39),
)  # fmt: skip


def _frames(frames: int | None, default: int) -> int:
    return default if frames is None else whole_number(frames, "frames", 1)


def hugin(seed: int = 0, frames: int | None = None) -> Simulation:
    """A dense and accurate radar on a drive of 60 m past walls, buildings, cars and poles on rolling ground.

    Parameters
    ----------
    seed : int
        Seed of layout, path and noise.
    frames : int, optional
        Number of scans, always along the whole path. Default: 120, with 170,000 to 220,000 returns.

    Returns
    -------
    Simulation
        Intensities are 64 to 118 dB, as of a Hugin A3.
    """
    rng = generator(seed, _LAYOUT)
    terrain = Terrain.random(rng, 0.45, materials.GRASS)
    sway, phase = rng.uniform(1.0, 3.5), rng.uniform(0, 2 * np.pi)

    def path(u: FloatArray) -> FloatArray:
        x = 60.0 * u
        return np.stack([x, sway * np.sin(2 * np.pi * x / 70 + phase)], axis=1)

    lane = path(np.linspace(-0.1, 1.5, 200))
    site = Site(rng, terrain, taken=[(x, y, 2.2) for x, y in lane])

    def beside(near: float, far: float) -> tuple[FloatArray, float]:
        return site.beside(path, rng.uniform(0.1, 1.45), near, far)

    site.fill(int(rng.integers(4, 8)), site.building, lambda: beside(13, 20))
    site.fill(int(rng.integers(3, 6)), site.wall, lambda: beside(6, 11))
    site.fill(int(rng.integers(6, 11)), site.car, lambda: beside(4, 9))
    site.fill(int(rng.integers(12, 20)), site.pole, lambda: beside(3, 14))
    poses = along_path(terrain, path, _frames(frames, 120), height_m=1.5, rng=generator(seed, _TRAJECTORY))
    return simulate(Scene(site.solids, terrain), HUGIN_A3, poses, name="hugin", seed=seed)


def oculii(seed: int = 0, frames: int | None = None) -> Simulation:
    """A sparse and noisy radar on a lap in a sports court with hoops and fence posts, cars and buildings behind them.

    Parameters
    ----------
    seed : int
        Seed of layout, path and noise.
    frames : int, optional
        Number of scans, always along the whole lap. Default: 120, with 80,000 to 100,000 returns.

    Returns
    -------
    Simulation
        Intensities are clipped to 0 to 36 dB, as of an Oculii Eagle. There are clutter and ghosts.
    """
    rng = generator(seed, _LAYOUT)
    terrain = Terrain.random(rng, 0.08, materials.ASPHALT)
    length, width = rng.uniform(13, 16), rng.uniform(8, 11)  # half, of the court
    start = rng.uniform(0, 2 * np.pi)

    def path(u: FloatArray) -> FloatArray:
        angle = start + 2 * np.pi * u
        return np.stack([0.6 * length * np.cos(angle), 0.6 * width * np.sin(angle)], axis=1)

    site = Site(rng, terrain, taken=[(x, y, 1.2) for x, y in path(np.linspace(0, 1, 60))])
    for end in (-1.0, 1.0):
        site.basket(np.array([end * (length - 1.0), 0.0]), facing=-end)

    def round_about(near: float, far: float) -> tuple[FloatArray, float]:
        angle = rng.uniform(0, 2 * np.pi)
        at = np.array([length * np.cos(angle), width * np.sin(angle)]) * rng.uniform(near, far)
        return at, float(np.arctan2(width * np.cos(angle), -length * np.sin(angle)))

    site.fill(int(rng.integers(4, 7)), site.building, lambda: round_about(1.6, 2.0))
    site.fill(int(rng.integers(3, 6)), site.wall, lambda: round_about(1.1, 1.4))
    site.fill(int(rng.integers(4, 8)), site.car, lambda: round_about(1.2, 1.6))
    for angle in np.arange(0, 2 * np.pi, 2 * np.pi / rng.integers(14, 22)):
        corner = np.clip(1.45 * np.array([np.cos(angle), np.sin(angle)]), -1, 1)
        site.pole(corner * np.array([length, width]), 0.0)
    poses = along_path(terrain, path, _frames(frames, 120), height_m=1.1, rng=generator(seed, _TRAJECTORY))
    return simulate(Scene(site.solids, terrain), OCULII_EAGLE, poses, name="oculii", seed=seed)


def wall(seed: int = 0, frames: int | None = None) -> Simulation:
    """A scene for view dependence: an arc of 10 m radius round a corner reflector on a wall. Some walls have windows.

    Parameters
    ----------
    seed : int
        Seed of layout, path and noise.
    frames : int, optional
        Number of scans, between -80 and 80 degrees from the normal of the wall. Default: 90.

    Returns
    -------
    Simulation
        Intensities are 80 to 133 dB, as of a Hugin A4. The front of the wall is the plane x = 0. The reflector is at
        y = 0 and is the last of `scene.solids`.
    """
    rng = generator(seed, _LAYOUT)
    terrain = Terrain.random(rng, 0.05, materials.GRASS)
    height, half_length = rng.uniform(3.0, 4.5), rng.uniform(12.0, 16.0)
    brick = vary(rng, materials.BRICK)
    solids: list[Primitive] = [
        Box(np.array([-0.2, rng.uniform(-1, 1), height / 2 - 0.5]), np.array([0.2, half_length, height / 2 + 0.5]),
            0.0, brick)
    ]  # fmt: skip
    for y in rng.permutation([-7.5, -5.0, -2.5, 2.5, 5.0, 7.5])[: rng.integers(0, 4)]:
        size = np.array([0.04, rng.uniform(0.5, 0.9), rng.uniform(0.4, 0.7)])
        solids.append(Box(np.array([0.0, y, rng.uniform(1.5, 2.0)]), size, 0.0, vary(rng, materials.GLASS)))
    mounted = np.array([0.02, 0.0, rng.uniform(1.0, 1.4)])
    reflector = CornerReflector(
        mounted, np.array([1.0, 0.0, 0.0]), rng.uniform(0.3, 0.4), materials.REFLECTOR
    )
    radius = 10.0 + rng.uniform(-0.5, 0.5)

    def path(u: FloatArray) -> FloatArray:
        angle = np.deg2rad(160) * (u - 0.5)
        xy: FloatArray = (radius + 0.1 * np.sin(9 * u))[:, None] * np.stack(
            [np.cos(angle), np.sin(angle)], axis=1
        )
        return xy

    poses = along_path(
        terrain,
        path,
        _frames(frames, 90),
        height_m=1.2,
        rng=generator(seed, _TRAJECTORY),
        look_at=mounted[:2],
    )
    return simulate(Scene([*solids, reflector], terrain), HUGIN_A4, poses, name="wall", seed=seed)


def astyx(seed: int = 0, frames: int | None = None) -> Simulation:
    """An automotive radar on a street: few scans, noise that grows with the range, and many false returns.

    The radar is fitted to four drives of the Astyx HiRes2019 dataset (r0009_0024, r0057_0068, r0133_0142, r0144_0167):
    returns per scan, distances to lidar points, deviations from planes through them along beam, azimuth and elevation,
    those of strong and of weak returns, and false returns, each by range. The world is a street of their kind, not a
    copy. r0309_0320 was left out to confirm: its noise in elevation agrees, it has more false returns. ``docs/simulation.md`` has
    the figures.

    Parameters
    ----------
    seed : int
        Seed of layout, path and noise.
    frames : int, optional
        Number of scans, always along the whole path: four seconds at 5 to 10 m/s. Default: 20.

    Returns
    -------
    Simulation
        Intensities are 45 to 102 dB, as of an Astyx HiRes 2019. There are clutter, ghosts and side lobes.
    """
    rng = generator(seed, _LAYOUT)
    terrain = Terrain.random(rng, rng.uniform(0.05, 0.3), materials.GRASS)
    length = 4.0 * rng.uniform(5, 10)
    sway, wave, phase = rng.uniform(1.0, 5.0), rng.uniform(80, 140), rng.uniform(0, 2 * np.pi)

    def path(u: FloatArray) -> FloatArray:
        x = length * u
        return np.stack([x, sway * np.sin(2 * np.pi * x / wave + phase)], axis=1)

    first, last = -10.0, length + 100.0
    road = path(np.arange(first, last, 2.0) / length)
    site = Site(rng, terrain, taken=[(x, y, 2.8) for x, y in road])

    def beside(near: float, far: float) -> tuple[FloatArray, float]:
        return site.beside(path, rng.uniform(first, last) / length, near, far)

    site.fill(int(rng.integers(5, 16)), site.building, lambda: beside(14, 60))
    site.fill(int(rng.integers(2, 12)), site.car, lambda: beside(4, 9))
    site.fill(int(rng.integers(4, 12)), site.hedge, lambda: beside(7, 30))
    site.fill(int(rng.integers(1, 6)), site.wall, lambda: beside(8, 35))
    site.fill(int(rng.integers(15, 40)), site.tree, lambda: beside(7, 60))
    site.fill(int(rng.integers(8, 20)), site.pole, lambda: beside(4, 15))
    poses = along_path(terrain, path, _frames(frames, 20), height_m=1.25, rng=generator(seed, _TRAJECTORY))
    return simulate(Scene(site.solids, terrain), ASTYX_HIRES, poses, name="astyx", seed=seed)


SCENES: dict[str, Callable[..., Simulation]] = {
    "hugin": hugin,
    "oculii": oculii,
    "wall": wall,
    "astyx": astyx,
}
