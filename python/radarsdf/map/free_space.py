"""Free space and returns in the leaf cells of a map, and what they imply."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from radarsdf.arrays import Bools, Bytes, Floats, Ints
from radarsdf.map import queries
from radarsdf.map.confidence import confidence, evidence
from radarsdf.map.queries import MapContents
from radarsdf.returns.sums import lattice_of
from radarsdf.returns.view_statistics import MOST_SCANS

_ODDS_CELLS = 50_000  # sample of leaf cells that calibrates the weight of free-space crossings


@dataclass(frozen=True)
class CellsInBox:
    """Free space and returns in the leaf cells of a box, as dense arrays."""

    corner: Floats  # (3,) lower corner of the first cell, world, m
    passed: Bytes  # number of scans with a ray through the cell, at most 7
    returns: Bools  # whether the cell has returns
    observed: Bools  # whether the cell is a leaf cell of the map


def dense_cells(
    contents: MapContents, lower: Ints, shape: tuple[int, int, int]
) -> tuple[Bytes, Bools, Bools]:
    """Return `passed`, `returns` and `observed` of the leaf cells from `lower` (3,) on, relative to the map's origin."""
    passed, returns = contents.free_space().dense(lower, shape)
    cells = lattice_of(contents.field.table.leaf_keys()) - lower
    inside = ((cells >= 0) & (cells < shape)).all(axis=1)
    observed = np.zeros(shape, bool)
    observed[tuple(cells[inside].T)] = True
    return passed, returns, observed


def free_space_odds(contents: MapContents) -> Floats:
    """Return the odds (8,) that a leaf cell crossed by 0 to 7 or more scans is behind rather than before a surface."""
    # Calibrated on the map's own cells that are clearly on one side of a surface: rays cross solid cells because of noise,
    # and on the way to false returns.
    keys = contents.field.table.leaf_keys()
    keys = keys[:: max(1, len(keys) // _ODDS_CELLS)]
    leaf_m = contents.config.leaf_size_m
    centres = ((lattice_of(keys) + 0.5) * leaf_m).astype(np.float32)
    distances_m = queries.signed_distance(contents, centres)
    # At grazing incidence the field exceeds the distance, and with noisy returns falls below it; so does its gradient.
    edge = leaf_m * np.linalg.norm(queries.plane(contents, centres)[:, 1:], axis=1)
    weights = confidence(contents, evidence(contents, centres)).astype(np.float64)
    passed = contents.free_space().at(keys)

    sides = (distances_m < -edge, distances_m > edge)
    behind, before = (np.bincount(passed[side], weights[side], MOST_SCANS + 1) + 1 for side in sides)
    odds = (behind / behind.sum()) / (before / before.sum())
    # Enforce monotonicity: more crossings never make a cell less free.
    return np.minimum.accumulate(odds)
