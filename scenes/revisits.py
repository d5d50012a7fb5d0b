"""Places visited again: another day's drive, sessions that overlap, and places that look alike in several positions."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import compress, product
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray
from radarsdf.simulate import (
    SCENES,
    Box,
    Pole,
    Primitive,
    RadarSensor,
    Scene,
    Simulation,
    Terrain,
    materials,
    simulate,
)
from radarsdf.simulate.radar import generator
from radarsdf.simulate.scenes import HUGIN_A4, Path, along_path
from scipy.spatial.transform import Rotation, Slerp

from scenes.kinds import KINDS

__all__ = ["PLACES", "SYMMETRIC", "Sessions", "another_day", "scan_rate_hz", "sessions", "weaker"]

Floats = NDArray[np.float64]

_FRAMES = 24  # scans of another day
_ASIDE_M = 1.0  # paths are free of solids to 1.2 m on each side
_LAYOUT, _TRAJECTORY, _DAY = 2**31 + 1, 2**31 + 2, 2**31 + 4  # streams of random numbers that no scan uses
_RATE_HZ = 10.0
_JUMP_M = 5.0  # farthest that a vehicle drives between two scans, at 50 m/s
_MOST_MPS2 = 8.0  # horizontal acceleration that tyres transmit
_STAYS_M = 8.0  # radius of solids such as façades and the walls of halls, which stay
_SHORT = replace(HUGIN_A4, max_range_m=20.0)
_ELSEWHERE = 500  # added to the seed of a place for another one of its kind


def weaker(sensor: RadarSensor) -> RadarSensor:
    """Return another radar with a third of the beams, twice the noise, and a field of view that is narrower by a fifth."""
    return replace(
        sensor,
        beams=max(20, sensor.beams // 3),
        azimuth_fov_rad=0.8 * sensor.azimuth_fov_rad,
        sigma_range_m=2 * sensor.sigma_range_m,
        sigma_range_per_m=2 * sensor.sigma_range_per_m,
        sigma_azimuth_rad=2 * sensor.sigma_azimuth_rad,
        sigma_elevation_rad=2 * sensor.sigma_elevation_rad,
    )


def another_day(
    first: Simulation,
    seed: int,
    *,
    stretch: tuple[float, float] | None = None,
    reverse: bool = False,
    sensor: RadarSensor | None = None,
    removed: float = 0.05,
) -> Simulation:
    """Drive 24 scans along a part of an earlier drive, 0.4 to 1 m to one side, at varying yaw and with other noise.

    Parameters
    ----------
    first : Simulation
        The earlier drive.
    seed : int
        Seed of trajectory, removed solids and noise.
    stretch : (begin, end), optional
        Part of the earlier drive, in [0, 1]. Default: a random 0.6 of it.
    reverse : bool
        Drive in the other direction. A radar that looks along the path then faces the other way; one that looks aside does not.
    sensor : RadarSensor, optional
        Default: the radar of the earlier drive.
    removed : float
        Share of the solids that are gone, except for the largest.
    """
    rng, last = generator(seed, _DAY), len(first) - 1
    begin = rng.uniform(0, 0.4)
    at = last * np.linspace(*(stretch or (begin, begin + 0.6)), _FRAMES)
    steps_m = np.linalg.norm(np.diff(first.poses[:, :2, 3], axis=0), axis=1)
    if steps_m.max() > _JUMP_M:  # between stops, the earlier drive has no scans: pass them at constant speed
        along_m = np.append(0.0, np.cumsum(steps_m))
        at = np.interp(at / last * along_m[-1], along_m, np.arange(last + 1))
    xyz = np.stack([np.interp(at, np.arange(last + 1), first.poses[:, k, 3]) for k in range(3)], axis=1)
    rotations = Slerp(np.arange(last + 1), Rotation.from_matrix(first.poses[:, :3, :3]))(at)
    axes = rotations.as_matrix()
    swing = np.sin(np.outer([3, 4], np.linspace(0, 1, _FRAMES)) + rng.uniform(0, 6, (2, 1)))
    aside_m = _ASIDE_M * rng.choice([-1, 1]) * (0.7 + 0.3 * swing[0])
    moved = xyz[:, :2] + aside_m[:, None] * axes[:, :2, 1]
    if first.scene.terrain is not None:
        height = first.scene.terrain.height
        xyz[:, 2] += height(moved) - height(xyz[:, :2])
    steps = np.gradient(xyz[:, :2], axis=0)
    along = np.abs((axes[:, :2, 0] * steps).sum(axis=1)) / np.linalg.norm(steps, axis=1)
    yaw = 0.05 * swing[1] + (np.pi if reverse and np.median(along) > 0.5 else 0.0)
    poses = np.tile(np.eye(4), (_FRAMES, 1, 1))
    poses[:, :3, :3] = (Rotation.from_rotvec(np.outer(yaw, [0, 0, 1])) * rotations).as_matrix()
    poses[:, :2, 3], poses[:, 2, 3] = moved, xyz[:, 2]
    kept = [rng.random() >= removed or one.bounding_sphere()[1] > _STAYS_M for one in first.scene.solids]
    scene = replace(first.scene, solids=[*compress(first.scene.solids, kept)])
    order = slice(None, None, -1 if reverse else 1)
    return simulate(scene, sensor or first.sensor, poses[order].copy(), name=first.name, seed=seed + 1000)


def scan_rate_hz(drive: Simulation) -> float:
    """Return the highest rate of scans, at most 10 Hz, at which a vehicle can make a drive. At 10 Hz, laps would take 2 to 5 g."""
    changes_m = np.linalg.norm(np.diff(drive.poses[:, :2, 3], 2, axis=0), axis=1)
    return float(min(_RATE_HZ, np.sqrt(_MOST_MPS2 / changes_m.max())))


def _court(rng: np.random.Generator) -> tuple[list[Primitive], Path]:
    """Four equal walls, and a circle round their middle: four places are alike."""
    half, material = rng.uniform(9, 12), materials.CONCRETE
    solids: list[Primitive] = []
    for x, y in half * np.array([(1, 0), (0, 1), (-1, 0), (0, -1)]):
        solids.append(Box(np.array([x, y, 1.5]), np.array([abs(y) + 0.2, abs(x) + 0.2, 2.5]), 0.0, material))
    return solids, lambda u: half / 3 * np.stack([np.cos(2 * np.pi * u), np.sin(2 * np.pi * u)], axis=1)


def _straight(length_m: float) -> Path:
    return lambda u: np.stack([length_m * u, 0 * u], axis=1)


def _tube(rng: np.random.Generator) -> tuple[list[Primitive], Path]:
    """A straight tunnel without objects, longer than the radar sees: all places are alike."""
    aside, height, material = rng.uniform(4, 6), rng.uniform(4, 6), materials.CONCRETE
    solids: list[Primitive] = [
        Box(np.array([50, y, 2.0]), np.array([150, 0.2, 5.0]), 0.0, material) for y in (-aside, aside)
    ]
    return [*solids, Box(np.array([50, 0, height]), np.array([150, aside, 0.2]), 0.0, material)], _straight(
        100
    )


def _pillars(rng: np.random.Generator) -> tuple[list[Primitive], Path]:
    """A roof on equal pillars, on a lattice wider than the radar sees: all places a pitch apart are alike."""
    pitch, radius, material = rng.uniform(4.5, 6), rng.uniform(0.3, 0.5), materials.CONCRETE
    x, y = pitch * np.arange(-4, 18), pitch * (np.arange(-4, 4) + 0.5)
    solids: list[Primitive] = [Pole(np.array([*xy, -1.0]), radius, 6.0, material) for xy in product(x, y)]
    return [*solids, Box(np.array([30, 0, 5.2]), np.array([100, 50, 0.2]), 0.0, material)], _straight(60)


def _simulation(name: str, seed: int = 0, frames: int | None = None) -> Simulation:
    solids, path = _LAYOUTS[name](generator(seed, _LAYOUT))
    level = Terrain(np.zeros((1, 2)), np.zeros(1), np.zeros(1), 0.0, materials.ASPHALT)
    poses = along_path(level, path, frames or 60, height_m=1.5, rng=generator(seed, _TRAJECTORY))
    return simulate(Scene(solids, level), _SHORT, poses, name=name, seed=seed)


_LAYOUTS = {"court": _court, "tube": _tube, "pillars": _pillars}
SYMMETRIC: Mapping[str, Callable[..., Simulation]] = MappingProxyType(
    {name: partial(_simulation, name) for name in _LAYOUTS}
)
"""Simulations by name of places that look alike from several poses. Each takes `seed` and `frames`, as those of `SCENES` do."""

PLACES: Mapping[str, Callable[..., Simulation]] = MappingProxyType({**SCENES, **KINDS, **SYMMETRIC})
"""All simulations by name."""


@dataclass(frozen=True)
class Sessions:
    """Drives whose `poses`, the truth, are in the world of their place."""

    together: list[Simulation]
    """Three drives along one path. Each begins in the last third of the one before."""
    apart: list[Simulation]
    """The first of them, and a drive through another place of its kind."""


def sessions(kind: str, seed: int) -> Sessions:
    """Simulate the sessions of a place of `PLACES`, each on another day."""
    here, elsewhere = (PLACES[kind](seed=own, frames=30) for own in (seed, seed + _ELSEWHERE))
    stretches = [(2 * i / 7, (2 * i + 3) / 7) for i in range(3)]  # 3/7 of the path; a third is shared
    together = [another_day(here, 10 * seed + i, stretch=part) for i, part in enumerate(stretches)]
    return Sessions(together, [together[0], another_day(elsewhere, 10 * seed + 3, stretch=stretches[0])])
