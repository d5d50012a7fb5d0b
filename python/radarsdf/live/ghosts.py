# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The ghosts of a map that grows: what :func:`radarsdf.returns.ghosts.find_ghosts` finds, asked again only where rays pass changes."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from radarsdf._core import CellBlocks
from radarsdf.live.regions import REGION_CELLS, Keys, RegionTable, Rows, cubes_of, regions_round
from radarsdf.returns.cells import merged_keys
from radarsdf.returns.ghosts import are_behind, are_opaque, first_crossed, mostly_behind
from radarsdf.returns.mean_rays import MeanRays
from radarsdf.returns.noise import SensorNoise
from radarsdf.returns.surfels import LEAVES_PER_SURFEL, MIN_SUPPORT, Surfels

NOWHERE = np.uint64(2**64 - 1)
"""In the place of the key of a cell: a ray crosses no plane."""

_Boxes = NDArray[np.float64]  # (R, 2, 3) lower and upper corners, local, m


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
    """Keeps the columns `passed`, `opaque`, `behind` and `ghosts` of cells of surfels, and `first` of leaf cells.

    Parameters
    ----------
    leaves, cells : RegionTable
        Of leaf cells with returns, and of cells of surfels. Theirs are the other columns.
    leaf_size_m : float
        Edge of a leaf cell, m.
    """

    def __init__(self, leaves: RegionTable, cells: RegionTable, leaf_size_m: float) -> None:
        self._leaves, self._cells, self._leaf_size_m = leaves, cells, leaf_size_m
        # Of the rays that end in each region: the box they are in, and how many cross which plane first.
        self._boxes: dict[int, _Boxes] = {}
        self._crossings: dict[int, tuple[Keys, NDArray[np.float64]]] = {}

    def update(self, of_rays: Keys, of_planes: Keys, noise: SensorNoise, num_threads: int) -> Keys:
        """Takes in that mean rays changed in the regions `of_rays`, and planes in `of_planes`; both ascending.

        Returns
        -------
        (G,) ndarray
            Keys of the cells of surfels that became ghosts or are none any more, ascending.
        """
        before = self._boxes_of(of_rays)
        self._find_boxes(of_rays)
        asked = np.union1d(of_rays, self._passing(of_planes))
        crossed = self._touched(np.concatenate([self._boxes_of(asked), before]))
        self._count_passed(asked, crossed, noise, num_threads)
        of_opaque = np.union1d(of_planes, self._find_opaque(crossed, num_threads))
        asked = np.union1d(asked, self._passing(of_opaque))
        self._count_behind(asked, noise, num_threads)
        return self._find_ghosts(asked, num_threads)

    def _boxes_of(self, regions: Keys) -> _Boxes:
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
        lower = cubes_of(regions)
        return np.stack([lower, lower + 1], 1) * (REGION_CELLS * self._leaf_size_m)

    def _passing(self, regions: Keys) -> Keys:
        """The regions in which rays end that may pass one of these."""
        where = np.array(sorted(self._boxes), np.uint64)
        return where[_meet(self._boxes_of(where), self._cubes(regions))]

    def _touched(self, boxes: _Boxes) -> Keys:
        """The regions with planes that rays in these boxes may pass."""
        regions = self._cells.regions
        return regions[_meet(self._cubes(regions), boxes)]

    def _count_passed(self, asked: Keys, crossed: Keys, noise: SensorNoise, num_threads: int) -> None:
        rows, cells = self._leaves.gather(asked), self._cells.gather(crossed)
        surfels = surfels_of(cells, self._leaf_size_m)
        flat = np.flatnonzero(surfels.is_flat())
        found = first_crossed(surfels, flat, means_of(rows), noise, num_threads)
        keys = np.append(surfels.keys[surfels.cell_of_plane[flat]], NOWHERE)
        first = rows["first"] = keys[found]
        passed = np.append(cells["passed"], 0.0)  # the last is that of cells that are there no more
        ends = np.searchsorted(self._leaves.regions_of(rows["keys"]), asked, side="right").tolist()
        starts = [0, *ends[:-1]]
        for region, start, end in zip(asked.tolist(), starts, ends, strict=True):
            old = self._crossings.pop(region, None)
            if old is not None:
                passed[surfels.blocks.rows(old[0], 1)] -= old[1]
            if start == end:
                continue
            planes, which = np.unique(first[start:end], return_inverse=True)
            counted = np.bincount(which, rows["counts"][start:end], len(planes))
            new = self._crossings[region] = planes[planes != NOWHERE], counted[planes != NOWHERE]
            passed[surfels.blocks.rows(new[0], 1)] += new[1]
        cells["passed"] = passed[:-1]
        self._leaves.put(asked, rows)
        self._cells.put(crossed, cells)

    def _find_opaque(self, regions: Keys, num_threads: int) -> Keys:
        """The regions in which it changed which planes are opaque."""
        cells = self._cells.gather(regions_round(regions, 1))
        surfels = surfels_of(cells, self._leaf_size_m)
        flat = np.flatnonzero(surfels.is_flat())
        opaque = np.zeros(len(surfels.keys), bool)
        opaque[surfels.cell_of_plane[flat]] = are_opaque(surfels, flat, cells["passed"], num_threads)
        of_cells = self._cells.regions_of(cells["keys"])
        own = np.isin(of_cells, regions)
        differs = own & (opaque != cells["opaque"])
        cells["opaque"] = opaque
        self._cells.put(regions, {name: column[own] for name, column in cells.items()})
        return np.unique(of_cells[differs])

    def _count_behind(self, asked: Keys, noise: SensorNoise, num_threads: int) -> None:
        rows, cells = self._leaves.gather(asked), self._cells.gather(self._touched(self._boxes_of(asked)))
        surfels = surfels_of(cells, self._leaf_size_m)
        flat = np.flatnonzero(surfels.is_flat())
        number = np.full(len(surfels.keys) + 1, -1, np.int32)  # of the flat plane of each cell
        number[surfels.cell_of_plane[flat]] = np.arange(len(flat), dtype=np.int32)
        first = np.full(len(rows["keys"]), -1, np.int32)
        crosses = rows["first"] != NOWHERE
        first[crosses] = number[surfels.blocks.rows(rows["first"][crosses], num_threads)]
        opaque = cells["opaque"][surfels.cell_of_plane[flat]]
        behind = are_behind(surfels, flat, opaque, first, means_of(rows), noise, num_threads)
        own = self._cells.gather(asked)
        cell_of_ray = CellBlocks(own["keys"]).rows(merged_keys(rows["keys"]), num_threads)
        own["behind"] = np.bincount(cell_of_ray[behind], rows["counts"][behind], len(own["keys"]))
        self._cells.put(asked, own)

    def _find_ghosts(self, asked: Keys, num_threads: int) -> Keys:
        regions = regions_round(asked, 1)
        cells = self._cells.gather(regions_round(asked, 2))
        ghosts = mostly_behind(surfels_of(cells, self._leaf_size_m), cells["behind"], num_threads)
        own = np.isin(self._cells.regions_of(cells["keys"]), regions)
        differs = own & (ghosts != cells["ghosts"])
        cells["ghosts"] = ghosts
        self._cells.put(regions, {name: column[own] for name, column in cells.items()})
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
