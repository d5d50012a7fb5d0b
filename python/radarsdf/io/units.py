# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Units of columns: by their names, or else by their numbers."""

from __future__ import annotations

import re
from bisect import bisect
from typing import Any

import numpy as np
from numpy.typing import NDArray

from radarsdf.io.scans import Notes

SCALES = {"mm": 1e-3, "cm": 1e-2, "km": 1e3, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9, "mrad": 1e-3,
          **dict.fromkeys(("km/h", "kmh", "kph"), 1 / 3.6),
          **dict.fromkeys(("deg", "degree", "degrees", "°"), np.pi / 180)}  # fmt: skip
"""Units in names of columns, in m, s, m/s or rad."""

_UNIT = re.compile(
    r"[\s_]+(m|cm|mm|km|s|ms|us|ns|rad|mrad|radians?|deg|degrees?|mps|kmh|kph|dbs?m?|linear)$|[\s_]*[\[(]([^\])]*)[\])]$"
)
_SINCE_1970 = (("s", 1.0), ("ms", 1e-3), ("µs", 1e-6), ("ns", 1e-9))
_LIMITS = (1e11, 1e14, 1e17)  # of the absolute times since 1970, from one of these units to the next
_BEYOND = 1.05  # angles that exceed a limit by rounding
_STEPS, _ENOUGH = 4, 30  # parts of a degree, and angles that lie in such steps not by chance


def without_unit(name: str) -> tuple[str, str]:
    """The name of a column in lower case without its unit, and the unit: of ``azimuth_deg``, ``x [m]``, ``time(ns)``."""
    name = name.strip().lower()
    found = _UNIT.search(name)
    if found is None or not found.start():
        return name, ""
    return name[: found.start()], found[1] if found[1] is not None else found[2].strip()


def unit_since_1970(time: float) -> tuple[str, float]:
    """The unit of a time since 1970 and its length, s."""
    return _SINCE_1970[bisect(_LIMITS, abs(time))]


def in_seconds(times: NDArray[np.float64], name: str, notes: Notes) -> NDArray[np.float64]:
    """Times (N,) of the file `name`, s. They may be in ms, µs or ns since 1970, which is noted."""
    if not np.isfinite(times).all():
        msg = f"{name} holds a time that is not finite"
        raise ValueError(msg)
    units = {unit_since_1970(time) for time in times[times != 0].tolist()}
    if len(units) > 1:
        msg = f"{name} holds times of different units, such as s and ns"
        raise ValueError(msg)
    ((unit, scale),) = units or {_SINCE_1970[0]}
    if unit != "s":
        notes.add(f"times of {name} are taken as {unit} since 1970")
    return times * scale


def are_degrees(azimuth: NDArray[Any], elevation: NDArray[Any], unit: str = "") -> bool:
    """Whether angles (N,) are in degrees: by the unit in their names, or else by their numbers.

    In degrees are numbers beyond what rad can be, or in steps that only degrees have.
    """
    if unit:
        return SCALES.get(unit) == SCALES["deg"]
    finite = np.isfinite(azimuth) & np.isfinite(elevation)
    if not finite.any():
        return False
    azimuth, elevation = azimuth[finite], elevation[finite]
    largest, highest = (np.quantile(np.abs(angles), 0.99) / np.pi for angles in (azimuth, elevation))
    if highest > _BEYOND / 2 or largest > 2 * _BEYOND:
        return True
    if largest > _BEYOND:  # rad from 0 to a whole turn have no other sign
        return bool(azimuth.min() < 0)
    steps = azimuth * _STEPS
    return bool(len(steps) >= _ENOUGH and steps.any() and (steps == np.round(steps)).all())
