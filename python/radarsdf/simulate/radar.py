"""Radar sensor model, its scans of a scene, and lidar points of the same scene as ground truth."""

from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from typing import Annotated, Any, NamedTuple

import numpy as np
from pydantic import Field
from scipy.special import gammaincinv

from radarsdf.arrays import Bools, Floats, Floats32, Ints, NDArray
from radarsdf.checks import check, check_poses, instance, whole_number
from radarsdf.returns.sensor import Sensor
from radarsdf.settings import settings

from .world import Hits, Scene

# Sums and products of numbers below 1e9 do not overflow.
_NotNegative = Annotated[float, Field(ge=0, le=1e9)]
_Positive = Annotated[float, Field(gt=0, le=1e9)]
_Share = Annotated[float, Field(ge=0, le=1)]
_Height = Annotated[float, Field(gt=0, le=np.pi)]
_Count = Annotated[int, Field(ge=1, le=10**7)]
_Power = Annotated[float, Field(ge=-1e9, le=1e9)]

_OFF_SURFACE_M = 1e-6  # offset of a reflected ray from the mirror, so that it does not hit it again
_MIN_LEG_M = 0.01  # shorter paths from a mirror to the next surface are no reflection
# Independent random streams within a scan: more clutter, for example, must not change the noise of surface returns.
_BEAMS, _SPECKLE, _NOISE, _GHOSTS, _CLUTTER, _ORDER, _SIDELOBES, _PHANTOMS = range(8)
_PLACES = 2**31 + 3  # no scan has this index: phantoms keep their places
_PHANTOM_CELL_M = 0.5
_PHANTOM_SHARE = 0.02  # share of the cells of space that can contain a phantom


class Origin(IntEnum):
    """Cause of a return, as in `Simulation.origin_kind`."""

    SURFACE = 0
    CLUTTER = 1
    GHOST = 2
    SIDELOBE = 3
    PHANTOM = 4


class SimulatedScan(NamedTuple):
    """The N returns of one scan."""

    points: Floats32  # (N, 3) sensor frame, m
    intensities: Floats32  # (N,) dB
    noiseless_intensities: Floats32  # (N,) dB, without speckle, noise and steps; NaN: false return
    origin_kind: NDArray[np.int8]  # (N,) codes of `Origin`


class _Rays(NamedTuple):
    origin: Floats  # (3,) world, m
    directions: Floats  # (N, 3) world, unit
    angles: Floats  # (N, 2) azimuth and elevation [rad], sensor frame
    hits: Hits


class _Echoes(NamedTuple):  # candidates of returns, before detection
    range_m: Floats  # (N,)
    angles: Floats  # (N, 2) azimuth and elevation [rad], sensor frame
    power_db: Floats  # (N,) with speckle
    noiseless_db: Floats | float = np.nan  # (N,) without speckle; NaN for false returns


def generator(seed: int, *key: int) -> np.random.Generator:
    """Random number generator of the part `key` of a simulation. Different keys give independent streams."""
    return np.random.default_rng(np.random.SeedSequence(whole_number(seed, "seed", 0), spawn_key=key))


@settings
class RadarSensor:
    """A scanning 3D radar. Sensor frame: x forward, y left, z up.

    By the radar equation, the power of a return in dB is ``gain_db`` + echo of the surface − ``range_loss_db``·log10(range in m)
    + speckle + noise. Speckle is the fading of ``Material.looks`` independent scatterers, of Gamma distribution and median 0 dB.

    The standard deviation of a position is √(``sigma_range_m²`` + (``sigma_range_per_m`` · range)²) along the beam, and
    ``sigma_azimuth_rad`` · range and ``sigma_elevation_rad`` · range across it. Each is multiplied by
    √(1 + ``weak_noise²`` · threshold power / power of the return). So weak returns are the noisiest, and strong ones have
    the standard deviations of the sensor; the term of weak returns falls like the Cramér-Rao bound.

    There are four kinds of false returns: clutter in free space; phantoms behind surfaces, a share of which keeps its
    places from scan to scan, like reflections in a static world; ghosts of mirroring surfaces; and echoes in the side
    lobes of the antenna, with the range and azimuth of a surface and a random elevation.

    Construction raises a ValueError for a value outside its range.
    """

    azimuth_fov_rad: Annotated[float, Field(gt=0, le=2 * np.pi)] = 1.92  # full width, centred on x [rad]
    elevation_fov_rad: _Height = 0.52  # full height, centred on the xy plane [rad]
    beams: _Count = 3000  # directions in a scan, a jittered grid over the field of view
    min_range_m: _Positive = 0.5  # minimum range [m]
    max_range_m: _Positive = 60.0  # maximum range [m], > min_range_m
    sigma_range_m: _NotNegative = 0.04  # standard deviation along the beam, near the sensor [m]
    sigma_range_per_m: _NotNegative = 0.0  # additional deviation per range, added in quadrature [m/m]
    sigma_azimuth_rad: _NotNegative = 0.004  # standard deviation of the azimuth [rad]
    sigma_elevation_rad: _NotNegative = 0.006  # standard deviation of the elevation [rad]
    weak_noise: _NotNegative = 0.0  # additional noise of a return at the threshold, as a multiple of these
    sigma_power_db: _NotNegative = 1.0  # standard deviation of receiver noise, in addition to speckle [dB]
    gain_db: _Power = 130.0  # power at 1 m of a surface with an echo of 0 dB [dB]
    range_loss_db: _NotNegative = 40.0  # loss per decade of range, less if the receiver compensates [dB]
    threshold_db: _Power = 64.0  # weaker returns are not detected [dB]
    floor_db: _Power | None = None  # lower clipping limit of intensities [dB]; None: no clipping
    saturation_db: _Power = 118.0  # upper clipping limit [dB], > threshold_db and floor_db
    step_db: _NotNegative = 0.1  # quantisation of intensities [dB]; 0: continuous
    clutter_per_scan: _NotNegative = 0.0  # expected number of false returns in free space
    clutter_near_share: _Share = 0.5  # share of clutter near the sensor; the rest is uniform along the beams
    clutter_power_db: _NotNegative = 3.0  # mean power of clutter and phantoms above the threshold [dB]
    phantoms_per_scan: _NotNegative = 0.0  # expected number of false returns behind surfaces
    phantom_lasting_share: _Share = 0.5  # share of phantoms at fixed places in all scans
    phantom_depth: _NotNegative = 0.05  # mean depth behind the surface, exponential, as a share of the range
    ghost_share: _Share = 0.0  # share of the beams on mirroring surfaces that may cause a ghost
    sidelobe_share: _Share = 0.0  # share of the surface echoes seen again at a false elevation
    sidelobe_fov_rad: _Height = 0.52  # full height of the false elevations, uniform in their sine [rad]

    def __post_init__(self) -> None:
        fits = self.min_range_m < self.max_range_m
        check(fits, f"min_range_m must be below max_range_m, {self.max_range_m}, not {self.min_range_m}")
        fits = self.saturation_db > self._least_db
        check(fits, f"saturation_db must be above threshold_db and floor_db, not {self.saturation_db}")

    @property
    def _least_db(self) -> float:
        return self.threshold_db if self.floor_db is None else max(self.floor_db, self.threshold_db)

    def scan(self, scene: Scene, T_world_sensor: Floats, seed: int = 0, frame: int = 0) -> SimulatedScan:
        """Scan a scene from a pose T_world_sensor (4, 4), m. `seed` and `frame`, the index of the scan, set all random numbers."""
        angles = self._beam_angles(generator(seed, frame, _BEAMS))
        R, origin = T_world_sensor[:3, :3], T_world_sensor[:3, 3]
        directions = Sensor.directions(*angles.T) @ R.T
        rays = _Rays(origin, directions, angles, scene.raycast(origin, directions, self.max_range_m))
        surface = self._surface(scene, rays, generator(seed, frame, _SPECKLE))
        candidates = {
            Origin.SURFACE: surface,
            Origin.CLUTTER: self._clutter(angles, rays.hits.range_m, generator(seed, frame, _CLUTTER)),
            Origin.GHOST: self._ghosts(scene, rays, generator(seed, frame, _GHOSTS)),
            Origin.SIDELOBE: self._sidelobes(surface, generator(seed, frame, _SIDELOBES)),
            Origin.PHANTOM: self._phantoms(rays, R, seed, generator(seed, frame, _PHANTOMS)),
        }
        scans = [
            self._measure(echoes, kind, generator(seed, frame, _NOISE, kind))
            for kind, echoes in candidates.items()
        ]
        order = generator(seed, frame, _ORDER).permutation(sum(len(scan.points) for scan in scans))
        return SimulatedScan(*(np.concatenate(columns)[order] for columns in zip(*scans, strict=True)))

    def echo_power_db(
        self, scene: Scene, origins: Floats, directions: Floats, hits: Hits, before_m: Floats | float = 0.0
    ) -> Floats:
        """Received power (N,), dB, of surface hits by the radar equation, without speckle or clipping; -inf without a hit.

        Origins of the rays are (3,) or (N, 3), directions (N, 3) unit vectors, world, m. `before_m`: paths (N,) to the origins.
        """
        range_m = np.where(hits.primitive >= 0, hits.range_m, 1.0)
        echo = scene.echo_db(origins + range_m[:, None] * directions, directions, hits)
        return self.gain_db + echo - self.range_loss_db * np.log10(before_m + range_m)

    def angles(self, u: Floats) -> Floats:
        """Azimuths and elevations (N, 2), rad, uniform in azimuth and in the sine of elevation for `u` (N, 2) uniform in 0..1."""
        azimuth = (u[:, 0] - 0.5) * self.azimuth_fov_rad
        elevation = np.arcsin((2 * u[:, 1] - 1) * np.sin(self.elevation_fov_rad / 2))
        return np.stack([azimuth, elevation], axis=1)

    def _beam_angles(self, rng: np.random.Generator) -> Floats:
        aspect = self.azimuth_fov_rad / self.elevation_fov_rad
        columns = max(1, round(min(self.beams, np.sqrt(self.beams * aspect))))
        rows = -(-self.beams // columns)
        cell = rng.permutation(rows * columns)[: self.beams]
        u = np.stack([cell % columns, cell // columns], axis=1) + rng.random((self.beams, 2))
        return self.angles(u / [columns, rows])  # a jittered grid

    def _surface(self, scene: Scene, rays: _Rays, rng: np.random.Generator) -> _Echoes:
        hits = rays.hits
        noiseless = self.echo_power_db(scene, rays.origin, rays.directions, hits)
        power = noiseless + _speckle_db(scene, hits, rng)
        rows = (hits.primitive >= 0) & (hits.range_m >= self.min_range_m)
        return _Echoes(hits.range_m[rows], rays.angles[rows], power[rows], noiseless[rows])

    def _ghosts(self, scene: Scene, rays: _Rays, rng: np.random.Generator) -> _Echoes:
        """Echoes along sensor - mirror - target and back, which appear behind the mirror at the full path length."""
        origin, directions, angles, hits = rays
        loss = scene.material_values(hits, "mirror_loss_db", np.inf)
        rows = np.flatnonzero((rng.random(len(directions)) < self.ghost_share) & np.isfinite(loss))
        normals, first = hits.normals[rows], hits.range_m[rows]
        cos = np.einsum("ni,ni->n", directions[rows], normals)
        mirrored = directions[rows] - 2 * cos[:, None] * normals
        mirror = origin + first[:, None] * directions[rows] + _OFF_SURFACE_M * normals
        second = scene.raycast(mirror, mirrored, self.max_range_m)
        # Where a mirror stands on the ground, the path to the next surface has zero length: this is no ghost.
        seen = (first + second.range_m <= self.max_range_m) & (second.range_m > _MIN_LEG_M)
        rows, first = rows[seen], first[seen]
        second = Hits(second.range_m[seen], second.normals[seen], second.primitive[seen])
        # The wave is attenuated at the mirror twice.
        power = self.echo_power_db(scene, mirror[seen], mirrored[seen], second, first) - 2 * loss[rows]
        return _Echoes(first + second.range_m, angles[rows], power + _speckle_db(scene, second, rng))

    def _sidelobes(self, surface: _Echoes, rng: np.random.Generator) -> _Echoes:
        rows = np.flatnonzero(rng.random(len(surface.range_m)) < self.sidelobe_share)
        angles = surface.angles[rows]
        angles[:, 1] = np.arcsin(rng.uniform(-1, 1, size=len(rows)) * np.sin(self.sidelobe_fov_rad / 2))
        return _Echoes(surface.range_m[rows], angles, surface.power_db[rows])

    def _clutter(self, angles: Floats, range_m: Floats, rng: np.random.Generator) -> _Echoes:
        beam = rng.integers(len(angles), size=rng.poisson(self.clutter_per_scan))
        free = np.minimum(range_m[beam], self.max_range_m)
        anywhere = free * rng.uniform(0.05, 0.95, size=len(beam))
        near = self.min_range_m + rng.exponential(1.5, size=len(beam))
        is_far = rng.random(len(beam)) < 1 - self.clutter_near_share
        distance = np.where(is_far, anywhere, near)
        power = self.threshold_db + rng.exponential(self.clutter_power_db, size=len(beam))
        rows = (distance >= self.min_range_m) & (distance < 0.95 * free)
        return _Echoes(distance[rows], angles[beam[rows]], power[rows])

    def _phantoms(self, rays: _Rays, R: Floats, seed: int, rng: np.random.Generator) -> _Echoes:
        """Weak false returns behind surfaces, more behind far ones, whose beams are wider."""
        # Lasting ones have the same places in all scans of a seed: at most one per cell of space.
        lasting = self.phantom_lasting_share
        expected = self.phantoms_per_scan * np.array([1 - lasting, lasting])
        passing, tries = rng.poisson(expected / [1, _PHANTOM_SHARE])
        seen = np.flatnonzero(rays.hits.primitive >= 0)
        weights = rays.hits.range_m[seen]
        beam = rng.choice(seen, passing + tries, p=weights / weights.sum()) if len(seen) else seen
        range_m = rays.hits.range_m[beam] * (1 + self.phantom_depth * rng.standard_exponential(len(beam)))
        points = rays.origin + range_m[:, None] * rays.directions[beam]
        cells = np.floor(points[passing:] / _PHANTOM_CELL_M)
        key = int(generator(seed, _PLACES).integers(2**63))
        is_place, *offsets = (_hash(cells.astype(np.int64), key + k) for k in range(4))
        places = _PHANTOM_CELL_M * (cells + np.stack(offsets, axis=1))
        phantoms = np.concatenate([points[:passing], places[is_place < _PHANTOM_SHARE]])
        x, y, z = ((phantoms - rays.origin) @ R).T
        power = self.threshold_db + rng.exponential(self.clutter_power_db, size=len(x))
        angles = np.stack([np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))], axis=1)
        return _Echoes(np.sqrt(x**2 + y**2 + z**2), angles, power)

    def _measure(self, echoes: _Echoes, kind: Origin, rng: np.random.Generator) -> SimulatedScan:
        noise = rng.standard_normal((len(echoes.range_m), 4))
        # Returns that noise lifts above the threshold count as if at it.
        excess_db = np.maximum(echoes.power_db - self.threshold_db, 0.0)
        noise[:, :3] *= np.sqrt(1 + self.weak_noise**2 * 10 ** (-excess_db / 10))[:, None]
        sigma_range_m = np.hypot(self.sigma_range_m, self.sigma_range_per_m * echoes.range_m)
        range_m = echoes.range_m + sigma_range_m * noise[:, 0]
        angles = echoes.angles + noise[:, 1:3] * [self.sigma_azimuth_rad, self.sigma_elevation_rad]
        power = echoes.power_db + self.sigma_power_db * noise[:, 3]
        if self.step_db > 0:
            power = np.round(power / self.step_db) * self.step_db
        rows = (power >= self.threshold_db) & (range_m >= self.min_range_m) & (range_m <= self.max_range_m)
        points = range_m[rows, None] * Sensor.directions(*angles[rows].T)
        intensities = np.clip(power[rows], self.floor_db, self.saturation_db).astype(np.float32)
        noiseless = np.broadcast_to(echoes.noiseless_db, rows.shape)[rows]
        noiseless = np.clip(noiseless, self._least_db, self.saturation_db).astype(np.float32)
        kinds = np.full(len(points), kind, dtype=np.int8)
        return SimulatedScan(points.astype(np.float32), intensities, noiseless, kinds)


def _hash(cells: Ints, key: int) -> Floats:
    """Hash rows (N, 3) of integers to numbers in [0, 1), reproducible by key."""
    mixed = np.full(len(cells), key, dtype=np.uint64)
    for column in (*cells.astype(np.uint64).T, np.uint64(0)):
        mixed = (mixed ^ column) + np.uint64(0x9E3779B97F4A7C15)  # SplitMix64 (Steele, Lea, Flood 2014)
        mixed = (mixed ^ (mixed >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        mixed = (mixed ^ (mixed >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        mixed ^= mixed >> np.uint64(31)
    return (mixed >> np.uint64(11)).astype(np.float64) * 2.0**-53


def _speckle_db(scene: Scene, hits: Hits, rng: np.random.Generator) -> Floats:
    """Fading (N,), dB, by the numbers of scatterers."""
    # Its median is 0, so a fit with the L1 loss, which estimates medians, finds the noiseless intensity.
    looks = scene.material_values(hits, "looks", 1.0)
    power = rng.standard_gamma(looks)
    values, index = np.unique(looks, return_inverse=True)
    return 10 * np.log10(np.maximum(power, 1e-12) / gammaincinv(values, 0.5)[index])


_LIDAR_RAYS = 10_000  # rays per pose
_LIDAR_SIGMA_M = 0.01
_LIDAR_CELL_M = 0.05  # one lidar point per cell, or most would lie on the ground near the sensor
_LIDAR_STREAM = 2**31  # no scan has this index


@dataclass(frozen=True, eq=False)
class Simulation:
    """Simulated radar scans with poses and ground truth."""

    points: list[Floats32]  # F arrays (N_i, 3), sensor frame, m
    poses: Floats  # (F, 4, 4) T_world_sensor, m
    intensities: list[Floats32]  # F arrays (N_i,), dB
    noiseless_intensities: list[Floats32]  # F arrays (N_i,), dB, without speckle and noise; NaN: false return
    origin_kind: list[NDArray[np.int8]]  # F arrays (N_i,), codes of `Origin`
    scene: Scene
    sensor: RadarSensor
    name: str
    seed: int
    lidar_poses: Floats  # (G, 4, 4) T_world_sensor, m: at some of them, a lidar measures the ground truth

    @cached_property
    def ground_truth(self) -> Floats:
        """(M, 3) lidar points of the surfaces that the radar can detect, world frame, m.

        They have a noise of 1 cm along the ray, and at most one point per cell of 5 cm. Computing them takes as long as the scans.
        """
        rng, sensor = generator(self.seed, _LIDAR_STREAM), self.sensor
        found = [np.zeros((0, 3))]
        every = max(1, len(self.lidar_poses) // 40)  # neighbouring poses see the same surfaces
        for T_world_sensor in self.lidar_poses[::every]:
            angles = sensor.angles(rng.random((_LIDAR_RAYS, 2)))
            R, origin = T_world_sensor[:3, :3], T_world_sensor[:3, 3]
            directions = Sensor.directions(*angles.T) @ R.T
            hits = self.scene.raycast(origin, directions, sensor.max_range_m)
            visible = sensor.echo_power_db(self.scene, origin, directions, hits) >= sensor.threshold_db
            visible &= hits.range_m >= sensor.min_range_m
            range_m = hits.range_m[visible] + _LIDAR_SIGMA_M * rng.standard_normal(int(visible.sum()))
            found.append(origin + range_m[:, None] * directions[visible])
        points = np.concatenate(found)
        cells = np.floor(points / _LIDAR_CELL_M).astype(np.int64)
        _, first = np.unique(cells, axis=0, return_index=True)
        return points[np.sort(first)]

    def __len__(self) -> int:
        """Number of scans."""
        return len(self.points)

    def world_points(self) -> Floats:
        """All returns, false ones included: (N, 3) float64, world frame, m, in the order of the scans."""
        scans = zip(self.points, self.poses, strict=True)
        return np.concatenate([p.astype(np.float64) @ T[:3, :3].T + T[:3, 3] for p, T in scans])

    def is_surface(self) -> Bools:
        """Mask of the returns from a surface, (N,) bool, in the order of `world_points`."""
        return np.concatenate(self.origin_kind) == Origin.SURFACE

    def intensity_noise_floor(self) -> float:
        """Mean absolute difference between measured and noiseless intensities of the surface returns, dB.

        It is the error of a perfect model of scene and sensor. That of a fit can be slightly lower: near the detection threshold,
        only returns with positive noise are detected, and a fit learns this bias.
        """
        error = np.abs(np.concatenate(self.intensities) - np.concatenate(self.noiseless_intensities))
        surface = self.is_surface()
        return float(error[surface].mean(dtype=np.float64)) if surface.any() else float("nan")


def simulate(scene: Scene, sensor: RadarSensor, poses: Floats, *, name: str, seed: int = 0) -> Simulation:
    """Scan a scene once from every pose. Raises a ValueError if a pose is not a rigid transform.

    Parameters
    ----------
    scene, sensor : Scene, RadarSensor
        The world, and the radar.
    poses : (F, 4, 4) float64
        T_world_sensor, m.
    name : str
        Name of the simulation.
    seed : int
        Seed of all random numbers. The same arguments give the same result, bit by bit.
    """
    instance(scene, Scene, "scene")
    instance(sensor, RadarSensor, "sensor")
    poses = check_poses(poses)
    scans = [sensor.scan(scene, T_world_sensor, seed, frame) for frame, T_world_sensor in enumerate(poses)]
    values: dict[str, Any] = {of: [getattr(scan, of) for scan in scans] for of in SimulatedScan._fields}
    values |= {"scene": scene, "sensor": sensor, "lidar_poses": poses.copy()}
    return Simulation(poses=poses, name=name, seed=seed, **values)
