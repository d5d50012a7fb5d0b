"""Search for the place of a submap of several scans in a whole map."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property, reduce
from os import PathLike
from typing import Any

import numpy as np
from scipy import fft
from scipy.ndimage import gaussian_filter
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, cKDTree

from radarsdf.arrays import Array, Bools, Floats, Floats32, Ints, Mesh
from radarsdf.checks import check
from radarsdf.io.files import reading
from radarsdf.io.npz import arrays_of, check_archive, check_arrays, write_arrays
from radarsdf.map.map import Map
from radarsdf.poses.planes import PlaneMap, SensorReturns, apart_m
from radarsdf.poses.rigid import rotation, transform
from radarsdf.returns.planes import LEAVES_PER_SURFEL, Surfels

_SAMPLED, _NEIGHBOURS = 2000, 20  # vertices of a map and their neighbours, as many as those of a plane
_ARRAYS: dict[str, tuple[Any, ...]] = {
    "points": (np.float64, None, 3),
    "normals": (np.float32, None, 3),
    "origin": (np.float64, 3),
    "cell_m": (np.float64,),
    "thickness_m": (np.float64,),
}
SUBMAP_SCANS = 12
"""Scans of a submap; doubled until a place is found."""
_COARSEST_M = 0.8  # largest leaf cell of surfels of a submap
# Images from above, of steep surfaces: those of a building look alike from each height and tilt.
_STEEPEST = 0.7  # maximum vertical component of their normals
_PIXEL_M, _MOST_PIXELS = 0.5, 1 << 20  # edge of a pixel, larger in large maps
_SMOOTHED, _BACKGROUND = 1.0, 8.0  # standard deviations of the Gaussians of a band pass, pixels
_PRESENCE = 0.5  # weight of the presence of a surface, relative to that of the agreement of normals
_YAW_PIXELS = 1.5  # shift of the outer returns between two headings
_PEAKS = 64  # best positions by heading, and places of the whole search
_APART_PIXELS = 5.0  # between two places
# Registration of these places with the planes of the map.
_SCORED, _REGISTERED = 300, 1500  # points of the submap
_PASSES = 3  # of Gauss-Newton, coarse to fine
_BEST = 16  # places to register, of the candidates, of those that agree most, and of those elsewhere
_PRIOR_SIGMAS = (2.0, 2.0, 2.0, 0.1, 0.1, 0.3)  # of a place, m and rad
_OUTER = 90  # percentile of the distances from the middle of a submap
# Least log likelihood ratio of a place to others, and to chance. Of 402 best places that are wrong, 52 have one above 0, 16 above 1,
# 7 above 2, 4 above 3, at most 6.3: by a factor of 2.4 fewer each, so 0.1 above this one.
_LOG_ODDS = np.log(1e3)
# Distance of points of one object in one plane, capture ranges; of other ones, one capture range.
_IN_PLANE = 3.0
_FEWEST_POINTS = 3  # of an object: fewer may be clutter


class Lost(ValueError):
    """The pose of scans is unknown: they agree with what they are registered with nowhere, or in several places."""

    def __init__(self, message: str, places: Floats | None = None, agreeing: float = 0.0) -> None:
        super().__init__(message)
        self.places = np.zeros((0, 4, 4)) if places is None else places
        """(K, 4, 4) transforms from the frame of the scans to that of the map that fit about equally well."""
        self.agreeing = agreeing
        """Agreement at the best place, in [0, 1]."""


@dataclass(frozen=True)
class OrientedPoints:
    """Points on surfaces with normals towards free space."""

    points: Floats  # (N, 3) m
    normals: Floats  # (N, 3)
    thickness_m: float  # standard deviation of the points across the surface

    @classmethod
    def of_returns(
        cls, returns: SensorReturns, poses: Floats, leaf_m: float, num_threads: int
    ) -> "OrientedPoints":
        """Compute the flat surfels of scans at poses (F, 4, 4), of cells in which most returns have one."""
        rays = returns.posed(poses)
        while True:
            surfels = Surfels.of(rays, leaf_m, num_threads)
            in_planes = surfels.counts[surfels.cell_of_plane].sum()
            if 2 * in_planes >= surfels.counts.sum() or leaf_m > _COARSEST_M:
                break
            leaf_m *= np.sqrt(2)
        flat = surfels.is_flat()
        thickness_m = float(np.sqrt(np.median(surfels.variances[flat, 0]))) if flat.any() else 0.0
        return cls(surfels.centres[flat] + rays.origin, surfels.normals[flat], thickness_m)

    @cached_property
    def centre(self) -> Floats:
        return self.points.mean(axis=0)

    @cached_property
    def radius_m(self) -> float:
        away = np.linalg.norm((self.points - self.centre)[:, :2], axis=1)
        return float(np.percentile(away, _OUTER))

    @property
    def steep(self) -> Bools:
        return np.abs(self.normals[:, 2]) < _STEEPEST


@dataclass(frozen=True)
class SurfaceIndex:
    """Surface of a map, prepared for searches.

    Build it by :meth:`of`, and pass it to :func:`radarsdf.locate` in place of a large map.
    """

    surface: OrientedPoints  # relative to `origin`
    cell_m: float  # edge of the cell of a surfel of the map, m
    origin: Floats  # (3,) m, in the world of the map

    @classmethod
    def of_surface(cls, surface: OrientedPoints, origin: Floats, leaf_m: float) -> "SurfaceIndex":
        """Build from a surface in the world of the map, in leaf cells of `leaf_m`."""
        local = replace(surface, points=surface.points - origin)
        return cls(local, LEAVES_PER_SURFEL * leaf_m, origin)

    @classmethod
    def of(cls, radar_map: Map) -> "SurfaceIndex":
        """Build from the mesh of a map, in its world."""
        leaf_m = radar_map.config.leaf_size_m
        parts = [cls.of_mesh(mesh, leaf_m) for mesh in radar_map.meshes(leaf_m) if len(mesh.faces)]
        check(parts, "the map has no surface")
        points = np.concatenate([part.surface.points + part.origin for part in parts])
        normals = np.concatenate([part.surface.normals for part in parts])
        thickness_m = float(np.median([part.surface.thickness_m for part in parts]))
        return cls.of_surface(OrientedPoints(points, normals, thickness_m), points.mean(axis=0), leaf_m)

    @classmethod
    def of_mesh(cls, mesh: Mesh, leaf_m: float) -> "SurfaceIndex":
        """Build from the mesh of a map of leaf cells of `leaf_m`, with `uncertainty_m` of its vertices."""
        check(len(mesh.faces) != 0, "the map has no surface")
        origin = np.asarray(mesh.vertices, np.float64).mean(axis=0)
        points, normals = mesh.vertices - origin, np.asarray(mesh.vertex_normals, np.float64)
        # Planes have errors of the map, and do not fit bends.
        rows = np.linspace(0, len(points) - 1, _SAMPLED).astype(np.int64)
        near = np.minimum(cKDTree(points).query(points[rows], _NEIGHBOURS)[1], len(points) - 1)
        off_m = np.einsum("ni,nki->nk", normals[rows], points[near] - points[rows, None])
        uncertainty_m = np.nanmedian(np.asarray(mesh.vertex_attributes["uncertainty_m"], np.float64))
        surface = OrientedPoints(points, normals, float(np.hypot(uncertainty_m, off_m.std())))
        return cls(surface, LEAVES_PER_SURFEL * leaf_m, origin)

    def save(self, path: str | PathLike[str]) -> None:
        """Write an ``.npz`` file for :meth:`load`, atomically."""
        normals = self.surface.normals.astype(np.float32)
        values = self.surface.points, normals, self.origin, self.cell_m, self.surface.thickness_m
        write_arrays(path, dict(zip(_ARRAYS, map(np.asarray, values), strict=True)), compressed=True)

    @classmethod
    def load(cls, path: str | PathLike[str]) -> "SurfaceIndex":
        """Read a file written by :meth:`save`. Raise a ValueError if it is another file, or damaged."""
        arrays = arrays_of(path, _ARRAYS)
        with reading(path, "the index of a map"):
            check_archive(path)
            check_arrays(arrays, _ARRAYS)
            points, normals, origin, cell_m, thickness_m = (arrays[name] for name in _ARRAYS)
            check(len(points) == len(normals), "points and normals must be equally many")
        surface = OrientedPoints(points, normals.astype(np.float64), float(thickness_m))
        return cls(surface, float(cell_m), origin)

    def near(self, middles: Floats, reach_m: float, cells: float = 1.0) -> PlaneMap:
        """Build the planes of the surface within `reach_m` of places (K, 3)."""
        planes, points, middles = PlaneMap(cells * self.cell_m), self.surface.points, middles[:, :2]
        lower, upper = middles.min(axis=0) - reach_m, middles.max(axis=0) + reach_m
        # A query for all points of a square kilometre takes seconds.
        points = points[((points[:, :2] >= lower) & (points[:, :2] <= upper)).all(axis=1)]
        within, _ = cKDTree(middles).query(points[:, :2], distance_upper_bound=reach_m)
        planes.add(points[np.isfinite(within)])
        return planes

    def outlines(self, points: Floats, margin_m: float) -> Bools:
        """Return a mask (N,) of points (N, 3) that are, seen from above, within the convex outline of the map."""
        normals, offsets = np.split(self._outline, [2], axis=1)
        return np.asarray((points[:, :2] @ normals.T + offsets.T <= margin_m).all(axis=1))

    @cached_property
    def _outline(self) -> Floats:
        """Unit normals and offsets (E, 3) of the edges; a point is inside where all n · x + offset ≤ 0."""
        return np.asarray(ConvexHull(self.surface.points[:, :2], qhull_options="QJ").equations)

    @cached_property
    def tree(self) -> cKDTree:
        return cKDTree(self.surface.points)

    @cached_property
    def _images(self) -> "tuple[_Raster, Array]":
        steep = self.surface.steep
        raster = _Raster.around(self.surface.points[steep])
        images = raster.draw(self.surface.points[steep], self.surface.normals[steep])
        images = gaussian_filter(images, (0, _SMOOTHED, _SMOOTHED))
        images[0] -= gaussian_filter(images[0], _BACKGROUND)
        images[0] *= _PRESENCE
        return raster, images

    def candidates(self, submap: OrientedPoints, num_threads: int) -> Floats:
        """Return the poses (K, 4, 4) at which the submap, seen from above, resembles the map most, best first."""
        # Cross-correlation of images for all positions at once, by heading (Barnea and Silverman 1972 compare other measures).
        steep = submap.steep
        if not steep.any() or not self.surface.steep.any():
            msg = "the scans or the map show no steep surface"
            raise Lost(msg)
        raster, images = self._images
        points, normals = submap.points[steep] - submap.centre, submap.normals[steep]
        pixel_m, radius_m = raster.pixel_m, max(submap.radius_m, raster.pixel_m)
        half = int(np.linalg.norm(points[:, :2], axis=1).max() / pixel_m) + 2
        shape = [fft.next_fast_len(int(n) + 2 * half, real=True) for n in raster.shape]
        spectra = fft.rfft2(images, shape, workers=num_threads)
        own = _Raster(np.full(2, -half * pixel_m), (2 * half + 1,) * 2, pixel_m)
        yaws = np.arange(0.0, 2 * np.pi, _YAW_PIXELS * pixel_m / radius_m)
        found = []
        for yaw in yaws:
            R = rotation(np.array([0.0, 0.0, yaw]))
            drawn = own.draw(points @ R.T, normals @ R.T)
            spectrum = (spectra * np.conj(fft.rfft2(drawn, shape, workers=num_threads))).sum(axis=0)
            scores = fft.irfft2(spectrum, shape, workers=num_threads) / max(drawn[0].sum(), 1.0)
            pixels, best = _peaks(scores)
            # Negative shifts of a periodic image are at its end.
            pixels = np.where(pixels > np.array(raster.shape) + half, pixels - shape, pixels) + half
            at = raster.corner + (pixels + 0.5) * pixel_m
            found.append(np.column_stack([best, np.full(len(best), yaw), at]))
        all_found = np.concatenate(found)
        all_found = all_found[np.argsort(-all_found[:, 0], kind="stable")]
        chosen: list[Floats] = []
        while len(all_found) and len(chosen) < _PEAKS:
            first = all_found[0]
            chosen.append(first)
            turned = np.abs((all_found[:, 1] - first[1] + np.pi) % (2 * np.pi) - np.pi)
            away_m = np.linalg.norm(all_found[:, 2:] - first[2:], axis=1)
            all_found = all_found[turned * radius_m + away_m > _APART_PIXELS * pixel_m]
        _, yaw, x, y = np.array(chosen).T
        o = np.zeros_like(yaw)
        poses = transform(np.column_stack([o, o, yaw]), np.column_stack([x, y, o]))
        return _shifted(poses, -submap.centre)


@dataclass(frozen=True)
class _Raster:
    """Pixels of images from above."""

    corner: Floats  # (2,) m
    shape: tuple[int, int]
    pixel_m: float

    @classmethod
    def around(cls, points: Floats) -> "_Raster":
        lower, upper = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
        pixel_m = max(_PIXEL_M, float(np.sqrt((upper - lower + 1).prod() / _MOST_PIXELS)))
        rows, columns = (np.ceil((upper - lower) / pixel_m) + 5).astype(int).tolist()
        return cls(lower - 2 * pixel_m, (rows, columns), pixel_m)

    def draw(self, points: Floats, normals: Floats) -> Floats32:
        """Draw points (N, 3) with normals (N, 3): presence and mean horizontal normals, (3, rows, columns)."""
        # Presence instead of numbers, which depend on the radar and on how often it came by.
        pixels = np.floor((points[:, :2] - self.corner) / self.pixel_m).astype(np.int64)
        flat, size = np.ravel_multi_index(tuple(pixels.T), self.shape, mode="clip"), math.prod(self.shape)
        counts = np.bincount(flat, minlength=size)
        sums = [counts > 0, *(np.bincount(flat, n / counts[flat], size) for n in normals[:, :2].T)]
        return np.stack(sums).astype(np.float32).reshape(3, *self.shape)


def _peaks(scores: Array) -> tuple[Array, Array]:
    """Return the pixels (K, 2) of the best scores of as many blocks of 4 × 4, and these scores (K,)."""
    rows, columns = (n // 4 for n in scores.shape)
    blocks = scores[: 4 * rows, : 4 * columns].reshape(rows, 4, columns, 4)
    best = reduce(np.maximum, np.moveaxis(blocks.max(axis=1), 2, 0)).ravel()
    chosen = np.argpartition(-best, min(_PEAKS, len(best)) - 1)[:_PEAKS]
    row, column = np.unravel_index(chosen, (rows, columns))
    inside = blocks[row, :, column].reshape(-1, 16).argmax(axis=1)
    return np.column_stack([4 * row + inside // 4, 4 * column + inside % 4]), best[chosen]


def search_scans(
    index: SurfaceIndex, returns: SensorReturns, poses: Floats, num_threads: int
) -> tuple[Floats, slice]:
    """Search for parts of a drive with poses (F, 4, 4), ever longer ones, until one is found. Raise Lost if none is.

    Return the transform (4, 4) from the world of the drive to that of the map, and the scans of the part.
    """
    why = Lost("there are no returns")
    for part, submap in _submaps(index, returns, poses, num_threads):
        try:
            return search(index, submap, num_threads), part
        except Lost as lost:
            why = lost
    raise why


def _submaps(
    index: SurfaceIndex, returns: SensorReturns, poses: Floats, num_threads: int, *, begins: bool = False
) -> Iterator[tuple[slice, OrientedPoints]]:
    """Yield parts of a drive with returns, ever longer ones, and their surfaces. `begins`: only those from the first scan on."""
    count, length = len(poses), SUBMAP_SCANS // 2
    while length < count or length < SUBMAP_SCANS:
        length *= 2
        for first in range(0, 1 if begins else max(count - length // 2, 1), length):
            part = slice(first, min(first + length, count))
            inside = returns.select((returns.scans >= part.start) & (returns.scans < part.stop))
            if len(inside):
                leaf_m = index.cell_m / LEAVES_PER_SURFEL
                yield part, OrientedPoints.of_returns(inside, poses, leaf_m, num_threads)


def search(index: SurfaceIndex, submap: OrientedPoints, num_threads: int) -> Floats:
    """Find the pose (4, 4) of a submap in the world of the map. Raise Lost if it is not unique.

    At the best pose, more objects must agree with the planes of the map than at each of the others, and than by chance, which the
    others show. So no place is found if two are alike, nor if the map does not show the place at all: then the best of many wrong
    poses agrees by the object that it is registered to.
    """
    found = _Places.of(index, submap, num_threads)
    best = int(np.argmax(found.agreeing))
    if (why := found.refusal(best)) is not None:
        raise why
    return found.poses_of_frame[best]


def search_near(
    index: SurfaceIndex, returns: SensorReturns, poses: Floats, guess: Floats, num_threads: int
) -> tuple[Floats, str]:
    """Place a drive with poses (F, 4, 4) near `guess` (4, 4), if it agrees better with the map there than elsewhere and by chance.

    Return the transform from the world of the drive to that of the map, and where the returns cannot tell, the guess and a note. Raise
    Lost if the drive clearly agrees better elsewhere.
    """
    note = "The returns do not confirm the guess: the scans or the map show no steep surface."
    # The guess is that of the first scan, from which poses drift.
    for _, submap in _submaps(index, returns, poses, num_threads, begins=True):
        try:
            found = _Places.of(index, submap, num_threads, guess)
        except Lost:
            continue
        k = int(np.argmax(found.agreeing))
        if k in found.elsewhere(0) and found.refusal(k) is None:
            at = found.names
            msg = f"the scans agree better with the map at {at[k]} than at the guess, {at[0]}"
            raise found.lost(msg, k, 0)
        if (why := found.refusal(0)) is None:
            return found.poses_of_frame[0], ""
        note = f"The returns do not confirm the guess: {why}."
    return guess, note


@dataclass(frozen=True)
class _Places:
    """Places of a submap, registered with the planes of a map."""

    index: SurfaceIndex
    centre: Floats  # (3,) of the submap
    points: Floats  # (N, 3) of the submap from its centre, m
    poses: Floats  # (K, 4, 4) of these points, relative to the origin of the index
    scores: Floats  # (K, N) agreement of each point, in [0, 1]
    objects: Floats  # (N, O) 1 where a point is on an object, else 0
    capture_m: float  # places nearer than that are one

    @classmethod
    def of(
        cls, index: SurfaceIndex, submap: OrientedPoints, num_threads: int, guess: Floats | None = None
    ) -> "_Places":
        """Register the first of the candidates, those that agree most, and the best elsewhere. The guess (4, 4) becomes the first place."""
        starts = _shifted(index.candidates(submap, num_threads), submap.centre)
        chosen = np.random.default_rng(0).permutation(len(submap.points))[:_REGISTERED]
        points = submap.points[chosen] - submap.centre
        given = np.zeros((0, 4, 4)) if guess is None else _shifted(guess[None], submap.centre)
        given[:, :3, 3] -= index.origin
        radius_m = max(submap.radius_m, 1.0)
        reach_m = float(np.linalg.norm(points[:, :2], axis=1).max())
        planes = index.near(np.concatenate([given, starts])[:, :3, 3], reach_m + 4 * index.cell_m)
        wide_m, few = 0.5 * planes.capture_m, points[:_SCORED]
        planes.variances = [wide_m**2, *[(wide_m / radius_m) ** 2] * 2]
        starts = _at_heights(planes, starts, few, index.surface.points[:, 2])
        means = planes.coarse.scores(few, np.ascontiguousarray(starts), planes.variances).mean(axis=1)
        rows = np.argsort(-means, kind="stable")
        elsewhere = rows[apart_m(starts[rows], starts[rows[0]], radius_m) > 3 * _PRIOR_SIGMAS[0]]
        # Coarse agreement prefers ground. In maps of half a scene, it has the true place, one of the first 15 candidates, 40th to 62nd.
        first = np.arange(min(_BEST, len(starts)))
        starts = np.concatenate([given, starts[np.unique([*first, *rows[:_BEST], *elsewhere[:_BEST]])]])
        sigma_m = max(submap.thickness_m, 0.1 * index.cell_m)
        planes.variances = [sigma_m**2, *[(sigma_m / radius_m) ** 2] * 2]
        prior, poses = np.diag(np.square(_PRIOR_SIGMAS)), starts
        for _ in range(_PASSES):
            pairs = zip(starts, poses, strict=True)
            poses = np.stack([planes.fit(points, mean, prior, pose).pose for mean, pose in pairs])
        scores = planes.fine.scores(points, poses, planes.variances)
        objects = _objects(points, submap.normals[chosen], planes.capture_m)
        return cls(index, submap.centre, points, poses, scores, objects, planes.capture_m)

    @cached_property
    def agreeing(self) -> Floats:
        """(K,) mean agreement of the points on objects: ground agrees wherever the map has much of it."""
        on = self.objects.any(axis=1)
        return np.asarray(self.scores @ on / max(int(on.sum()), 1))

    @property
    def names(self) -> list[str]:
        return [f"({x:.1f}, {y:.1f})" for x, y in self.poses[:, :2, 3] + self.index.origin[:2]]

    @property
    def poses_of_frame(self) -> Floats:
        """(K, 4, 4) from the frame of the submap to the world of the map."""
        poses = _shifted(self.poses, -self.centre)
        poses[:, :3, 3] += self.index.origin
        return poses

    def lost(self, message: str, *places: int) -> Lost:
        """Return the error with a message about these places, the best first."""
        return Lost(message, self.poses_of_frame[[*places]], float(self.agreeing[places[0]]))

    def refusal(self, place: int) -> Lost | None:
        """Return why the submap cannot be placed there. None if it can."""
        at, (odds, of_chance) = self.names, self._log_odds(place)
        if rivals := [k for k in self.elsewhere(place) if odds[k] <= _LOG_ODDS]:
            words = f"two places of the map fit about equally well: {at[place]} and {at[rivals[0]]}"
            return self.lost(words, place, rivals[0])
        if of_chance <= _LOG_ODDS:
            words = f"the surfaces around {at[place]} may agree with the map by chance"
            return self.lost(words, place)
        return None

    def elsewhere(self, place: int) -> Ints:
        """Return the other places, best first."""
        lever_m = float(np.median(np.linalg.norm(self.points, axis=1)))
        others = np.flatnonzero(apart_m(self.poses, self.poses[place], lever_m) > self.capture_m)
        return others[np.argsort(-self.agreeing[others])]

    def _log_odds(self, place: int) -> tuple[Floats, float]:
        """Return the log likelihood ratios of a place to each place (K,), and to none of them.

        At the true place, an object agrees unless it changed; elsewhere, by chance. One that the map does not show says nothing.
        """
        agreeing, known = self._agreeing_objects
        agree, others, own = agreeing > 0.5, self.elsewhere(place), known[place]
        # Registered to a wall or a corner, other places agree there as well, and hardly elsewhere.
        chance = ((agree & known)[others].sum(axis=0) + 0.5) / (known[others].sum(axis=0) + 1)
        changed = ((own & ~agree[place]).sum() + 1) / (own.sum() + 2)
        agrees, differs = np.log((1 - changed) / chance), np.log(changed / (1 - chance))
        each = ((agreeing * agrees + (1 - agreeing) * differs) * known).sum(axis=1)
        return each[place] - each, float(np.where(agree[place], agrees, differs)[own].sum())

    @cached_property
    def _agreeing_objects(self) -> tuple[Floats, Bools]:
        """(K, O) mean agreement of each object, and whether most of it is within the outline of the map."""
        # A map of a part of the scene says nothing about what lies around it.
        placed = (self.points @ pose[:3, :3].T + pose[:3, 3] for pose in self.poses)
        within = np.stack([self.index.outlines(points, self.capture_m) for points in placed])
        counts, scores = within @ self.objects, (within * self.scores) @ self.objects
        return scores / np.maximum(counts, 1), counts > 0.5 * self.objects.sum(axis=0)


def _shifted(poses: Floats, shift: Floats) -> Floats:
    """Return poses (K, 4, 4) of a frame whose origin is shifted by (3,)."""
    poses = poses.copy()
    poses[:, :3, 3] += np.einsum("kij,j->ki", poses[:, :3, :3], shift)
    return poses


def _objects(points: Floats, normals: Floats, capture_m: float) -> Floats:
    """Return 1 (N, O) where points (N, 3) are on an object, else 0: a connected steep surface, or several in one plane."""
    steep = np.flatnonzero(np.abs(normals[:, 2]) < _STEEPEST)
    objects = np.zeros((len(points), len(steep)))
    points, normals = points[steep], normals[steep]
    i, j = cKDTree(points).query_pairs(_IN_PLANE * capture_m, output_type="ndarray").T
    apart_m = points[j] - points[i]
    off_m = np.abs([np.einsum("ni,ni->n", normals[k], apart_m) for k in (i, j)]).max(axis=0)
    joined = (np.linalg.norm(apart_m, axis=1) < capture_m) | (off_m < capture_m / 2)
    pairs = coo_matrix((joined[joined], (i[joined], j[joined])), (len(steep), len(steep)))
    objects[steep, connected_components(pairs, directed=False)[1]] = 1
    return objects[:, objects.sum(axis=0) >= _FEWEST_POINTS]


def _at_heights(planes: PlaneMap, starts: Floats, points: Floats, heights_m: Floats) -> Floats:
    """Shift poses (K, 4, 4) to the height at which most points (N, 3) agree with the planes."""
    low, high = np.percentile(heights_m, [0, 100]) - np.percentile(points[:, 2], [98, 2])
    shifts_m = np.arange(min(low, high), max(low, high) + planes.capture_m, 0.5 * planes.capture_m)
    poses = np.repeat(starts, len(shifts_m), axis=0)
    poses[:, 2, 3] += np.tile(shifts_m, len(starts))
    means = planes.coarse.scores(points, poses, planes.variances).mean(axis=1).reshape(len(starts), -1)
    return poses.reshape(len(starts), -1, 4, 4)[np.arange(len(starts)), means.argmax(axis=1)]
