"""Ready-made simulations: a lane among buildings, a sports court, a corner reflector on a wall, and a street."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from radarsdf.arrays import Floats
from radarsdf.checks import whole_number
from radarsdf.poses.rigid import assembled

from . import materials
from .materials import Material
from .radar import RadarSensor, Simulation, generator, simulate
from .world import Box, CornerReflector, Pole, Primitive, Scene, Terrain

Path = Callable[[Floats], Floats]
"""Maps curve parameters (N,), 0..1 on the driven part, to positions (N, 2), world frame, m."""

_BURIED_M = 1.0  # solids extend this far into the ground, which leaves no gap on a slope


def vary(rng: np.random.Generator, material: Material) -> Material:
    """Vary the reflectivity of a material at random, since no two objects are the same."""
    return replace(material, reflectivity_db=material.reflectivity_db + rng.normal(0, 1.5))


@dataclass
class Site:
    """Solids on the ground. New ones must overlap neither the earlier ones nor the circles `taken`: x, y, radius [m]."""

    rng: np.random.Generator
    terrain: Terrain
    taken: list[tuple[float, float, float]]
    solids: list[Primitive] = field(default_factory=list)

    def fill(
        self,
        things: Iterable[tuple[str, tuple[int, int], tuple[float, float]]],
        place: Callable[[float, float], tuple[Floats, float]],
    ) -> None:
        """Add numbers of things, by the names of their methods, at places that `place` draws, unless ten tries of one fail."""
        for name, counts, limits in things:
            for _ in range(int(self.rng.integers(*counts))):
                any(getattr(self, name)(*place(*limits)) for _ in range(10))

    def beside(self, path: Path, u: float, near: float, far: float) -> tuple[Floats, float]:
        """Random place `near` to `far` m to one side of a path at `u`, (2,), and the path's direction there, rad."""
        ahead, here = path(np.array([u + 0.01, u]))
        yaw = float(np.arctan2(*(ahead - here)[::-1]))
        side = self.rng.choice([-1.0, 1.0]) * self.rng.uniform(near, far)
        return here + side * np.array([-np.sin(yaw), np.cos(yaw)]), yaw

    def building(self, xy: Floats, yaw: float) -> bool:
        material = vary(self.rng, materials.CONCRETE if self.rng.random() < 0.5 else materials.BRICK)
        size = self.rng.uniform([9, 6, 5], [16, 9, 9])
        return self._block(xy, yaw + self.rng.normal(0, 0.15), size, material)

    def wall(self, xy: Floats, yaw: float) -> bool:
        size = self.rng.uniform([5, 0.25, 1.4], [12, 0.4, 2.6])
        return self._block(xy, yaw + self.rng.normal(0, 0.15), size, vary(self.rng, materials.CONCRETE))

    def hedge(self, xy: Floats, yaw: float) -> bool:
        size = self.rng.uniform([4, 0.7, 1.0], [14, 1.2, 2.0])
        return self._block(xy, yaw + self.rng.normal(0, 0.05), size, vary(self.rng, materials.TREE))

    def car(self, xy: Floats, yaw: float) -> bool:
        metal = vary(self.rng, materials.METAL)
        yaw, size = yaw + self.rng.normal(0, 0.05), self.rng.uniform([3.9, 1.7, 0.8], [4.8, 1.9, 1.0])
        if not self._block(xy, yaw, size, metal):
            return False
        cabin = np.array([0.5 * size[0], 0.9 * size[1], 0.6])
        self.add_box(xy, yaw, self._ground(xy) + size[2] - 0.05, cabin, metal)
        return True

    def pole(self, xy: Floats, _yaw: float) -> bool:
        """Add a lamp post of steel or the trunk of a tree."""
        tree = self.rng.random() < 0.4
        radius = self.rng.uniform(0.15, 0.3) if tree else self.rng.uniform(0.06, 0.12)
        height = self.rng.uniform(4, 8)
        material = vary(self.rng, materials.TREE if tree else materials.STEEL_POLE)
        return self.reserve([(*xy, radius)]) and self.add_pole(xy, radius, height, material)

    def tree(self, xy: Floats, _yaw: float) -> bool:
        """Add a tree with a trunk, and a crown that begins 2 to 3 m above the ground."""
        radius, crown = self.rng.uniform(0.15, 0.35), self.rng.uniform([1.2, 2.0], [2.6, 5.0])
        if not self.reserve([(*xy, 0.5 * float(crown[0]))]):
            return False
        wood, ground = vary(self.rng, materials.TREE), self._ground(xy)
        bottom = ground + self.rng.uniform(2.0, 3.0)
        self.add_pole(xy, radius, bottom - ground + _BURIED_M, wood)
        self.solids.append(Pole(np.array([*xy, bottom]), float(crown[0]), float(crown[1]), wood))
        return True

    def basket(self, xy: Floats, facing: float) -> None:
        """Add a basketball hoop: a post, and a board 0.6 m from it towards x · `facing`, where `facing` is 1 or -1."""
        if self.reserve([(*xy, 0.3)]):
            self.add_pole(xy, 0.1, 3.2, materials.STEEL_POLE)
            at, board = xy + np.array([0.6 * facing, 0.0]), np.array([0.06, 1.8, 1.05])
            self.add_box(at, 0.0, self._ground(xy) + 2.9, board, materials.METAL)

    def _ground(self, xy: Floats) -> float:
        return float(self.terrain.height(xy[None])[0])

    def reserve(self, circles: list[tuple[float, float, float]]) -> bool:
        old, new = np.array(self.taken).reshape(-1, 3), np.array(circles)
        gap = np.linalg.norm(old[:, None, :2] - new[None, :, :2], axis=2) - old[:, None, 2] - new[None, :, 2]
        if (gap < 0).any():
            return False
        self.taken += circles
        return True

    def _block(self, xy: Floats, yaw: float, size: Floats, material: Material) -> bool:
        """Put a box of length, width and height on the ground, unless it would overlap."""
        along = np.array([np.cos(yaw), np.sin(yaw)])
        spots = np.linspace(-0.5, 0.5, max(1, round(size[0] / size[1]))) * max(0.0, size[0] - size[1])
        if not self.reserve([(*(xy + s * along), 0.75 * size[1]) for s in spots]):
            return False
        bottom = self._ground(xy) - _BURIED_M
        self.add_box(xy, yaw, bottom, np.array([*size[:2], size[2] + _BURIED_M]), material)
        return True

    def add_box(self, xy: Floats, yaw: float, bottom: float, size: Floats, material: Material) -> None:
        """Add a box of a size (3,) with its lower face at the height `bottom`, m."""
        self.solids.append(Box(np.array([*xy, bottom + size[2] / 2]), size / 2, yaw, material))

    def add_pole(self, xy: Floats, radius_m: float, height_m: float, material: Material) -> bool:
        base = np.array([*xy, self._ground(xy) - _BURIED_M])
        self.solids.append(Pole(base, radius_m, height_m + _BURIED_M, material))
        return True


def along_path(
    terrain: Terrain,
    path: Path,
    frames: int,
    *,
    height_m: float,
    rng: np.random.Generator,
    look_at: Floats | None = None,
) -> Floats:
    """Poses (frames, 4, 4), T_world_sensor, at equal steps along a path, with slight heave, pitch and roll of a vehicle.

    The mean height of the sensor is `height_m`. It faces along the path, or the position `look_at` (2,), world, m.
    """
    u = (np.arange(frames) + 0.5) / frames
    xy = path(u)
    ahead = look_at - xy if look_at is not None else path(u + 1e-4) - path(u - 1e-4)
    yaw = np.arctan2(ahead[:, 1], ahead[:, 0])
    # Two sines of different frequency for each of heave, pitch and roll, so that the motion does not repeat.
    cycles, phase = rng.uniform([3, 7], [6, 12], size=(3, 2)), rng.uniform(0, 2 * np.pi, size=(3, 2))
    swing = np.sin(2 * np.pi * u[:, None, None] * cycles + phase).mean(axis=2) * [0.03, 0.02, 0.02]
    rotations = Rotation.from_euler("ZYX", np.column_stack([yaw, swing[:, 1:]]))
    heights = terrain.height(xy) + height_m + swing[:, 0]
    return assembled(rotations.as_matrix(), np.column_stack([xy, heights]))


_LAYOUT, _TRAJECTORY = 2**31 + 1, 2**31 + 2  # streams of random numbers that no scan uses

# Methods of `Site`, how many of each there are, and their distance from the path, m, or in court lengths.
_LANE = (
    ("building", (4, 8), (13, 20)), ("wall", (3, 6), (6, 11)), ("car", (6, 11), (4, 9)), ("pole", (12, 20), (3, 14)),
)  # fmt: skip
_COURT = (("building", (4, 7), (1.6, 2.0)), ("wall", (3, 6), (1.1, 1.4)), ("car", (4, 8), (1.2, 1.6)))
_STREET = (
    ("building", (5, 16), (14, 60)), ("car", (2, 12), (4, 9)), ("hedge", (4, 12), (7, 30)),
    ("wall", (1, 6), (8, 35)), ("tree", (15, 40), (7, 60)), ("pole", (8, 20), (4, 15)),
)  # fmt: skip

# Intensity ranges are those of the paper (Table II). Everything else is assumed, not measured: fields of
# view are typical, and noise and gain are chosen so that the kNN baseline has errors as on the paper's data sets.
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
# Tuned by hand to four drives of the Astyx HiRes2019 dataset, until `python -m bench.sensor` showed about the same
# figures; docs/simulation.md lists them. The receiver compensates for nearly all loss by range.
ASTYX_HIRES = RadarSensor(
    azimuth_fov_rad=np.deg2rad(115), elevation_fov_rad=np.deg2rad(13), beams=2400, min_range_m=2.0, max_range_m=102.0,
    sigma_range_m=0.093, sigma_range_per_m=0.0026, sigma_azimuth_rad=0.0036, sigma_elevation_rad=0.014, weak_noise=2.1,
    sigma_power_db=1.0, gain_db=69.0, range_loss_db=8.0, threshold_db=45.0, saturation_db=102.0, step_db=0.5,
    clutter_per_scan=10.0, clutter_near_share=0.0, clutter_power_db=9.0, phantoms_per_scan=1150.0,
    phantom_lasting_share=0.6, phantom_depth=0.05, ghost_share=0.5, sidelobe_share=0.05,
    sidelobe_fov_rad=np.deg2rad(39),
)  # fmt: skip

_DRIVES = {  # radar, default number of scans, and height of the radar above the ground, m
    "hugin": (HUGIN_A3, 120, 1.5), "oculii": (OCULII_EAGLE, 120, 1.1),
    "wall": (HUGIN_A4, 90, 1.2), "astyx": (ASTYX_HIRES, 20, 1.25),
}  # fmt: skip


def hugin(seed: int = 0, frames: int | None = None) -> Simulation:
    """Simulate a dense and accurate radar on a drive of 60 m past walls, buildings, cars and poles on rolling ground.

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
    path = _lane(60.0, sway, 70, phase)
    site = Site(rng, terrain, taken=[(x, y, 2.2) for x, y in path(np.linspace(-0.1, 1.5, 200))])
    site.fill(_LANE, lambda near, far: site.beside(path, rng.uniform(0.1, 1.45), near, far))
    return _drive("hugin", site, path, seed, frames)


def oculii(seed: int = 0, frames: int | None = None) -> Simulation:
    """Simulate a sparse and noisy radar on a lap in a sports court with hoops, posts, cars and buildings round it.

    Arguments and result are those of :func:`hugin`. The default of 120 scans gives 80,000 to 100,000 returns. Intensities are
    clipped to 0 to 36 dB, as of an Oculii Eagle. There are clutter and ghosts.
    """
    rng = generator(seed, _LAYOUT)
    terrain = Terrain.random(rng, 0.08, materials.ASPHALT)
    length, width = rng.uniform(13, 16), rng.uniform(8, 11)  # half, of the court
    start = rng.uniform(0, 2 * np.pi)

    def path(u: Floats) -> Floats:
        angle = start + 2 * np.pi * u
        return np.stack([0.6 * length * np.cos(angle), 0.6 * width * np.sin(angle)], axis=1)

    site = Site(rng, terrain, taken=[(x, y, 1.2) for x, y in path(np.linspace(0, 1, 60))])
    for end in (-1.0, 1.0):
        site.basket(np.array([end * (length - 1.0), 0.0]), facing=-end)

    def round_about(near: float, far: float) -> tuple[Floats, float]:
        angle = rng.uniform(0, 2 * np.pi)
        at = np.array([length * np.cos(angle), width * np.sin(angle)]) * rng.uniform(near, far)
        return at, float(np.arctan2(width * np.cos(angle), -length * np.sin(angle)))

    site.fill(_COURT, round_about)
    for angle in np.arange(0, 2 * np.pi, 2 * np.pi / rng.integers(14, 22)):
        corner = np.clip(1.45 * np.array([np.cos(angle), np.sin(angle)]), -1, 1)
        site.pole(corner * np.array([length, width]), 0.0)
    return _drive("oculii", site, path, seed, frames)


def wall(seed: int = 0, frames: int | None = None) -> Simulation:
    """Simulate an arc of 10 m radius round a corner reflector on a wall, for view dependence. Some walls have windows.

    Arguments and result are those of :func:`hugin`, with 90 scans by default, at -80 to 80 degrees from the normal of the wall,
    the plane x = 0. The reflector, at y = 0, is the last of `scene.solids`. Intensities are 80 to 133 dB, as of a Hugin A4.
    """
    rng = generator(seed, _LAYOUT)
    terrain = Terrain.random(rng, 0.05, materials.GRASS)
    height, half_length = rng.uniform(3.0, 4.5), rng.uniform(12.0, 16.0)
    brick = vary(rng, materials.BRICK)
    center = np.array([-0.2, rng.uniform(-1, 1), height / 2 - 0.5])
    site = Site(rng, terrain, taken=[])
    site.solids.append(Box(center, np.array([0.2, half_length, height / 2 + 0.5]), 0.0, brick))
    for y in rng.permutation([-7.5, -5.0, -2.5, 2.5, 5.0, 7.5])[: rng.integers(0, 4)]:
        size = np.array([0.04, rng.uniform(0.5, 0.9), rng.uniform(0.4, 0.7)])
        center = np.array([0.0, y, rng.uniform(1.5, 2.0)])
        site.solids.append(Box(center, size, 0.0, vary(rng, materials.GLASS)))
    mounted = np.array([0.02, 0.0, rng.uniform(1.0, 1.4)])
    edge_m = rng.uniform(0.3, 0.4)
    site.solids.append(CornerReflector(mounted, np.array([1.0, 0.0, 0.0]), edge_m, materials.REFLECTOR))
    radius = 10.0 + rng.uniform(-0.5, 0.5)

    def path(u: Floats) -> Floats:
        angle, distance = np.deg2rad(160) * (u - 0.5), radius + 0.1 * np.sin(9 * u)
        return distance[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)

    return _drive("wall", site, path, seed, frames, look_at=mounted[:2])


def astyx(seed: int = 0, frames: int | None = None) -> Simulation:
    """Simulate an automotive radar on a street: few scans, noise that grows with the range, and many false returns.

    The radar is tuned to four drives of the Astyx HiRes2019 dataset (``docs/simulation.md``); the street is similar, not a copy.

    Arguments and result are those of :func:`hugin`, with 20 scans by default, along a path of four seconds at 5 to 10 m/s.
    Intensities are 45 to 102 dB, as of an Astyx HiRes 2019. There are clutter, ghosts and side lobes.
    """
    rng = generator(seed, _LAYOUT)
    terrain = Terrain.random(rng, rng.uniform(0.05, 0.3), materials.GRASS)
    length = 4.0 * rng.uniform(5, 10)
    path = _lane(length, rng.uniform(1.0, 5.0), rng.uniform(80, 140), rng.uniform(0, 2 * np.pi))
    first, last = -10.0, length + 100.0
    site = Site(rng, terrain, taken=[(x, y, 2.8) for x, y in path(np.arange(first, last, 2.0) / length)])
    site.fill(_STREET, lambda near, far: site.beside(path, rng.uniform(first, last) / length, near, far))
    return _drive("astyx", site, path, seed, frames)


def _lane(length_m: float, sway_m: float, wave_m: float, phase: float) -> Path:
    def path(u: Floats) -> Floats:
        x = length_m * u
        return np.stack([x, sway_m * np.sin(2 * np.pi * x / wave_m + phase)], axis=1)

    return path


def _drive(
    name: str, site: Site, path: Path, seed: int, frames: int | None, look_at: Floats | None = None
) -> Simulation:
    sensor, scans, height_m = _DRIVES[name]
    count = scans if frames is None else whole_number(frames, "frames", 1)
    rng = generator(seed, _TRAJECTORY)
    poses = along_path(site.terrain, path, count, height_m=height_m, rng=rng, look_at=look_at)
    return simulate(Scene(site.solids, site.terrain), sensor, poses, name=name, seed=seed)


SCENES: dict[str, Callable[..., Simulation]] = {s.__name__: s for s in (hugin, oculii, wall, astyx)}
"""Simulations by name; each takes `seed` and `frames`."""
