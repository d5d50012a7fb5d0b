# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What the columns of a file of poses mean, by their names, in any order."""

from __future__ import annotations

import re

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from radarsdf.io.scans import Notes
from radarsdf.io.units import are_degrees, without_unit

_POSITION = "(?:t|p|pos|position|trans|translation|loc|location|pose)"
_QUATERNION = "(?:q|quat|quaternion|orientation|rot|rotation)"
_EULER = ("yaw", "pitch", "roll")
_TIMES = ("header stamp", "stamp", "timestamp", "time", "t")
_ROLES = (
    (rf"(?:{_QUATERNION} .* |(?:.* )?{_QUATERNION} ?)([xyzw])", "q{}"),
    (rf"(?:{_POSITION} .* |(?:.* )?{_POSITION} ?|)([xyz])", "{}"),
    (r"(?:.* )?(yaw|pitch|roll)", "{}"),
    (r"(?:.* )?(?:sec|secs|seconds)", "sec"),
    (r"(?:.* )?(?:nsec|nsecs|nanosec|nanosecs|nanoseconds)", "nsec"),
    (r"(?:.*? )?(header stamp|stamp|timestamp|time|t)", "{}"),
)
"""What words, whole, mean as the name of a column."""


def pose_columns(names: list[str]) -> dict[str, int] | None:
    """Column by role: time, sec, nsec, x, y, z, qx, qy, qz, qw, roll, pitch, yaw; None if the names are no pose's.

    Names are those of EuRoC, evo, ``rostopic echo -p``, exports of bags, and others like them.
    """
    found: dict[str, int] = {}
    for column, name in enumerate(names):
        words = re.sub(r"[\W_]+", " ", without_unit(name)[0]).strip()
        for pattern, role in _ROLES:
            if match := re.fullmatch(pattern, words):
                found.setdefault(role.format(*match.groups()), column)
                break
    if "sec" not in found or "nsec" not in found:
        found.pop("nsec", None)
        time = next((found[name] for name in (*_TIMES, "sec") if name in found), None)
        found |= {} if time is None else {"time": time}
    rotation = {"qx", "qy", "qz", "qw"} <= set(found) or "yaw" in found
    return found if {"x", "y"} <= set(found) and ("z" in found or "yaw" in found) and rotation else None


def rotations_of(
    table: NDArray[np.float64], columns: dict[str, int], names: list[str], file: str, notes: Notes
) -> NDArray[np.float64]:
    """(P, 4) quaternions qx, qy, qz, qw of named columns; NaN where angles are."""
    if "qw" in columns:
        return table[:, [columns[role] for role in ("qx", "qy", "qz", "qw")]]
    angles = np.stack(
        [table[:, columns[role]] if role in columns else np.zeros(len(table)) for role in _EULER], axis=1
    )
    named = next(
        (unit for role in _EULER if role in columns and (unit := without_unit(names[columns[role]])[1])), ""
    )
    degrees = are_degrees(angles[:, 0], angles[:, 1], named)
    unit, by = "degrees" if degrees else "rad", "name" if named else "their numbers"
    notes.add(f"{file}: roll, pitch and yaw are in {unit} by {by}, R = Rz(yaw) Ry(pitch) Rx(roll)")
    quaternions = np.full((len(table), 4), np.nan)
    finite = np.isfinite(angles).all(axis=1)
    if finite.any():
        quaternions[finite] = Rotation.from_euler("ZYX", angles[finite], degrees=degrees).as_quat()
    return quaternions
