# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Maps of both kinds, in one file and in tiles, for those to whom the kind does not matter."""

from __future__ import annotations

from os import PathLike

import numpy as np
from numpy.typing import NDArray

from radarsdf.checks import path_of
from radarsdf.map.map import Map
from radarsdf.map.radar_map import load_file
from radarsdf.returns.rays import Rays
from radarsdf.tiles.tiled_map import TiledMap


def load(path: str | PathLike[str]) -> Map:
    """Reads a map: a file of :meth:`Map.save`, or a folder of :func:`fit_tiles`. Nothing in it is executed.

    Parameters
    ----------
    path : path-like
        Written by this version.

    Returns
    -------
    RadarMap or TiledMap
        Its results have the same bits as those of the map that was written.

    Raises
    ------
    ValueError
        If it is no radarsdf map, is damaged, or comes from another version.
    OSError
        If it cannot be read.
    """
    path = path_of(path, "path")
    return TiledMap(path) if path.is_dir() else load_file(path)


def lacking(radar_map: Map) -> str:
    """How many tiles a map lacks, in words; empty if none."""
    if not isinstance(radar_map, TiledMap) or not (missing := radar_map.missing):
        return ""
    return f"{len(missing)} of {len(radar_map.plan.tiles)} tiles"


def predicted(radar_map: Map, rays: Rays) -> tuple[Rays, NDArray[np.float64]]:
    """The intensities (N,) that a map predicts for rays, sensor units, and these rays: those in no tile are left out."""
    found = np.asarray(radar_map.intensity(*rays.in_world(), extrapolate=True), np.float64)
    known = np.isfinite(found)
    return (rays, found) if known.all() else (rays.select(np.flatnonzero(known)), found[known])
