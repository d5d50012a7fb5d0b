"""Probability that a place changed, from the evidence of two maps.

Each probability follows from Bayes' rule for two hypotheses, no change or a change. The prior share of changes is
estimated from all places together (empirical Bayes, Efron 2010), so that chance alone causes few changes where nothing
changed.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.ndimage import uniform_filter
from scipy.spatial import cKDTree
from scipy.special import betaln, expit
from scipy.stats import t as student

from radarsdf.arrays import Bools, Floats, Ints, Ints32
from radarsdf.map.confidence import confidence, uncertainty
from radarsdf.map.map import Map
from radarsdf.map.mesh import across_triangles
from radarsdf.products import transformed, turned
from radarsdf.returns.view_statistics import PLACE_CELLS, ViewStatisticsAt, rows_of_views

# Reach of distances around the surface of a field: returns scatter into the next cells.
_REACH_CELLS = 2.0
# Smallest cosine between normals of surfaces that are about parallel: a moved one stays so.
PARALLEL = np.cos(np.pi / 4)
_BLOCK_M = 32.0  # edge of blocks in which cells are looked up, to limit memory
# Depth behind a surface at which the 27 cells hardly reach its visible side.
_BEHIND_CELLS = 1.5
_CELLS_ALONG_RAY = 3.0  # mean number of the 27 cells near a place that one ray crosses
_LEAST_SHARE, _MOST_SHARE = 1e-6, 0.5
_MAX_ITERATIONS, _TOLERANCE = 50, 1e-4  # iterations and tolerance of the share
# Returns of a scan in adjacent cells are correlated: this many count as one (tuned on facade, hall and forest of seed 31).
_CELLS_PER_SCAN = 2.0
_FREEDOMS = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 10.0, 30.0)
_SCALES = (0.5, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0)
_MAX_DISTANCES = 5_000  # evenly spread, for both maps
_REGIONS = (1.0, 2.0, 4.0)  # radii of regions that may have changed as a whole, in blocks


@dataclass(frozen=True)
class PlaceEvidence:
    """Surface, hits and free space of a map at N places."""

    distance_m: Floats  # (N,) from the surface along its normal. NaN where not observed
    normals: Floats  # (N, 3) of that surface, towards free space, in the common frame
    sigma_m: Floats  # (N,) standard error of the surface's position. NaN where there are no returns
    confidence: Floats  # (N,) probability of a surface there
    hits: Floats  # (N,) scans with returns in the 27 leaf cells near the place, summed over the cells
    # (N,) scans with rays through the 27 cells near a place behind the surface, also summed, one count per ray. Rays that
    # graze a surface pass in front of it, and are no evidence against it.
    passes: Floats


@dataclass(frozen=True)
class PlacedMap:
    """A map and its pose in the common frame."""

    radar_map: Map
    T_common_map: Floats  # (4, 4) from the map's world to the common frame, m
    vertices: Floats  # (V, 3) of the map's default mesh, in leaf cells; world of the map, m
    faces: Ints32  # (F, 3) rows of vertices
    normals: Floats  # (V, 3) of the mesh, towards free space
    sigma_m: Floats  # (V,) standard errors of the vertices, m

    @classmethod
    def of(cls, radar_map: Map) -> "PlacedMap":
        """Build from a map whose world is the common frame."""
        mesh = radar_map.mesh(radar_map.config.leaf_size_m, progress=False)
        vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int32)
        normals = np.asarray(mesh.vertex_normals, np.float64)
        sigma_m = np.asarray(mesh.vertex_attributes["uncertainty_m"], np.float64)
        return cls(radar_map, np.eye(4), vertices, faces, normals, sigma_m)

    @property
    def leaf_m(self) -> float:
        return self.radar_map.config.leaf_size_m

    @property
    def reach_m(self) -> float:
        """Distance from its surface up to which the map is defined, m."""
        return _REACH_CELLS * self.leaf_m

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.vertices)

    def nearest(self, x: Floats) -> tuple[Floats, Ints, Floats]:
        """Distances to the vertices nearest to places (N, 3), world of the map, their rows, and distances from their planes."""
        near_m, rows = self._tree.query(x)
        return near_m, rows, np.einsum("ni,ni->n", x - self.vertices[rows], self.normals[rows])

    def to_own(self, x: Floats) -> Floats:
        """Transform places (N, 3) from the common frame to the world of the map."""
        return turned(x - self.T_common_map[:3, 3], self.T_common_map[:3, :3].T)

    def evidence(self, x: Floats, facing: Floats | None = None) -> PlaceEvidence:
        """Evidence at places (N, 3) on a surface. `facing` (N, 3): its normals; default: those of the map."""
        own = self.to_own(x)
        evidence, contents = self.radar_map.evidence_at(own), self.radar_map.contents_of_any
        distance_m, normals = self.radar_map.tangent_planes(own)
        normals = turned(normals, self.T_common_map[:3, :3])
        behind = x - _BEHIND_CELLS * self.leaf_m * np.nan_to_num(normals if facing is None else facing)
        known = uncertainty(contents, evidence), confidence(contents, evidence), evidence.hits
        uncertainty_m, probability, hits = (values.astype(np.float64) for values in known)
        passes = self._passes(self.to_own(behind))
        return PlaceEvidence(distance_m, normals, uncertainty_m, probability, hits, passes)

    def _passes(self, own: Floats) -> Floats:
        found = np.zeros(len(own))
        blocks = np.unique(np.floor(own / _BLOCK_M), axis=0, return_inverse=True)[1].ravel()
        edges = np.cumsum(np.bincount(blocks))[:-1]
        for rows in np.split(np.argsort(blocks, kind="stable"), edges) if len(own) else []:
            x, margin_m = own[rows], 2 * self.leaf_m
            cells = self.radar_map.cells_near(x.min(axis=0) - margin_m, x.max(axis=0) + margin_m)
            # The core counts up to seven scans per cell: larger counts carry no information.
            near = 27 * uniform_filter(cells.passed.astype(np.float32), 3, mode="constant")
            places = np.floor((x - cells.corner) / self.leaf_m).astype(np.int64)
            found[rows] = np.rint(near[tuple(places.T)]) / _CELLS_ALONG_RAY
        return found


@dataclass(frozen=True)
class Side:
    """Surface of one map with the evidence of both maps at its vertices."""

    vertices: Floats  # (V, 3) common frame, m
    faces: Ints32  # (F, 3) rows of vertices
    own: PlaceEvidence
    other: PlaceEvidence
    sigma_m: Floats  # (V,) standard error of the distance between both surfaces, m
    reach_m: float  # :attr:`PlacedMap.reach_m` of the other map

    @property
    def observed(self) -> Bools:
        """(V,) whether the distance is known."""
        return np.isfinite(self.other.distance_m) & np.isfinite(self.sigma_m)

    @property
    def parallel(self) -> Bools:
        """(V,) whether the other map's surface is about parallel."""
        return np.einsum("ni,ni->n", self.own.normals, self.other.normals) >= PARALLEL

    def region_odds(self, free: Floats, distances: Floats) -> Floats:
        """(V,) log odds that a region around each vertex is absent, by log odds (V,) of free space and of distances."""
        # One ray counts in a block of three cells, and other rays in the next, so their log odds add up over blocks. Errors
        # of distances are correlated within a region, so the mean of their log odds counts once.
        block_m = _CELLS_ALONG_RAY * self.reach_m / _REACH_CELLS
        _, twice_m2 = across_triangles(self.vertices, self.faces)
        weights = np.bincount(self.faces.ravel(), np.repeat(twice_m2 / 6, 3), len(free)) / block_m**2
        along = np.abs(np.nan_to_num(self.own.normals)).argmax(axis=1)
        # Walls along different axes are far apart along a fourth one.
        places = np.column_stack([np.floor(self.vertices / block_m), 1e6 * along])
        blocks, rows = np.unique(places, axis=0, return_inverse=True)
        columns = [np.bincount(rows.ravel(), weights * odds, len(blocks)) for odds in (1, free, distances)]
        tree, found = cKDTree(blocks), [free + distances]
        for radius in _REGIONS:
            near = tree.sparse_distance_matrix(tree, radius, output_type="coo_matrix")
            near.data[:] = 1
            area, of_rays, of_distances = (near @ column for column in columns)
            found.append((of_rays + of_distances / np.maximum(area, 1))[rows.ravel()])
        return np.asarray(np.logaddexp.reduce(found) - np.log(len(found)))


@dataclass(frozen=True)
class Errors:
    """Student-t model of normalised distances between unchanged surfaces.

    At edges, in corners and at ghosts, errors of both maps exceed their uncertainty, so the distribution is heavy-tailed.
    """

    freedom: float  # degrees of freedom: few mean heavy tails
    scale: float  # ratio of the errors to the standard errors

    @classmethod
    def of(cls, sides: Sequence[Side]) -> "Errors":
        """Fit by maximum likelihood, with an unknown share of the distances to other surfaces within reach."""
        within = ((side, np.full(len(side.sigma_m), side.reach_m)) for side in sides)
        columns = [np.stack([s.other.distance_m, s.sigma_m, reach_m])[:, s.observed] for s, reach_m in within]
        known = np.concatenate(columns, axis=1)
        if known.size == 0:
            return cls(_FREEDOMS[-1], 1.0)
        distance_m, sigma_m, reach_m = known[:, :: -(-known.shape[1] // _MAX_DISTANCES)]

        def likelihood(errors: Errors) -> float:
            same, other = errors.log_density(distance_m, sigma_m), -np.log(2 * reach_m)
            share = share_of_changes(other - same)
            return float(np.logaddexp(np.log(1 - share) + same, np.log(share) + other).sum())

        return max((cls(freedom, scale) for freedom in _FREEDOMS for scale in _SCALES), key=likelihood)

    def log_density(self, distance_m: Floats, sigma_m: Floats) -> Floats:
        """(N,) log density of distances (N,) with standard errors (N,), 1/m."""
        return np.asarray(student.logpdf(distance_m, self.freedom, scale=self.scale * sigma_m))

    def log_odds(self, side: Side) -> tuple[Floats, Floats, Floats]:
        """Log odds (V,), given the evidence, that the surface is absent from the other map rather than unchanged; that it is
        displaced along its normal to either side, -inf where that was not observed; and that a region around it is absent."""
        observed, reach_m = side.observed, side.reach_m
        distance_m, sigma_m = side.other.distance_m[observed], side.sigma_m[observed]
        same = self.log_density(distance_m, sigma_m)

        def elsewhere(lower_m: float) -> Floats:
            """Density of a surface that lies anywhere from `lower_m` to `reach_m`."""
            error = student(self.freedom, distance_m, self.scale * sigma_m)
            # Far in the tails, the difference is only rounding.
            inside = np.maximum(error.cdf(reach_m) - error.cdf(lower_m), 1e-12)
            return np.log(inside / (reach_m - lower_m)) - same

        free = _free_space_odds(side.own, side.other)
        distances, shifted = np.zeros(len(free)), np.full(len(free), -np.inf)
        shifted[observed] = elsewhere(-reach_m)
        distances[observed] = elsewhere(0.0)
        return free + distances, shifted, side.region_odds(free, distances)


def _free_space_odds(own: PlaceEvidence, other: PlaceEvidence) -> Floats:
    """(N,) log likelihood ratio of the other map's rays: surface gone against unchanged."""
    # Of all scans whose rays reach a place, some have returns there, and others pass behind it. If nothing changed, the share
    # of hits is that of the own map, which is small for a thin fence. If it is gone, any share is possible (beta-binomial).
    hits, passes = other.hits / _CELLS_PER_SCAN, other.passes / _CELLS_PER_SCAN
    hit, missed = own.hits / _CELLS_PER_SCAN + 0.5, own.passes / _CELLS_PER_SCAN + 0.5
    same = betaln(hit + hits, missed + passes) - betaln(hit, missed)
    changed = betaln(0.5 + hits, 0.5 + passes) - betaln(0.5, 0.5)
    fewer = hits < (hits + passes) * hit / (hit + missed)
    return np.where(fewer, changed - same, np.minimum(changed - same, 0))


def odds_of_differences(differences: Floats, sigma: Floats, reach: float) -> Floats:
    """(N,) log likelihood ratio of differences (N,): a change of any size within reach against errors alone."""
    return 0.5 * (differences / sigma) ** 2 + np.log(sigma * np.sqrt(2 * np.pi) / (2 * reach))


def share_of_changes(log_odds: Floats) -> float:
    """Maximum-likelihood share of changed places, given the evidence of all of them."""
    share = 0.01
    if len(log_odds) == 0:
        return _LEAST_SHARE
    for _ in range(_MAX_ITERATIONS):
        before, share = share, float(np.clip(posterior(log_odds, share).mean(), _LEAST_SHARE, _MOST_SHARE))
        if abs(share - before) < _TOLERANCE * share:
            break
    return share


def posterior(log_odds: Floats, share: float) -> Floats:
    """(N,) posterior probability of a change, for a prior `share` of changed places."""
    return np.asarray(expit(log_odds + np.log(share / (1 - share))))


_UNITS_RATIO = 1.7  # ratio of spreads that shows different units: half decibels and decibels differ by 2
_MIN_VIEWS = 100  # needed to determine the units


@dataclass(frozen=True)
class _Means:
    points: Floats  # (K, 3) common frame, m
    values: Floats  # (K,) sensor units
    variances: Floats  # (K,) from the number of returns per mean

    def select(self, chosen: Bools) -> "_Means":
        return _Means(self.points[chosen], self.values[chosen], self.variances[chosen])

    def near(self, x: Floats, reach_m: float) -> tuple[Floats, Floats, Floats, Floats]:
        """Weighted mean of values within reach of places (V, 3) (NaN without any), standard error, χ² and degrees of freedom."""
        near = cKDTree(x).sparse_distance_matrix(cKDTree(self.points), reach_m, output_type="coo_matrix")
        near.data[:] = 1
        weights = 1 / self.variances
        weight = near @ weights
        with np.errstate(invalid="ignore", divide="ignore"):
            mean = near @ (weights * self.values) / weight
            chi2 = near @ (weights * self.values**2) - weight * mean**2
            freedom = np.maximum(near @ np.ones(len(weights)) - 1, 0)
            return mean, 1 / np.sqrt(weight), np.nan_to_num(chi2), freedom


@dataclass(frozen=True)
class Differences:
    """Differences of mean intensities between two drives, per place and view."""

    between: _Means  # later minus earlier, without `offset`
    within: list[_Means]  # per drive, residuals of the intensities from its own map
    offset: float  # common increase of all returns, sensor units
    reach_m: float  # radius of the neighbourhood of a place, m
    width: float  # width of the range of intensities, sensor units

    @classmethod
    def of(cls, before: PlacedMap, after: PlacedMap) -> "Differences | str":
        """Build from two maps; or return the reason why they cannot be compared.

        The predictions of both maps are subtracted from both drives, so views may differ a little within one view bin.
        """
        scales = [p.radar_map.intensity_scale for p in (before, after)]
        days = []
        for p in (before, after):
            day, T = p.radar_map.view_statistics(), p.T_common_map
            directions = turned(day.directions, T[:3, :3])
            days.append(replace(day, points=transformed(day.points, T), directions=directions))
        if None in scales or not all(len(day.counts) for day in days):
            return "Reflectance was not compared: a map has no intensities."
        leaf_m = max(before.leaf_m, after.leaf_m)
        both = ViewStatisticsAt.together(days)
        points, directions, ranges_m = both.points, both.directions, both.ranges_m
        sensors = points - directions * ranges_m[:, None]
        expected = [p.radar_map.intensity(p.to_own(points), p.to_own(sensors)) for p in (before, after)]
        left = both.intensities - np.mean(expected, axis=0)
        of_day = np.repeat([0, 1], [len(day.counts) for day in days])
        views, count = rows_of_views(points - points.mean(axis=0), directions, ranges_m, leaf_m)
        known = np.isfinite(left)
        row = (of_day * count + views)[known]
        columns = np.column_stack([np.ones(len(left)), left, both.intensities, points])[known]
        sums = np.stack([np.bincount(row, both.counts[known] * column, 2 * count) for column in columns.T])
        sums = sums.reshape(len(sums), 2, count)  # by day and view
        first, second = sums[:, :, (sums[0] > 0).all(axis=0)].transpose(1, 0, 2)
        if first.size == 0:
            return "Reflectance was not compared: the maps share no view."
        spreads = [np.subtract(*np.percentile(day[2] / day[0], [95, 5])) for day in (first, second)]
        if first.shape[1] > _MIN_VIEWS and max(spreads) > _UNITS_RATIO * min(spreads):
            return "Reflectance was not compared: spreads of intensities from equal views imply other units."
        values = second[1] / second[0] - first[1] / first[0]
        offset = float(np.median(values))
        variances = days[0].sigma ** 2 / first[0] + days[1].sigma ** 2 / second[0]
        between = _Means(((first[3:] + second[3:]) / (first[0] + second[0])).T, values - offset, variances)
        within = []
        for number, day in enumerate(days):
            rest = day.intensities - expected[number][of_day == number]
            within.append(_Means(day.points, rest, day.sigma**2 / day.counts).select(np.isfinite(rest)))
        width = max(scale.high - scale.low for scale in scales if scale is not None)
        return cls(between, within, offset, PLACE_CELLS * leaf_m, width)

    def probability(self, x: Floats, same: Bools, changed: Floats) -> tuple[Floats, Floats]:
        """(V,) difference near places (V, 3), and probability that only the reflectance changed, for places that are `same` (V,).

        Views near places (C, 3) that `changed` otherwise are ignored. If views of one place scatter more than their numbers
        of returns explain, within a drive or in their differences, errors are scaled up (Birge's ratio): at edges, near
        mirrors, in thickets. A change of reflectance is the same from all views.
        """
        between = self.between
        if len(changed):
            between = between.select(cKDTree(changed).query(between.points)[0] > self.reach_m)
        mean, sigma, chi2, freedom = between.near(x, self.reach_m)
        _, _, chi2_of_day, freedom_of_day = np.sum([day.near(x, self.reach_m) for day in self.within], axis=0)
        ratios = chi2 / np.maximum(freedom, 1), chi2_of_day / np.maximum(freedom_of_day, 1)
        sigma = sigma * np.sqrt(np.maximum(np.maximum(*ratios), 1))
        known = same & np.isfinite(mean)
        # A change may have any size within the range of intensities.
        odds = odds_of_differences(mean[known], sigma[known], self.width)
        probability = np.zeros(len(x))
        probability[known] = posterior(odds, share_of_changes(odds))
        return mean, probability
