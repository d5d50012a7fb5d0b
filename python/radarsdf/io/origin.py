# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The origin of files in a local frame, written beside them.

Some formats hold float32, which at UTM coordinates is a grid of half a metre. What is far from the world's origin is
written to them in a local frame: the world axes, with an origin subtracted that ``NAME.origin.json`` says.
"""

from __future__ import annotations

import json
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from radarsdf.checks import positions
from radarsdf.io.files import check_regular_file, write_whole

_MAX_FLOAT32_M = 1000.0  # further from the origin, float32 resolves less than 0.06 mm
_MAX_BYTES = 10_000


def origin_path(path: str | PathLike[str]) -> Path:
    """Where the origin of the local frame of a file is written."""
    return Path(path).with_name(Path(path).name + ".origin.json")


def origin_for(points: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """(3,) origin to be subtracted from points (N, 3), m, for float32; None where they are near enough to 0."""
    if np.abs(points).max(initial=0.0) <= _MAX_FLOAT32_M:
        return None
    origin: NDArray[np.float64] = np.round(points.mean(axis=0))
    return origin


def write_origin(path: str | PathLike[str], origin: NDArray[np.float64] | None) -> None:
    """Writes the origin of a file; None: removes the one of a file that was there before."""
    if origin is None:
        origin_path(path).unlink(missing_ok=True)
        return
    described = {"origin": origin.tolist(), "unit": "m", "frame": "world = local + origin"}
    write_whole(origin_path(path), json.dumps(described).encode())


def origin_of(path: str | PathLike[str]) -> NDArray[np.float64] | None:
    """(3,) the origin of a file in a local frame, world, m. None if none is written next to it."""
    beside = origin_path(path)
    if not beside.is_file():
        return None
    check_regular_file(beside)
    try:
        with beside.open(encoding="utf-8") as file:
            described = json.loads(file.read(_MAX_BYTES))
        origin: NDArray[np.float64] = positions([described["origin"]], "origin")[0]
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        msg = f"{beside} does not hold the origin of a local frame: {error}"
        raise ValueError(msg) from error
    return origin
