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

NOWHERE = np.uint64(2**64 - 1)
"""In the place of the key of a cell: a ray crosses no plane."""

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

    1. Which flat plane does each ray cross first? Columns `first` of leaf cells: the key of the plane's cell, or
       :data:`NOWHERE`; `passed` of cells of surfels: how many rays cross its plane first.
    2. Which planes do most rays end at? `opaque` of cells of surfels.
    3. How many rays of each cell end behind an opaque plane? `behind` of cells of surfels.
    4. Round which cells are most returns behind one? `ghosts` of cells of surfels.

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
        boxes_before = self._boxes_of(of_rays)
        self._find_boxes(of_rays)
        rays = np.union1d(of_rays, self._ends_of_rays_through(of_planes))
        # Rays that are gone passed planes, too.
        planes = self._planes_in(np.concatenate([self._boxes_of(rays), boxes_before]))
        self._find_first(rays, planes, noise, num_threads)
        of_opaque = np.union1d(of_planes, self._find_opaque(planes, num_threads))
        rays = np.union1d(rays, self._ends_of_rays_through(of_opaque))
        self._find_behind(rays, noise, num_threads)
        return self._find_ghosts(rays, num_threads)

    def _boxes_of(self, regions: Keys) -> _Boxes:
        """Those that hold the rays that end in these regions; of regions without rays none."""
        found = [self._boxes[region] for region in regions.tolist() if region in self._boxes]
        return np.array(found).reshape(-1, 2, 3)

    def _find_boxes(self, regions: Keys) -> None:
        for region in regions:
            rows = self._leaves.gather(region[None])
            if len(rows["keys"]) == 0:
                self._boxes.pop(int(region), None)
                continue
            ends = rows["points"].astype(np.float64)
            sensors = ends - rows["directions"] * rows["ranges_m"][:, None].astype(np.float64)
            both = np.concatenate([ends, sensors])
            margin_m = self._leaf_size_m  # more than rounding
            self._boxes[int(region)] = np.stack([both.min(axis=0) - margin_m, both.max(axis=0) + margin_m])

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
        """Keeps what was found of `cells`, those in `regions` and round them. Returns which of those in them differ from before."""
        own = np.isin(self._cells.regions_of(cells["keys"]), regions)
        differs: NDArray[np.bool_] = own & (found != cells[column])
        cells[column] = found
        self._cells.put(regions, {name: values[own] for name, values in cells.items()})
        return differs

    def _find_first(self, rays: Keys, planes: Keys, noise: SensorNoise, num_threads: int) -> None:
        """Step 1, of the rays that end in the regions `rays`. `planes`: all regions that they pass, or passed before."""
        rows, cells = self._leaves.gather(rays), self._cells.gather(planes)
        surfels, flat = self._surfels(cells)
        found = first_crossed(surfels, flat, means_of(rows), noise, num_threads)
        keys = np.append(surfels.keys[surfels.cell_of_plane[flat]], NOWHERE)  # the last is that of -1
        first = rows["first"] = keys[found]
        # Of rays that end in other regions, the counts stay. They are whole numbers, so that what is taken away and added
        # leaves the bits of a new count. The last is that of cells that are there no more.
        passed = np.append(cells["passed"], 0.0)
        ends = np.searchsorted(self._leaves.regions_of(rows["keys"]), rays, side="right").tolist()
        starts = [0, *ends[:-1]]
        for region, start, end in zip(rays.tolist(), starts, ends, strict=True):
            old = self._crossings.pop(region, None)
            if old is not None:
                passed[surfels.blocks.rows(old[0], 1)] -= old[1]
            if start == end:
                continue
            crossed, which = np.unique(first[start:end], return_inverse=True)
            counted = np.bincount(which, rows["counts"][start:end], len(crossed))
            new = self._crossings[region] = crossed[crossed != NOWHERE], counted[crossed != NOWHERE]
            passed[surfels.blocks.rows(new[0], 1)] += new[1]
        cells["passed"] = passed[:-1]
        self._leaves.put(rays, rows)
        self._cells.put(planes, cells)

    def _find_opaque(self, planes: Keys, num_threads: int) -> Keys:
        """Step 2, of the planes in these regions. Returns the regions in which an answer differs, ascending."""
        cells = self._cells.gather(regions_near(planes, 1))  # rays past the cells round a plane count, too
        surfels, flat = self._surfels(cells)
        opaque = np.zeros(len(surfels.keys), bool)
        opaque[surfels.cell_of_plane[flat]] = are_opaque(surfels, flat, cells["passed"], num_threads)
        differs = self._put_own(planes, "opaque", opaque, cells)
        return np.unique(self._cells.regions_of(cells["keys"])[differs])

    def _find_behind(self, rays: Keys, noise: SensorNoise, num_threads: int) -> None:
        """Step 3, of the rays that end in these regions."""
        rows, cells = self._leaves.gather(rays), self._cells.gather(self._planes_in(self._boxes_of(rays)))
        surfels, flat = self._surfels(cells)
        opaque = cells["opaque"][surfels.cell_of_plane[flat]]
        behind = are_behind(
            surfels, flat[opaque], rows["first"] != NOWHERE, means_of(rows), noise, num_threads
        )
        own = self._cells.gather(rays)
        cell_of_ray = CellBlocks(own["keys"]).rows(merged_keys(rows["keys"]), num_threads)
        own["behind"] = np.bincount(cell_of_ray[behind], rows["counts"][behind], len(own["keys"]))
        self._cells.put(rays, own)

    def _find_ghosts(self, rays: Keys, num_threads: int) -> Keys:
        """Step 4, of the cells in the regions in which these rays end, and round them. Returns the keys of those that differ."""
        cells = self._cells.gather(regions_near(rays, 2))
        ghosts = mostly_behind(surfels_of(cells, self._leaf_size_m), cells["behind"], num_threads)
        differs = self._put_own(regions_near(rays, 1), "ghosts", ghosts, cells)
        found: Keys = cells["keys"][differs]
        return found


def _meet(boxes: _Boxes, others: _Boxes) -> NDArray[np.bool_]:
    """(R,) which of the boxes meet one of the others."""
    if len(boxes) == 0 or len(others) == 0:
        return np.zeros(len(boxes), bool)
    apart = (boxes[:, None, 0] > others[None, :, 1]) | (boxes[:, None, 1] < others[None, :, 0])
    in_touch: Any = ~apart.any(axis=2)
    found: NDArray[np.bool_] = in_touch.any(axis=1)
    return found
