# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The fit of one tile: a task that takes names and gives a name, so that it can run anywhere."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError

from radarsdf.fitting.steps import FitInput, fit_rays
from radarsdf.io.files import write_whole
from radarsdf.io.tensors import open_tensors
from radarsdf.map.contents import MapContents
from radarsdf.map.storage import checked_report, load_contents
from radarsdf.tiles.plan import Plan, TilePlan, failure_path, map_path
from radarsdf.tiles.ray_files import read_rays


def fit_tile(folder: str, name: str, run: str = "") -> str:
    """Fits the tile of this name, unless its map is there already.

    Parameters
    ----------
    folder : str
        Where the plan is.
    name : str
        Of the tile, as in the plan.
    run : str
        Anything. Schedulers that keep results by arguments run the task again if it differs.

    Returns
    -------
    str
        The path of the map.

    Raises
    ------
    Exception
        What :func:`radarsdf.fit` raises. The reason is also in ``failed.txt`` beside the rays of the tile.
    """
    del run
    root = Path(folder)
    plan = Plan.load(root)
    (tile,) = (planned for planned in plan.tiles if planned.name == name)
    path, failure = map_path(root, tile), failure_path(root, tile)
    if not is_done(root, plan, tile):
        try:
            _fit(root, plan, tile)
        except Exception as error:
            write_whole(failure, (str(error) or type(error).__name__).encode())
            raise
    failure.unlink(missing_ok=True)
    return str(path)


def _fit(root: Path, plan: Plan, tile: TilePlan) -> None:
    def read() -> FitInput:
        rays, inside = read_rays(root, plan, tile)
        return FitInput(
            rays,
            plan.scale,
            inside=inside,
            rough_share=plan.rough_share,
            returns_per_cell=plan.returns_per_cell,
            sensor=plan.sensor,
            box_cells=plan.box_cells(tile.tile),
        )

    radar_map = fit_rays(read, plan.config, progress=False)
    radar_map.report["plan"] = plan.digest
    radar_map.save(map_path(root, tile))


def is_done(root: Path, plan: Plan, tile: TilePlan) -> bool:
    """Whether the map of a tile is there, and of this plan. Only the beginning of its file is read.

    Raises
    ------
    ValueError
        If a link leads out of the folder.
    """
    path = map_path(root, tile)
    try:
        return bool(_report(path)["plan"] == plan.digest)
    except (OSError, SafetensorError, KeyError, TypeError, ValueError, RecursionError):
        return False


def contents_of_tile(root: Path, plan: Plan, tile: TilePlan) -> MapContents:
    """The map of a tile that is done.

    Raises
    ------
    ValueError
        If its file is damaged, or is not of this plan.
    OSError
        If it cannot be read.
    """
    path = map_path(root, tile)
    contents = load_contents(path)
    if (
        contents.config != plan.config
        or contents.intensity_scale != plan.scale
        or not np.array_equal(contents.origin, plan.config.lattice.position(tile.origin_cells))
    ):
        msg = f"{path} is not the map of this tile, by its settings, its place or its intensities"
        raise ValueError(msg)
    return contents


def report_of(root: Path, tile: TilePlan) -> dict[str, Any]:
    """The report of the fit of a tile that is done; see :attr:`Map.report`. Nothing else is read.

    Raises
    ------
    ValueError
        If the file is damaged.
    OSError
        If it cannot be read.
    """
    path = map_path(root, tile)
    try:
        return checked_report(_report(path))
    except (SafetensorError, KeyError, TypeError, ValueError, RecursionError) as error:
        msg = f"{path} is not a whole radarsdf map: {error}"
        raise ValueError(msg) from error


def _report(path: Path) -> Any:
    with open_tensors(path, "np") as file:
        return json.loads(file.metadata["description"])["report"]
