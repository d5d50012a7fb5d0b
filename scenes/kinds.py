"""Scenes of many kinds, each with another radar and drive, so that results do not depend on one scene."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray
from radarsdf.checks import whole_number
from radarsdf.simulate import Box, RadarSensor, Scene, Simulation, Terrain, materials, simulate
from radarsdf.simulate.materials import Material
from radarsdf.simulate.radar import generator
from radarsdf.simulate.scenes import Path, Site, along_path, vary

__all__ = ["KINDS", "Kind"]

FloatArray = NDArray[np.float64]

_LAYOUT, _TRAJECTORY = 2**31 + 1, 2**31 + 2  # streams of random numbers that no scan uses
_THRESHOLD_DB = 64.0
_REACH_DB = 6.0  # a wall is detected at the maximum range, even at grazing incidence
_BEYOND = (-0.1, 1.3)  # part of the path, extended at both ends, along which objects stand


def _radar(
    returns: int,
    fov_deg: tuple[float, float],
    max_range_m: float,
    *,
    near_noise: float = 1.0,
    far_noise: float = 0.0,
    false_returns: float = 1.0,
) -> RadarSensor:
    """Build a radar with `beams` beams and field of view `fov_deg`. A factor of 1 is typical noise, near and far, and clutter."""
    azimuth_rad, elevation_rad = np.deg2rad(fov_deg)
    return RadarSensor(
        azimuth_fov_rad=float(azimuth_rad),
        elevation_fov_rad=float(elevation_rad),
        beams=returns,
        max_range_m=max_range_m,
        sigma_range_m=0.06 * near_noise,
        sigma_range_per_m=0.003 * far_noise,
        sigma_azimuth_rad=0.007 * near_noise,
        sigma_elevation_rad=0.010 * near_noise,
        weak_noise=1.5 * far_noise,
        gain_db=_THRESHOLD_DB + 40 * float(np.log10(max_range_m)) + _REACH_DB,
        threshold_db=_THRESHOLD_DB,
        clutter_per_scan=0.01 * returns * false_returns,
        phantoms_per_scan=0.1 * returns * far_noise * false_returns,
        ghost_share=min(1.0, 0.4 * false_returns),
        sidelobe_share=0.03 * far_noise,
    )


@dataclass(frozen=True)
class Kind:
    """Properties common to scenes of a kind. A seed draws the numbers within the limits, and the places."""

    radar: RadarSensor
    """The radar."""
    frames: int
    """Number of scans."""
    length_m: tuple[float, float]
    """Length of the path, or longer diameter of a lap."""
    things: tuple[tuple[str, tuple[int, int], tuple[float, float]], ...]
    """Methods of `Site`, how many of each there are, and their distances from the path, m."""
    drive: str = "ahead"
    """`ahead` along a bent path, one `lap`, or some scans from each of three `places` that face one facade."""
    ground_m: float = 0.1
    """Amplitude of the ground; see `Terrain.random`."""
    ground: Material = materials.ASPHALT
    """Material of the ground."""
    slope: float = 0.0
    """Steepest slope of a hillside, rise over run."""
    enclosure: tuple[float, float, bool] | None = None
    """Enclosing walls: distance from the path, height, m, and whether there is a roof."""


_GARDEN = (("tree", (10, 25), (4.0, 25.0)), ("hedge", (4, 9), (5.0, 20.0)))
_YARD = (("building", (5, 9), (9.0, 18.0)), ("car", (4, 9), (4.0, 9.0)), ("wall", (3, 7), (5.0, 12.0)))

_KINDS = {
    "forest": Kind(
        _radar(3000, (110, 30), 50.0, far_noise=0.5, false_returns=0.5), 40, (30, 50),
        (("tree", (90, 140), (2.0, 30.0)), ("pole", (30, 60), (2.0, 20.0))), ground_m=0.5, ground=materials.GRASS,
    ),
    "yard": Kind(
        _radar(1000, (113, 44), 40.0, near_noise=2.0, false_returns=3.0), 100, (24, 32), (*_YARD, ("pole", (8, 16), (2.0, 12.0))),
        drive="lap",
    ),
    "hall": Kind(
        _radar(700, (140, 60), 30.0, near_noise=1.5, false_returns=2.0), 80, (16, 24),
        (("wall", (4, 9), (3.0, 7.0)), ("pole", (6, 14), (2.0, 7.0))), drive="lap", ground_m=0.0, ground=materials.CONCRETE,
        enclosure=(9.0, 6.0, True),
    ),
    "tunnel": Kind(
        _radar(2400, (90, 20), 100.0, far_noise=1.0), 40, (50, 80), (("car", (2, 6), (2.6, 3.0)), ("pole", (4, 10), (3.5, 4.2))),
        ground_m=0.02, enclosure=(5.0, 5.5, True),
    ),
    "slope": Kind(
        _radar(1500, (100, 30), 60.0, far_noise=1.0), 60, (40, 60), _GARDEN, ground_m=0.4, ground=materials.GRASS, slope=0.3,
    ),
    "facade": Kind(
        _radar(20_000, (60, 40), 60.0, near_noise=0.7, false_returns=0.3), 30, (30, 40),
        (("car", (2, 5), (3.0, 8.0)), ("pole", (2, 6), (2.0, 8.0))), drive="places",
    ),
    "car_park": Kind(
        _radar(5000, (120, 25), 40.0, near_noise=0.6, false_returns=3.0), 120, (30, 40),
        (("car", (30, 50), (3.5, 14.0)), ("pole", (6, 12), (3.0, 14.0)), ("building", (1, 4), (16.0, 22.0))), drive="lap",
    ),
    "fences": Kind(
        _radar(2000, (150, 20), 40.0, false_returns=0.3), 200, (120, 160),
        (("fence", (20, 30), (3.0, 12.0)), ("pole", (30, 50), (2.5, 14.0)), ("building", (2, 5), (15.0, 25.0))),
        ground_m=0.2, ground=materials.GRASS,
    ),
}  # fmt: skip


class _Site(Site):
    """A site that can also have fences."""

    def fence(self, xy: FloatArray, yaw: float) -> bool:
        """Add a fence along a path: posts 2 m apart, and two rails."""
        steps, height = int(self.rng.integers(3, 7)), self.rng.uniform(1.1, 1.8)
        along = np.array([np.cos(yaw), np.sin(yaw)])
        spots = [xy + 2.0 * (i - steps / 2) * along for i in range(steps + 1)]
        if not self.reserve([(*spot, 0.5) for spot in spots]):
            return False
        wood = vary(self.rng, materials.TREE)
        for spot in spots:
            self.add_pole(spot, 0.05, height, wood)
        for share in (0.4, 0.9):
            bottom = float(self.terrain.height(np.array(spots)).mean()) + share * height
            self.add_box(xy, yaw, bottom, np.array([2.0 * steps, 0.05, 0.12]), wood)
        return True


def _path(kind: Kind, rng: np.random.Generator) -> Path:
    length, width = rng.uniform(*kind.length_m), rng.uniform(0.55, 0.8)
    sway, phase = rng.uniform(0.5, 2.5), rng.uniform(0, 2 * np.pi)
    if kind.enclosure is not None and kind.drive == "ahead":
        sway = 0.0  # tunnels are straight

    def ahead(u: FloatArray) -> FloatArray:
        return np.stack([length * u, sway * np.sin(length * u / 11 + phase)], axis=1)

    def lap(u: FloatArray) -> FloatArray:
        angle = phase + 2 * np.pi * u
        xy: FloatArray = 0.5 * length * np.stack([np.cos(angle), width * np.sin(angle)], axis=1)
        return xy

    def places(u: FloatArray) -> FloatArray:
        place = np.minimum(np.floor(3 * u), 2)
        return np.stack([length * place / 2 + 0.3 * (3 * u - place), 2 * sway * (place - 1)], axis=1)

    return {"ahead": ahead, "lap": lap, "places": places}[kind.drive]


def _ground(kind: Kind, rng: np.random.Generator) -> Terrain:
    """Terrain of a kind. A hillside is a long wave across the path, steepest there."""
    terrain = Terrain.random(rng, kind.ground_m, kind.ground)
    wave = 2 * np.pi / 300.0
    return replace(
        terrain,
        waves=np.vstack([terrain.waves, [0.0, wave]]),
        amplitudes=np.append(terrain.amplitudes, kind.slope / wave),
        phases=np.append(terrain.phases, 0.0),
    )


def _enclosed(kind: Kind, way: FloatArray, rng: np.random.Generator) -> list[Box]:
    """Walls round a path (N, 2), open at the ends of a tunnel, and the roof."""
    if kind.enclosure is None:
        return []
    beside, height, roof = kind.enclosure
    lower, upper = way.min(axis=0) - beside, way.max(axis=0) + beside
    middle, half = (lower + upper) / 2, (upper - lower) / 2
    concrete = vary(rng, materials.CONCRETE)

    def box(center: list[float], half_extents: list[float]) -> Box:
        return Box(np.array(center), np.array(half_extents), 0.0, concrete)

    boxes = [
        box([middle[0], y, height / 2 - 0.5], [half[0], 0.2, height / 2 + 0.5]) for y in (lower[1], upper[1])
    ]
    if kind.drive == "lap":
        boxes += [
            box([x, middle[1], height / 2 - 0.5], [0.2, half[1], height / 2 + 0.5])
            for x in (lower[0], upper[0])
        ]
    if roof:
        boxes.append(box([*middle, height + 0.1], [*half, 0.2]))
    return boxes


def _facade(rng: np.random.Generator, length_m: float) -> list[Box]:
    """A front along x with recessed windows, balconies and a roof's edge, 15 m to the left of the path."""
    brick, glass, y = vary(rng, materials.BRICK), vary(rng, materials.GLASS), 15.0
    height, middle = rng.uniform(9, 14), length_m / 2
    boxes = [
        Box(
            np.array([middle, y + 4, height / 2 - 0.5]), np.array([middle, 4.0, height / 2 + 0.5]), 0.0, brick
        )
    ]
    for x in np.arange(2.0, length_m - 1, rng.uniform(3, 4.5)):
        for z in np.arange(2.0, height - 1, 3.0):
            boxes.append(Box(np.array([x, y, z]), np.array([0.6, 0.05, 0.8]), 0.0, glass))
            if rng.random() < 0.3:
                boxes.append(Box(np.array([x, y - 0.6, z - 1.2]), np.array([1.3, 0.6, 0.1]), 0.0, brick))
    return boxes  # fmt: skip


def _simulation(kind: Kind, name: str, seed: int = 0, frames: int | None = None) -> Simulation:
    rng = generator(seed, _LAYOUT)
    terrain, path = _ground(kind, rng), _path(kind, rng)
    way = path(
        np.linspace(*_BEYOND, 200) if kind.drive == "ahead" else np.linspace(0, 1, 100, endpoint=False)
    )
    site = _Site(rng, terrain, taken=[(x, y, 1.5) for x, y in way])
    site.solids += _enclosed(kind, way, rng)
    if kind.drive == "places":
        site.solids += _facade(rng, float(way[:, 0].max()))

    def beside(near: float, far: float) -> tuple[FloatArray, float]:
        return site.beside(path, rng.uniform(*(_BEYOND if kind.drive == "ahead" else (0, 1))), near, far)

    site.fill(kind.things, beside)
    scans = kind.frames if frames is None else whole_number(frames, "frames", 1)
    poses = along_path(
        terrain,
        path,
        scans,
        height_m=1.5,
        rng=generator(seed, _TRAJECTORY),
        look_at=np.array([float(way[:, 0].mean()), 15.0]) if kind.drive == "places" else None,
    )
    return simulate(Scene(site.solids, terrain), kind.radar, poses, name=name, seed=seed)


KINDS: Mapping[str, Callable[..., Simulation]] = MappingProxyType(
    {name: partial(_simulation, kind, name) for name, kind in _KINDS.items()}
)
"""Simulations by name of the kind. Each takes `seed` and `frames`, as those of `SCENES` do."""
