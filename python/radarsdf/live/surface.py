"""Surface of a live map: a quick fit of the sums, updated incrementally by regions of 64³ leaf cells."""

import math

import numpy as np

from radarsdf.arrays import Array, Bools, Floats, Floats32, Ints, Keys
from radarsdf.config.fit_config import FitConfig
from radarsdf.core import CellBlocks, Encoding, VertexTable, cell_keys, marching_cubes_sparse
from radarsdf.fitting import surface_returns
from radarsdf.map.confidence import interpolated
from radarsdf.map.marching_cubes import sparse_lattice
from radarsdf.map.mesh import Surface
from radarsdf.map.queries import WholeMap, to_local
from radarsdf.returns import evidence
from radarsdf.returns.ghosts import find_ghosts
from radarsdf.returns.noise import SensorNoise
from radarsdf.returns.planes import LEAVES_PER_SURFEL, MIN_SUPPORT, Surfels, neighbour_planes
from radarsdf.returns.sums import MAX_CELLS_FROM_ORIGIN, MeanRays, ScanSums, lattice_of, merged_keys
from radarsdf.threads import resolve_num_threads

Rows = dict[str, Array]

REGION_CELLS = 64  # leaf cells along the edge of a region
REGION_BITS = np.uint64(18)  # bits of a leaf cell's Morton key below those of its region
NO_KEYS = np.zeros(0, np.uint64)
_BLOCK_CELLS, _LARGE_CELLS = 8, 16  # edges of cubes that quantise distances from changes, leaf cells


def steps_near(reach: int) -> Ints:
    """Return all offsets ((2 reach + 1)³, 3) of at most `reach` along each axis."""
    return np.array(list(np.ndindex(*(2 * reach + 1,) * 3)), np.int64) - reach


def shifted(keys: Keys, steps: Ints) -> Keys:
    """Return the unique ascending keys of cells at offsets `steps` (S, 3) from `keys` (N,)."""
    return np.unique(_keys_at((lattice_of(keys)[:, None] + steps).reshape(-1, 3)))


def cubes_near(leaf_keys: Keys, edge: int, reach: int) -> Keys:
    """Return keys of the first leaf cells of cubes of `edge` (power of two) cells within `reach` cells of those of `leaf_keys`."""
    bits = np.uint64(3 * (edge.bit_length() - 1))
    corners = np.unique(leaf_keys >> bits) << bits
    return shifted(corners, edge * steps_near(math.ceil(reach / edge)))


def regions_of(leaf_keys: Keys) -> Keys:
    """Return the unique ascending keys of the regions of leaf cells."""
    return np.unique(leaf_keys >> REGION_BITS)


def within(leaf_keys: Keys, regions: Keys) -> Bools:
    """Return a mask (N,) of the leaf cells in `regions`."""
    return np.isin(leaf_keys >> REGION_BITS, regions)


def regions_near(regions: Keys, reach: int) -> Keys:
    """Return the ascending keys of these regions, and of those at most `reach` away along each axis."""
    return regions_of(shifted(regions << REGION_BITS, REGION_CELLS * steps_near(reach)))


def _keys_at(cells: Ints) -> Keys:
    # The centre of a cell of 1 m is exact in float64.
    return cell_keys(np.clip(cells, -MAX_CELLS_FROM_ORIGIN, MAX_CELLS_FROM_ORIGIN - 1) + 0.5, 1.0, 1)


class RegionTable:
    """Table by ascending Morton keys of cells, with an edge of 1 or 2 leaf cells, partitioned into regions."""

    def __init__(self, leaves_per_cell: int = 1, **columns: Array) -> None:
        """Create an empty table. `columns`: default row of each column."""
        self._leaves_per_cell = leaves_per_cell
        self._new: Rows = {"keys": np.zeros(1, np.uint64), **columns}
        self._parts: dict[int, Rows] = {}
        self.num_bytes = 0

    def gather(self, regions: Keys | None = None) -> Rows:
        """Return the rows of ascending `regions` (R,), in the order of their keys. None: all."""
        wanted = sorted(self._parts) if regions is None else regions.tolist()
        empty = {name: new[:0] for name, new in self._new.items()}
        parts = [empty, *(self._parts[region] for region in wanted if region in self._parts)]
        return {name: np.concatenate([part[name] for part in parts]) for name in empty}

    def carried(self, regions: Keys, keys: Keys) -> Rows:
        """Return rows for `keys`, all in `regions`: the existing ones, else defaults."""
        before = self.gather(regions)
        rows = {name: np.repeat(new, len(keys), axis=0) for name, new in self._new.items()}
        _, after, old = np.intersect1d(keys, before["keys"], assume_unique=True, return_indices=True)
        for name, column in rows.items():
            column[after] = before[name][old]
        return rows | {"keys": keys}

    def put(self, regions: Keys, rows: Rows) -> None:
        """Replace all rows of ascending `regions` (R,) by those of `rows` in them."""
        of_rows = self.regions_of(rows["keys"])
        ends = np.searchsorted(of_rows, regions, side="right").tolist()
        starts = np.searchsorted(of_rows, regions).tolist()
        for region, start, end in zip(regions.tolist(), starts, ends, strict=True):
            self.num_bytes -= sum(column.nbytes for column in self._parts.pop(region, {}).values())
            if start < end:
                part = self._parts[region] = {name: rows[name][start:end].copy() for name in self._new}
                self.num_bytes += sum(column.nbytes for column in part.values())

    def regions_of(self, keys: Keys) -> Keys:
        """Return the regions (N,) of this table's cells with `keys` (N,)."""
        return _keys_at(self._leaves_per_cell * lattice_of(keys)) >> REGION_BITS


class GrowingSurface:
    """Planes, ghosts, distances and triangles of sums over scans. :meth:`update` recomputes what depends on changes.

    The result is a function of the sums, the visibility counts and the noise, bit-identical for any history. Planes and
    distances take most of the time, and are cached by region. Ghosts and triangles are recomputed for the whole map.
    """

    def __init__(self, config: FitConfig, origin: Floats) -> None:
        self._config = config  # quick settings
        self._surfel_m = LEAVES_PER_SURFEL * config.leaf_size_m
        self._origin = origin  # (3,) origin of the local frame, world, m
        self.complete = False  # set by the caller after :meth:`update`, so that a partial one is not used
        self._noise: SensorNoise | None = None
        vector = np.full((1, 3), np.nan, np.float32)
        number, count = np.zeros(1, np.float32), np.zeros(1, np.uint32)
        # Leaf cells with returns: mean rays and normals.
        self._leaves = RegionTable(
            points=vector, directions=vector, counts=number, scans=count, ranges_m=number, normals=vector
        )
        # Cells of surfels. Planes (centre, normal, variances) are NaN without support.
        row = {"moments": np.zeros((1, 13)), "support": np.zeros(1), "planes": np.full((1, 9), np.nan)}
        self._cells = RegionTable(LEAVES_PER_SURFEL, **row)
        self._surfels = self._surfels_of(self._cells.gather())  # surfels of all cells
        self._ghosts = NO_KEYS  # ascending keys of the surfel cells with ghosts
        self._crossed = RegionTable()  # leaf cells that rays cross near their returns
        # These, and the bridges over gaps between them: distances at the corners, m, whether they change sign, evidence.
        self.distances = RegionTable(
            values=np.zeros((1, 8), np.float32), crossed=np.zeros(1, bool), information=number, hits=count
        )

    @property
    def num_bytes(self) -> int:
        return sum(table.num_bytes for table in (self._leaves, self._cells, self._crossed, self.distances))

    def update(self, blocks: Keys, sums: ScanSums, noise: SensorNoise, num_threads: int) -> Keys:
        """Recompute what depends on changes. Return the ascending keys of the regions with recomputed distances.

        `blocks` (B,): ascending keys of the blocks with changed sums; `sums`: all sums in their regions.
        """
        changed = self._put_sums(blocks, sums)
        if noise != self._noise:  # all ghosts and evidence depend on it
            self._noise = noise
            changed = np.union1d(changed, self._leaves.gather()["keys"])
        if len(changed) == 0:
            return NO_KEYS
        of_planes = np.union1d(regions_of(changed), self._fit_planes(changed, num_threads))
        self._surfels = self._surfels_of(self._cells.gather())
        if self._config.returns.drop_ghosts:
            changed = np.union1d(changed, self._find_ghosts(noise, num_threads))
        changed = np.union1d(changed, self._find_normals(of_planes, num_threads))
        return self._derive_distances(changed, noise, num_threads)

    def surface(self, visibility: evidence.VisibilityCounts) -> tuple[WholeMap, Surface]:
        """Extract all triangles, with the evidence at their vertices. `visibility`: of all blocks."""
        num_threads = resolve_num_threads(self._config.num_threads)
        surfels, leaf_m = self._surfels, self._config.leaf_size_m
        scene = WholeMap(self._origin, self._config, surfels.clutter_ratio(), surfels.returns_per_cell())
        rows = self.distances.gather()
        crossed = rows["crossed"]
        cells = lattice_of(rows["keys"][crossed]).astype(np.int32)
        _, corners, cell_corners = sparse_lattice(cells, num_threads=num_threads)
        values = np.zeros(len(corners), np.float32)
        in_order = np.lexsort(cells.T[::-1])  # of the lattice
        values[cell_corners] = rows["values"][crossed][in_order]
        placement = [leaf_m] * 3, [0.0] * 3, 0.0, num_threads
        vertices, faces = marching_cubes_sparse(corners, values, cell_corners, *placement)
        of_cells = evidence.Evidence(rows["information"], rows["hits"], visibility.at(rows["keys"]))
        # Via world coordinates, for the same rounding as queries at the vertices of the mesh.
        points = to_local(scene, vertices + self._origin)
        columns = of_cells.columns(rows["keys"], resolve_num_threads(0))
        at = interpolated(CellBlocks(rows["keys"]), columns, leaf_m, points)
        return scene, Surface.from_triangles(scene, vertices, faces, at, len(rows["keys"]))

    def _surfels_of(self, rows: Rows) -> Surfels:
        cell_of_plane = np.flatnonzero(rows["support"] >= MIN_SUPPORT)
        planes = [part.copy() for part in np.split(rows["planes"][cell_of_plane], 3, axis=1)]
        keys, counts = rows["keys"], rows["moments"][:, 0].copy()
        cells = keys, CellBlocks(keys), counts, rows["support"]
        return Surfels(self._surfel_m, *cells, cell_of_plane, *planes)

    def _put_sums(self, blocks: Keys, sums: ScanSums) -> Keys:
        """Update the tables from sums. Return the keys of the leaf cells in changed blocks with returns, now or before."""
        regions = regions_of(blocks << evidence.BLOCK_BITS)
        either = np.union1d(self._leaves.gather(regions)["keys"], sums.keys)
        self._leaves.put(regions, self._leaves.carried(regions, sums.keys) | vars(MeanRays.of_sums(sums)))
        keys, moments = sums.merged_moments()
        self._cells.put(regions, self._cells.carried(regions, keys) | {"moments": moments})
        return either[np.isin(either >> evidence.BLOCK_BITS, blocks)]

    def _fit_planes(self, changed: Keys, num_threads: int) -> Keys:
        """Fit planes in the neighbourhood of changed cells. Return the ascending keys of their regions."""
        near = shifted(np.unique(merged_keys(changed)), steps_near(1))
        regions = np.unique(self._cells.regions_of(near))
        cells = self._cells.gather(regions_near(regions, 1))
        keys, moments, blocks = cells["keys"], cells["moments"], CellBlocks(cells["keys"])
        rows = blocks.rows(near, num_threads)
        rows = rows[rows >= 0]
        found = neighbour_planes(blocks, keys[rows], moments, self._surfel_m, num_threads)
        support, fitted, *planes, _ = found
        cells["support"][rows], cells["planes"][rows] = support, np.nan
        cells["planes"][rows[fitted]] = np.concatenate(planes, axis=1)
        own = np.isin(self._cells.regions_of(keys), regions)
        self._cells.put(regions, {name: column[own] for name, column in cells.items()})
        return regions

    def _find_ghosts(self, noise: SensorNoise, num_threads: int) -> Keys:
        """Detect ghosts again. Return the keys of the leaf cells that became ghosts or ceased to be."""
        leaves = self._leaves.gather()
        cells = self._surfels.cells_of_leaves(leaves["keys"], num_threads)
        found = find_ghosts(self._surfels, _means_of(leaves), cells, noise, num_threads)
        before, self._ghosts = self._ghosts, self._surfels.keys[found]
        return leaves["keys"][np.isin(merged_keys(leaves["keys"]), np.setxor1d(before, self._ghosts))]

    def _find_normals(self, regions: Keys, num_threads: int) -> Keys:
        """Compute the normals of the leaf cells in these regions. Return the keys of the changed ones."""
        leaves = self._leaves.gather(regions)
        surfels = self._surfels_of(self._cells.gather(regions))
        normals = surface_returns.normals_at(_means_of(leaves), surfels, num_threads)
        differs = (normals != leaves["normals"]).any(axis=1)
        self._leaves.put(regions, leaves | {"normals": normals})
        return leaves["keys"][differs]

    def _derive_distances(self, changed: Keys, noise: SensorNoise, num_threads: int) -> Keys:
        """Recompute distances and evidence that depend on changed leaf cells. Return their regions, ascending."""
        # A ray contributes to the cells of its band, and via shared corners to the neighbours of the last one. Added or removed
        # cells change which rays contribute at the corners of their neighbours, and smoothing propagates these changes.
        band_cells = max(surface_returns.TRUNCATION_CELLS, surface_returns.BAND_CELLS)
        reached = cubes_near(changed, _BLOCK_CELLS, math.ceil(band_cells) + 1)
        leaf_keys, differing = self._find_leaf_cells(regions_of(reached), num_threads)
        reached = np.union1d(reached, cubes_near(differing, _BLOCK_CELLS, 1))
        smoothed = regions_of(cubes_near(reached, _LARGE_CELLS, surface_returns.CELLS_SMOOTHED))
        regions = np.intersect1d(smoothed, regions_of(np.union1d(leaf_keys, differing)))
        self._average(regions, leaf_keys, noise, num_threads)
        return regions

    def _find_leaf_cells(self, regions: Keys, num_threads: int) -> tuple[Keys, Keys]:
        """Find the leaf cells near `regions`, in which rays changed. Return them, and those that came or went, ascending."""
        rays, _ = self._true_means(regions_near(regions, 1))
        reach_m = self._config.metres(surface_returns.BAND_CELLS)
        crossed = rays.leaf_keys(self._config.leaf_size_m, reach_m, num_threads)
        self._crossed.put(regions, {"keys": crossed})
        # Bridges depend on medians over blocks of 32 cells, and on their two ends, which they lack at the border.
        own, around = regions_near(regions, 2), regions_near(regions, 3)
        ends, _ = self._true_means(around)
        counts, most = ends.counts.astype(np.float64), self._config.encoding.bridge_cells
        found = evidence.bridged(self._crossed.gather(around)["keys"], ends.keys, counts, most, num_threads)
        before = self.distances.gather(around)["keys"]
        leaf_keys = np.union1d(found[within(found, own)], before[~within(before, own)])
        return leaf_keys, np.setxor1d(leaf_keys, before, assume_unique=True)

    def _average(self, regions: Keys, leaf_keys: Keys, noise: SensorNoise, num_threads: int) -> None:
        config = self._config
        near = regions_near(regions, 1)  # what influences their corners: smoothing reaches no farther
        means, normals = self._true_means(near)
        weighted = evidence.ReturnsOfCells.of_means(means, noise, config.returns)
        leaf_keys = leaf_keys[within(leaf_keys, near)]
        table = VertexTable(leaf_keys, config.leaf_size_m, 1, Encoding.OCTREE, num_threads)
        distances_m = surface_returns.average_at_corners(table, means, weighted, normals, config, num_threads)
        own = within(leaf_keys, regions)
        values = distances_m[table.leaf_vertices()[1][own]]
        information, hits = evidence.evidence_sums(weighted, leaf_keys[own], num_threads)
        crossed = (values.min(axis=1, initial=np.inf) <= 0) & (values.max(axis=1, initial=-np.inf) > 0)
        rows = {"values": values, "crossed": crossed, "information": information, "hits": hits}
        self.distances.put(regions, {"keys": leaf_keys[own]} | rows)

    def _true_means(self, regions: Keys) -> tuple[MeanRays, Floats32]:
        """Return the mean rays of the leaf cells in `regions` that are no ghosts, and their normals (M, 3)."""
        leaves = self._leaves.gather(regions)
        true = np.flatnonzero(~np.isin(merged_keys(leaves["keys"]), self._ghosts))
        return _means_of(leaves).select(true), leaves["normals"].take(true, axis=0)


def _means_of(rows: Rows) -> MeanRays:
    return MeanRays(**{name: rows[name] for name in MeanRays.__dataclass_fields__})
