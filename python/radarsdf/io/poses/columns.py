# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What the columns of a file of poses mean, by their names, in any order."""

from __future__ import annotations

import re

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from radarsdf.io.scans import Notes
from radarsdf.io.text import without_unit

_POSITION = {"t", "p", "pos", "position", "trans", "translation", "loc", "location", "pose"}
_QUATERNION = {"q", "quat", "quaternion", "orientation", "rot", "rotation"}
_EULER = ("yaw", "pitch", "roll")
_TIMES = ("header stamp", "stamp", "timestamp", "time", "t")
_SECONDS, _NANOSECONDS = {"sec", "secs", "seconds"}, {"nsec", "nsecs", "nanosec", "nanosecs", "nanoseconds"}
_SEVERAL_TURNS = np.pi * 1.05


def pose_columns(names: list[str]) -> dict[str, int] | None:
    """Column by role: time, sec, nsec, x, y, z, qx, qy, qz, qw, roll, pitch, yaw; None if the names are no pose's.

    Names are those of EuRoC, evo, ``rostopic echo -p``, exports of bags, and others like them.
    """
    found: dict[str, int] = {}
    times: dict[str, int] = {}
    for column, name in enumerate(names):
        lower, _ = without_unit(name)
        tokens = re.findall(
            r"[a-z]+|\d+", re.sub(r"(orientation|position|quat|pos)(?=[wxyz]$)", r"\1 ", lower)
        )
        role = _role(tokens)
        if role is not None:
            found.setdefault(role, column)
        elif tokens and tokens[-1] in _EULER:
            found.setdefault(tokens[-1], column)
        elif tokens and tokens[-1] in _SECONDS | _NANOSECONDS:
            found.setdefault("sec" if tokens[-1] in _SECONDS else "nsec", column)
        else:
            times.setdefault(" ".join(tokens[-2:]), column)
            times.setdefault(tokens[-1] if tokens else "", column)
    if not {"sec", "nsec"} <= set(found):
        found.pop("nsec", None)
        time = next((times[name] for name in _TIMES if name in times), found.pop("sec", None))
        found |= {} if time is None else {"time": time}
    rotation = {"qx", "qy", "qz", "qw"} <= set(found) or "yaw" in found
    return found if {"x", "y"} <= set(found) and ("z" in found or "yaw" in found) and rotation else None


def _role(tokens: list[str]) -> str | None:
    """The role of a coordinate of a position or a quaternion, by the words of its name without the unit."""
    if not tokens or tokens[-1][-1] not in "xyzw" or len(tokens[-1]) > 2:
        return None
    axis, stem = tokens[-1][-1], [*tokens[:-1], *tokens[-1][:-1]]
    if stem and not _QUATERNION.isdisjoint((stem[0], stem[-1])):
        return f"q{axis}"
    if axis != "w" and (not stem or not _POSITION.isdisjoint((stem[0], stem[-1]))):
        return axis
    return None


def rotations_of(
    table: NDArray[np.float64], columns: dict[str, int], names: list[str], file: str, notes: Notes
) -> NDArray[np.float64]:
    """(P, 4) quaternions qx, qy, qz, qw of named columns; NaN where angles are."""
    if "qw" in columns:
        return table[:, [columns[role] for role in ("qx", "qy", "qz", "qw")]]
    angles = np.stack(
        [table[:, columns[role]] if role in columns else np.zeros(len(table)) for role in _EULER], axis=1
    )
    named = " ".join(names[columns[role]].lower() for role in _EULER if role in columns)
    degrees = "deg" in named or ("rad" not in named and np.nanmax(np.abs(angles), initial=0) > _SEVERAL_TURNS)
    unit = "degrees" if degrees else "rad"
    by = "name" if "deg" in named or "rad" in named else "their numbers"
    notes.add(f"{file}: roll, pitch and yaw are in {unit} by {by}, R = Rz(yaw) Ry(pitch) Rx(roll)")
    quaternions = np.full((len(table), 4), np.nan)
    finite = np.isfinite(angles).all(axis=1)
    if finite.any():
        quaternions[finite] = Rotation.from_euler("ZYX", angles[finite], degrees=bool(degrees)).as_quat()
    return quaternions
