# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Ready-made simulations: a lane among buildings, a sports court, a corner reflector on a wall, and a street."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from radarsdf.checks import whole_number

from . import materials
from .materials import Material
from .radar import RadarSensor, generator
from .simulation import Simulation, simulate
from .world import Box, CornerReflector, Pole, Primitive, Scene, Terrain

__all__ = ["SCENES", "astyx", "hugin", "oculii", "wall"]

FloatArray = NDArray[np.float64]
Path = Callable[[FloatArray], FloatArray]
"""Maps values (N,), 0..1 for those that are driven, to positions (N, 2), world frame, m."""

_BURIED_M = 1.0  # solids reach this far into the ground, so that they have no gap to the ground on a slope


def vary(rng: np.random.Generator, material: Material) -> Material:
    """The material with a random change of its reflectivity, since no two objects are the same."""
    return replace(material, reflectivity_db=material.reflectivity_db + rng.normal(0, 1.5))


class Site:
    """Solids on the ground. A new one must not overlap the earlier ones, nor the circles `taken`: x, y, radius [m]."""

    def __init__(
        self, rng: np.random.Generator, terrain: Terrain, taken: list[tuple[float, float, float]]
    ) -> None:
        self.solids: list[Primitive] = []
        self._rng, self._terrain = rng, terrain
        self._taken = list(taken)  # circles: x, y, radius [m]

    def _free(self, circles: list[tuple[float, float, float]]) -> bool:
        old, new = np.array(self._taken).reshape(-1, 3), np.array(circles)
        gap = np.linalg.norm(old[:, None, :2] - new[None, :, :2], axis=2) - old[:, None, 2] - new[None, :, 2]
        if (gap < 0).any():
            return False
        self._taken += circles
        return True

    def _block(self, xy: FloatArray, yaw: float, size: FloatArray, material: Material) -> bool:
        """Put a box of length, width and height on the ground, unless it would overlap."""
        along = np.array([np.cos(yaw), np.sin(yaw)])
        spots = np.linspace(-0.5, 0.5, max(1, round(size[0] / size[1]))) * max(0.0, size[0] - size[1])
        if not self._free([(*(xy + s * along), 0.75 * size[1]) for s in spots]):
            return False
        ground = float(self._terrain.height(xy[None])[0])
        self._add_box(xy, yaw, ground - _BURIED_M, np.array([*size[:2], size[2] + _BURIED_M]), material)
        return True

    def _add_box(
        self, xy: FloatArray, yaw: float, bottom: float, size: FloatArray, material: Material
    ) -> None:
        self.solids.append(Box(np.array([*xy, bottom + size[2] / 2]), size / 2, yaw, material))

    def beside(self, path: Path, u: float, near: float, far: float) -> tuple[FloatArray, float]:
        """A random place `near` to `far` m to one side of where a path is at `u`, (2,), and its direction there, rad."""
        ahead, here = path(np.array([u + 0.01, u]))
        yaw = float(np.arctan2(*(ahead - here)[::-1]))
        side = self._rng.choice([-1.0, 1.0]) * self._rng.uniform(near, far)
        return here + side * np.array([-np.sin(yaw), np.cos(yaw)]), yaw

    def fill(
        self,
        count: int,
        put: Callable[[FloatArray, float], bool],
        where: Callable[[], tuple[FloatArray, float]],
    ) -> None:
        """Put `count` objects at random places. Each has ten tries, and is left out if all fail."""
        for _ in range(count):
            any(put(*where()) for _ in range(10))

    def building(self, xy: FloatArray, yaw: float) -> bool:
        """A building of concrete or brick, 9 to 16 m long."""
        material = vary(self._rng, materials.CONCRETE if self._rng.random() < 0.5 else materials.BRICK)
        size = self._rng.uniform([9, 6, 5], [16, 9, 9])
        return self._block(xy, yaw + self._rng.normal(0, 0.15), size, material)

    def wall(self, xy: FloatArray, yaw: float) -> bool:
        """A free-standing wall, 1.4 to 2.6 m high."""
        size = self._rng.uniform([5, 0.25, 1.4], [12, 0.4, 2.6])
        return self._block(xy, yaw + self._rng.normal(0, 0.15), size, vary(self._rng, materials.CONCRETE))

    def car(self, xy: FloatArray, yaw: float) -> bool:
        """A car of two boxes: the body, and the cabin on top."""
        metal = vary(self._rng, materials.METAL)
        yaw, size = yaw + self._rng.normal(0, 0.05), self._rng.uniform([3.9, 1.7, 0.8], [4.8, 1.9, 1.0])
        if not self._block(xy, yaw, size, metal):
            return False
        roof = float(self._terrain.height(xy[None])[0]) + size[2]
        self._add_box(xy, yaw, roof - 0.05, np.array([0.5 * size[0], 0.9 * size[1], 0.6]), metal)
        return True

    def pole(self, xy: FloatArray, _yaw: float) -> bool:
        """A lamp post of steel or the trunk of a tree."""
        tree = self._rng.random() < 0.4
        radius = self._rng.uniform(0.15, 0.3) if tree else self._rng.uniform(0.06, 0.12)
        height = self._rng.uniform(4, 8)
        material = vary(self._rng, materials.TREE if tree else materials.STEEL_POLE)
        if not self._free([(*xy, radius)]):
            return False
        base = float(self._terrain.height(xy[None])[0]) - _BURIED_M
        self.solids.append(Pole(np.array([*xy, base]), radius, height + _BURIED_M, material))
        return True

    def hedge(self, xy: FloatArray, yaw: float) -> bool:
        """A hedge along a road, 1 to 2 m high."""
        size = self._rng.uniform([4, 0.7, 1.0], [14, 1.2, 2.0])
        return self._block(xy, yaw + self._rng.normal(0, 0.05), size, vary(self._rng, materials.TREE))

    def fence(self, xy: FloatArray, yaw: float) -> bool:
        """A fence along a path: posts 2 m apart, and two rails."""
        steps, height = int(self._rng.integers(3, 7)), self._rng.uniform(1.1, 1.8)
        along = np.array([np.cos(yaw), np.sin(yaw)])
        spots = [xy + 2.0 * (i - steps / 2) * along for i in range(steps + 1)]
        if not self._free([(*spot, 0.5) for spot in spots]):
            return False
        wood = vary(self._rng, materials.TREE)
        ground = self._terrain.height(np.array(spots))
        for spot, base in zip(spots, ground, strict=True):
            self.solids.append(Pole(np.array([*spot, base - _BURIED_M]), 0.05, height + _BURIED_M, wood))
        for share in (0.4, 0.9):
            bottom = float(ground.mean()) + share * height
            self._add_box(xy, yaw, bottom, np.array([2.0 * steps, 0.05, 0.12]), wood)
        return True

    def tree(self, xy: FloatArray, _yaw: float) -> bool:
        """A trunk, and a crown that begins 2 to 3 m above the ground."""
        radius, crown = self._rng.uniform(0.15, 0.35), self._rng.uniform([1.2, 2.0], [2.6, 5.0])
        if not self._free([(*xy, 0.5 * float(crown[0]))]):
            return False
        wood, ground = vary(self._rng, materials.TREE), float(self._terrain.height(xy[None])[0])
        bottom = ground + self._rng.uniform(2.0, 3.0)
        base = np.array([*xy, ground - _BURIED_M])
        self.solids.append(Pole(base, radius, bottom - ground + 2 * _BURIED_M, wood))
        self.solids.append(Pole(np.array([*xy, bottom]), float(crown[0]), float(crown[1]), wood))
        return True

    def basket(self, xy: FloatArray, facing: float) -> None:
        """A basketball hoop: a post, and a board 0.6 m from it towards x · `facing`, where `facing` is 1 or -1."""
        base = float(self._terrain.height(xy[None])[0])
        if self._free([(*xy, 0.3)]):
            foot = np.array([*xy, base - _BURIED_M])
            self.solids.append(Pole(foot, 0.1, 3.2 + _BURIED_M, materials.STEEL_POLE))
            board = np.array([0.06, 1.8, 1.05])
            self._add_box(xy + np.array([0.6 * facing, 0.0]), 0.0, base + 2.9, board, materials.METAL)


def along_path(
    terrain: Terrain,
    path: Callable[[FloatArray], FloatArray],
    frames: int,
    *,
    height_m: float,
    rng: np.random.Generator,
    look_at: FloatArray | None = None,
) -> FloatArray:
    """Poses (frames, 4, 4), T_world_sensor, at equal steps along a path, with a little heave, pitch and roll as of a vehicle.

    The sensor is `height_m` above the ground in the mean. It looks ahead, or at the position `look_at` (2,), world, m.
    """
    u = (np.arange(frames) + 0.5) / frames
    xy = path(u)
    ahead = look_at - xy if look_at is not None else path(u + 1e-4) - path(u - 1e-4)
    yaw = np.arctan2(ahead[:, 1], ahead[:, 0])
    # Two sines of different frequency for each of heave, pitch and roll, so that the motion does not repeat.
    cycles, phase = rng.uniform([3, 7], [6, 12], size=(3, 2)), rng.uniform(0, 2 * np.pi, size=(3, 2))
    swing = np.sin(2 * np.pi * u[:, None, None] * cycles + phase).mean(axis=2) * [0.03, 0.02, 0.02]
    poses = np.tile(np.eye(4), (frames, 1, 1))
    angles = np.stack([yaw, swing[:, 1], swing[:, 2]], axis=1)
    poses[:, :3, :3] = Rotation.from_euler("ZYX", angles).as_matrix()
    poses[:, :2, 3] = xy
    poses[:, 2, 3] = terrain.height(xy) + height_m + swing[:, 0]
    return poses


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

    rng = generator(seed, _TRAJECTORY)
    poses = along_path(terrain, path, _frames(frames, 90), height_m=1.2, rng=rng, look_at=mounted[:2])
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
