"""Predicted scans: the returns of a radar at a pose, and the first surface along its beams."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from radarsdf.arrays import Floats, Floats32, Ints
from radarsdf.checks import check, flag, number, whole_number
from radarsdf.core import SurfaceTracer, cell_keys
from radarsdf.map import queries
from radarsdf.map.confidence import EvidenceAt, evidence, roughness
from radarsdf.map.mesh import Surface, across_triangles
from radarsdf.map.threshold import Limits
from radarsdf.memory import check_views
from radarsdf.products import turned
from radarsdf.returns.sensor import Sensor
from radarsdf.scans import Scan, Scans, scans_in_memory
from radarsdf.threads import resolve_num_threads

_Intensity = Callable[[Floats, Floats], Floats32]  # (N,) from points (N, 3) and a sensor (3,), m

# The density of returns on the surface is rate^a · cosine^b / range^c, times d if the patch is occluded: (a, b, c, d) in smooth
# scenes, and in rough ones, where a radar sees much behind surfaces. Tuned with `python -m bench.paper novel-views`.
_SMOOTH = np.array([1.0, 1.0, 2.0, 0.01])
_ROUGH = np.array([2.2, 0.3, 1.0, 0.65])
_HIDDEN_M = 0.5  # distance behind the first surface from which on a patch is occluded
_MIN_COSINE = 0.05
_MIN_BEAM_RAD = 2e-3
_MAX_BEAMS = 1_000_000
_ORDER_M = 0.05  # edge of the cells in whose Morton order returns are spread evenly
# Prior of the detection rate, in scans, for patches reached by few scans.
_VISIBILITY_BEFORE = 2.0
_HITS_BEFORE = 0.5


@dataclass(frozen=True, eq=False)
class View:
    """Predicted scan at one pose: N returns, and the first surface along each of E · A beams."""

    T_world_sensor: Floats
    """(4, 4) m."""
    sensor: Sensor
    """The radar."""
    points: Floats32
    """(N, 3) returns, sensor frame, m."""
    intensities: Floats32 | None
    """(N,) sensor units, NaN where :meth:`Map.intensity` is. None if the map has no intensities."""
    azimuth_rad: Floats
    """(A,) azimuths of the beams, ascending, rad."""
    elevation_rad: Floats
    """(E,) elevations of the beams, ascending, rad."""
    beam_ranges_m: Floats32
    """(E, A) distance to the first surface along each beam, m. NaN where there is none."""

    def __len__(self) -> int:
        """Number of returns."""
        return len(self.points)

    @property
    def ranges_m(self) -> Floats:
        """(N,) distances of the returns from the sensor, m."""
        return np.linalg.norm(self.points.astype(np.float64), axis=1)

    @property
    def world_points(self) -> Floats:
        """(N, 3) returns, world, m."""
        return self.scan.world_points

    @property
    def scan(self) -> Scan:
        """The returns with their pose."""
        return Scan(self.points, self.T_world_sensor, self.intensities)

    @property
    def scans(self) -> Scans:
        """The returns as a single scan in :class:`radarsdf.io.Scans`, for the writers of :mod:`radarsdf.io`."""
        return scans_in_memory([self.scan])


class DepthImage(NamedTuple):
    """Surface seen by a camera. NaN in pixels without surface."""

    depth_m: Floats32
    """(height, width) distance of the surface along the optical axis, m."""
    normals: Floats32
    """(height, width, 3) unit normals, world frame, towards free space."""
    confidence: Floats32
    """(height, width) :meth:`Map.confidence` of the surface."""


@dataclass(frozen=True, eq=False)
class ViewedMap:
    """Traceable surface of a map, and patches that may have returns, in a local frame. Built once for a map."""

    tracer: SurfaceTracer  # tracer of the triangles that the mesh keeps by default
    centres: Floats  # (P, 3) centroids of all triangles of the zero level set, the patches, m
    normals: Floats  # (P, 3) unit vectors towards free space
    areas_m2: Floats  # (P,) areas of the patches
    rates: Floats  # (P,) detection rate: share of the scans reaching a patch that have a return there
    origin: Floats  # (3,) origin of the local frame, world, m
    roughness: float  # see :func:`radarsdf.map.confidence.roughness`
    intensity: _Intensity | None
    max_memory_bytes: int | None  # memory limit of views. None: what the system has left

    @classmethod
    def of(cls, contents: queries.MapContents) -> "ViewedMap":
        """Build for a whole map, in voxels of a leaf cell's size, which is finer than the noise of a radar."""
        config = contents.config
        check_views(config.max_memory_bytes, cells=len(contents.evidence.visibility))

        def intensity(points: Floats, position: Floats) -> Floats32:
            x = points.astype(np.float32)
            return queries.intensity(contents, x, np.broadcast_to(position.astype(np.float32), x.shape))

        def evidence_at(points: Floats) -> EvidenceAt:
            return evidence(contents, points.astype(np.float32))

        predicted = None if contents.intensity_scale is None else intensity
        surface = Surface.of(contents, config.leaf_size_m)
        return cls.of_surface(surface, contents, contents.origin, evidence_at, predicted)

    @classmethod
    def of_surface(
        cls,
        surface: Surface,
        scene: queries.WholeMap,
        origin: Floats,
        evidence_at: Callable[[Floats], EvidenceAt],
        intensity: _Intensity | None,
    ) -> "ViewedMap":
        """Build with all triangles as patches, and those of the default mesh for tracing. `evidence_at`: of points (N, 3), m."""
        across, twice_m2 = across_triangles(surface.vertices, surface.faces)
        centres = surface.vertices[surface.faces].mean(axis=1)
        found = evidence_at(centres)
        rates = (found.hits + _HITS_BEFORE) / (found.visibility + _VISIBILITY_BEFORE)
        faces = np.ascontiguousarray(surface.faces[surface.kept(Limits.of(scene.config.leaf_size_m))])
        tracer = SurfaceTracer(surface.vertices, faces, resolve_num_threads(0))
        normals = across / np.maximum(twice_m2, 1e-12)[:, None]
        patches = centres, normals, twice_m2 / 2, rates.astype(np.float64)
        of_scene = roughness(scene), intensity, scene.config.max_memory_bytes
        return cls(tracer, *patches, origin, *of_scene)

    def ranges(self, origin: Floats, directions: Floats, max_range_m: float) -> Floats32:
        """Return distances (N,), m, to the first hits of rays from `origin` (3,) in unit `directions` (N, 3); inf: none."""
        rows = np.ascontiguousarray(directions, np.float32)
        found, _ = self.tracer.first_hits(origin.tolist(), rows, max_range_m, False, resolve_num_threads(0))
        return found


def view_from(
    surface: ViewedMap, pose: Floats, sensor: Sensor, returns: float | None, *, noise: bool, seed: Any
) -> View:
    """Render a view at a `pose` (4, 4), T_world_sensor, m; see :meth:`Map.render`."""
    wanted = number(sensor.returns_per_scan if returns is None else returns, "returns")
    check(0 <= wanted <= 1e8, f"returns must be in [0, 10^8], not {returns}")
    azimuth, elevation = _beams(sensor)
    check_views(surface.max_memory_bytes, patches=len(surface.centres), beams=len(azimuth) * len(elevation))
    position = pose[:3, 3] - surface.origin
    chosen = _patches(surface, pose[:3, :3], position, sensor, round(wanted))
    points = turned(surface.centres[chosen] - position, pose[:3, :3].T)
    intensities = None
    if surface.intensity is not None:
        intensities = sensor.measured(surface.intensity(surface.centres[chosen], position))
        detected = ~(intensities < sensor.threshold(np.linalg.norm(points, axis=1)))
        points, intensities = points[detected], intensities[detected]
    if flag(noise, "noise"):
        seed = seed if isinstance(seed, np.random.Generator) else whole_number(seed, "seed", 0)
        points = _with_noise(points, sensor, np.random.default_rng(seed))
    grid = np.meshgrid(elevation, azimuth, indexing="ij")
    directions = turned(sensor.directions(grid[1].ravel(), grid[0].ravel()), pose[:3, :3])
    first_m = surface.ranges(position, directions, float(sensor.range_m[1]))
    first_m[~np.isfinite(first_m) | (first_m < sensor.range_m[0])] = np.nan
    of_beams = azimuth, elevation, first_m.reshape(grid[0].shape)
    return View(pose, sensor, points.astype(np.float32), intensities, *of_beams)


def _polar(points: Floats) -> tuple[Floats, Floats, Floats]:
    """Convert points (N, 3), sensor frame, m, to ranges, azimuths and elevations (N,)."""
    x, y, z = points.T
    ranges_m = np.sqrt(x * x + y * y + z * z)
    with np.errstate(invalid="ignore", divide="ignore"):
        return ranges_m, np.arctan2(y, x), np.arcsin(z / ranges_m)


def _patches(surface: ViewedMap, R: Floats, position: Floats, sensor: Sensor, count: int) -> Ints:
    """Return the rows of `count` patches with returns, distributed in proportion to their expected numbers."""
    centres = surface.centres
    seen = np.ones(len(centres), bool)
    limits = (sensor.range_m, sensor.azimuth_rad, sensor.elevation_rad)
    for values, (low, high) in zip(_polar(turned(centres - position, R.T)), limits, strict=True):
        seen &= (values >= low) & (values <= high)
    rows = np.flatnonzero(seen)
    if len(rows) == 0 or count == 0:
        return rows[:0]
    order = cell_keys(centres[rows].astype(np.float32), _ORDER_M, 1)
    rows = rows[np.argsort(order, kind="stable")]
    to_patch = centres[rows] - position
    ranges_m = np.sqrt(np.einsum("ni,ni->n", to_patch, to_patch))
    to_patch /= ranges_m[:, None]
    first_m = surface.ranges(position, to_patch, float(sensor.range_m[1]))
    cosine = np.abs(np.einsum("ni,ni->n", surface.normals[rows], to_patch))
    rate_power, cosine_power, range_power, hidden = _SMOOTH + surface.roughness * (_ROUGH - _SMOOTH)
    expected = surface.areas_m2[rows] * surface.rates[rows] ** rate_power
    expected *= np.maximum(cosine, _MIN_COSINE) ** cosine_power / ranges_m**range_power
    expected *= np.where(ranges_m > first_m + _HIDDEN_M, hidden, 1.0)
    return rows[_spread(expected, count)]


def _spread(expected: Floats, count: int) -> Ints:
    """Return at most `count` distinct rows, distributed in proportion to their `expected` (N,) numbers."""
    count = min(count, int(np.count_nonzero(expected)))
    if count == 0:
        return np.zeros(0, np.int64)
    # The k largest get one each, with the smallest k for which no other row's share of the rest exceeds one.
    falling = np.sort(expected)[::-1]
    rest = np.cumsum(falling[::-1])[::-1]
    full = int(np.argmax(falling * (count - np.arange(len(falling))) <= rest))
    share = (count - full) / rest[full]
    up_to = np.floor(np.cumsum(np.minimum(expected * share, 1.0)) + 0.5)
    return np.flatnonzero(np.diff(up_to, prepend=0.0) > 0)


def _with_noise(points: Floats, sensor: Sensor, rng: np.random.Generator) -> Floats:
    ranges_m, azimuth, elevation = _polar(points)
    errors, noise = rng.standard_normal((3, len(points))), sensor.noise
    angles = azimuth + noise.azimuth_rad * errors[1], elevation + noise.elevation_rad * errors[2]
    noisy_m = np.maximum(ranges_m + noise.range_m * errors[0], 0.0)
    return sensor.directions(*angles) * noisy_m[:, None]


def _beams(sensor: Sensor) -> tuple[Floats, Floats]:
    """Return azimuths (A,) and elevations (E,) of beams that overlap by half."""
    steps = [max(width / 2, _MIN_BEAM_RAD) for width in sensor.beam_rad]
    limits = (sensor.azimuth_rad, sensor.elevation_rad)
    counts = [int((high - low) / step) + 1 for (low, high), step in zip(limits, steps, strict=True)]
    while counts[0] * counts[1] > _MAX_BEAMS:
        counts = [max(1, count // 2) for count in counts]
    (first, last), (lowest, highest) = limits
    azimuth = first + (np.arange(counts[0]) + 0.5) * ((last - first) / counts[0])
    elevation = lowest + (np.arange(counts[1]) + 0.5) * ((highest - lowest) / counts[1])
    return np.asarray(azimuth, np.float64), np.asarray(elevation, np.float64)
