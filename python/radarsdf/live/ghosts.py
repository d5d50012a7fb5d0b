# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The ghosts of a map that grows: those of `find_ghosts` in `returns/ghosts.py`, found again only where rays pass changes."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from radarsdf._core import CellBlocks
from radarsdf.live.regions import REGION_CELLS, Keys, RegionTable, Rows, region_places, regions_near
from radarsdf.returns.ghosts import are_behind, are_opaque, first_crossed, mostly_behind
from radarsdf.returns.noise import SensorNoise
from radarsdf.returns.planes import LEAVES_PER_SURFEL, MIN_SUPPORT, Surfels
from radarsdf.returns.sums import MeanRays, merged_keys

_Boxes = NDArray[np.float64]  # (R, 2, 3) lower and upper corners, local frame, m


def surfels_of(rows: Rows, leaf_size_m: float) -> Surfels:
    """The surfels of cells with `keys`, `moments`, `support` and `planes`: centres, normals and variances."""
    cell_of_plane = np.flatnonzero(rows["support"] >= MIN_SUPPORT)
    planes = rows["planes"][cell_of_plane]
    return Surfels(
        cell_size_m=LEAVES_PER_SURFEL * leaf_size_m,
        keys=rows["keys"],
        blocks=CellBlocks(rows["keys"]),
        counts=rows["moments"][:, 0].copy(),
        support=rows["support"],
        cell_of_plane=cell_of_plane,
        centres=planes[:, :3].copy(),
        normals=planes[:, 3:6].copy(),
        variances=planes[:, 6:].copy(),
    )


def means_of(rows: Rows) -> MeanRays:
    """The mean rays of leaf cells with these columns."""
    names = ("keys", "points", "directions", "counts", "scans", "ranges_m")
    return MeanRays(**{name: rows[name] for name in names})


class GrowingGhosts:
    """The four steps of :func:`find_ghosts`, each repeated only where its result may differ.

    The result for a ray depends on the planes along it, which may be in other regions than its end. So each region has a box
    that holds all rays that end in it: a plane matters to them only if the region of the plane meets the box.
    """

    def __init__(self, leaves: RegionTable, cells: RegionTable, leaf_size_m: float) -> None:
        self._leaves, self._cells, self._leaf_size_m = leaves, cells, leaf_size_m
        self._boxes: dict[int, _Boxes] = {}
        # Of the rays that end in each region: keys of the planes that some cross first, and how many do.
        self._crossings: dict[int, tuple[Keys, NDArray[np.float64]]] = {}

    def update(self, of_rays: Keys, of_planes: Keys, noise: SensorNoise, num_threads: int) -> Keys:
        """Takes changes in, of rays that end in the regions `of_rays` and of planes in `of_planes`, both ascending.

        Returns the keys of the cells of surfels that became ghosts or are none any more, ascending.
        """
        before = self._boxes_of(of_rays)
        self._find_boxes(of_rays)
        rays = np.union1d(of_rays, self._ends_of_rays_through(of_planes))
        self._find_first(rays, noise, num_threads)
        # Rays that are gone passed planes, too.
        opaque = self._find_opaque(
            self._planes_in(np.concatenate([self._boxes_of(rays), before])), num_threads
        )
        rays = np.union1d(rays, self._ends_of_rays_through(np.union1d(of_planes, opaque)))
        self._find_behind(rays, noise, num_threads)
        cells = self._cells.gather(regions_near(rays, 2))
        ghosts = mostly_behind(surfels_of(cells, self._leaf_size_m), cells["behind"], num_threads)
        differs = self._put_own(regions_near(rays, 1), "ghosts", ghosts, cells)
        found: Keys = cells["keys"][differs]
        return found

    def _boxes_of(self, regions: Keys) -> _Boxes:
        found = [self._boxes[region] for region in regions.tolist() if region in self._boxes]
        return np.array(found).reshape(-1, 2, 3)

    def _find_boxes(self, regions: Keys) -> None:
        for region in regions:
            rows = self._leaves.gather(region[None])
            self._boxes.pop(int(region), None)
            if len(rows["keys"]):
                ends = rows["points"].astype(np.float64)
                sensors = ends - rows["directions"] * rows["ranges_m"][:, None].astype(np.float64)
                both, margin_m = np.concatenate([ends, sensors]), self._leaf_size_m  # more than rounding
                self._boxes[int(region)] = np.stack(
                    [both.min(axis=0) - margin_m, both.max(axis=0) + margin_m]
                )

    def _cubes(self, regions: Keys) -> _Boxes:
        """What the regions themselves span."""
        lower = region_places(regions)
        return np.stack([lower, lower + 1], 1) * (REGION_CELLS * self._leaf_size_m)

    def _ends_of_rays_through(self, regions: Keys) -> Keys:
        """The regions in which rays end that may pass one of these, ascending."""
        where = np.array(sorted(self._boxes), np.uint64)
        return where[_meet(self._boxes_of(where), self._cubes(regions))]

    def _planes_in(self, boxes: _Boxes) -> Keys:
        """The regions with planes that rays in these boxes may pass, ascending."""
        regions = self._cells.regions
        return regions[_meet(self._cubes(regions), boxes)]

    def _surfels(self, cells: Rows) -> tuple[Surfels, NDArray[np.int64]]:
        """Surfels of cells, and which of them are flat."""
        surfels = surfels_of(cells, self._leaf_size_m)
        return surfels, np.flatnonzero(surfels.is_flat())

    def _put_own(self, regions: Keys, column: str, found: NDArray[Any], cells: Rows) -> NDArray[np.bool_]:
        """Keeps what was found of `cells`, those in `regions` and near them. Returns which of those in them differ from before."""
        own = np.isin(self._cells.regions_of(cells["keys"]), regions)
        differs: NDArray[np.bool_] = own & (found != cells[column])
        cells[column] = found
        self._cells.put(regions, {name: values[own] for name, values in cells.items()})
        return differs

    def _find_first(self, rays: Keys, noise: SensorNoise, num_threads: int) -> None:
        """Which plane does each ray that ends in these regions cross first?"""
        rows = self._leaves.gather(rays)
        surfels, flat = self._surfels(self._cells.gather(self._planes_in(self._boxes_of(rays))))
        first = first_crossed(surfels, flat, means_of(rows), noise, num_threads)
        rows["crosses"] = first >= 0
        self._leaves.put(rays, rows)
        keys, regions = surfels.keys[surfels.cell_of_plane[flat]], self._leaves.regions_of(rows["keys"])
        for region in rays:
            own = (regions == region) & rows["crosses"]
            crossed, which = np.unique(first[own], return_inverse=True)
            counts = np.bincount(which, rows["counts"][own], len(crossed))
            self._crossings[int(region)] = keys[crossed], counts.astype(np.float64)

    def _find_opaque(self, planes: Keys, num_threads: int) -> Keys:
        """Which planes in these regions do most rays end at? Returns the regions in which an answer differs, ascending."""
        near = regions_near(planes, 1)  # rays past the cells around a plane count, too
        cells = self._cells.gather(near)
        surfels, flat = self._surfels(cells)
        passed = np.zeros(len(surfels.keys))
        through = [self._crossings[region] for region in self._ends_of_rays_through(near).tolist()]
        if through:
            keys, counts = (np.concatenate(columns) for columns in zip(*through, strict=True))
            rows = surfels.blocks.rows(keys, num_threads)
            passed = np.bincount(rows[rows >= 0], counts[rows >= 0], len(passed)).astype(np.float64)
        opaque = np.zeros(len(surfels.keys), bool)
        opaque[surfels.cell_of_plane[flat]] = are_opaque(surfels, flat, passed, num_threads)
        differs = self._put_own(planes, "opaque", opaque, cells)
        return np.unique(self._cells.regions_of(cells["keys"])[differs])

    def _find_behind(self, rays: Keys, noise: SensorNoise, num_threads: int) -> None:
        """How many rays of each cell in these regions end behind an opaque plane?"""
        rows, cells = self._leaves.gather(rays), self._cells.gather(self._planes_in(self._boxes_of(rays)))
        surfels, flat = self._surfels(cells)
        opaque = flat[cells["opaque"][surfels.cell_of_plane[flat]]]
        behind = are_behind(surfels, opaque, rows["crosses"], means_of(rows), noise, num_threads)
        own = self._cells.gather(rays)
        cell_of_ray = CellBlocks(own["keys"]).rows(merged_keys(rows["keys"]), num_threads)
        own["behind"] = np.bincount(cell_of_ray[behind], rows["counts"][behind], len(own["keys"]))
        self._cells.put(rays, own)


def _meet(boxes: _Boxes, others: _Boxes) -> NDArray[np.bool_]:
    """(R,) which of the boxes meet one of the others."""
    apart = (boxes[:, None, 0] > others[None, :, 1]) | (boxes[:, None, 1] < others[None, :, 0])
    in_touch: Any = ~apart.any(axis=2)
    found: NDArray[np.bool_] = in_touch.any(axis=1)
    return found
