# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Where to look from, so that all is seen and the frame is filled."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

FOV_RAD = 0.85
"""Vertical field of view of the first look: less than viser's, so that walls stay upright."""
_MARGIN = 1.08

_Floats = NDArray[np.float64]


class Look(NamedTuple):
    """A look at a scene."""

    position: _Floats
    """(3,) of the eye, m."""
    look_at: _Floats
    """(3,) what is in the middle, and turned round, m."""


def look_at_all(points: _Floats, to_eye: _Floats, aspect: float, fov_rad: float = FOV_RAD) -> Look:
    """The nearest look in a direction in which all points are seen.

    Parameters
    ----------
    points
        (N, 3) m, with z up.
    to_eye
        (3,) from the points to the eye, of any length, not upright.
    aspect
        Width of the frame over its height.
    fov_rad
        Vertical field of view.
    """
    back = to_eye / np.linalg.norm(to_eye)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    up = np.cross(back, right)
    tangent = math.tan(fov_rad / 2) / _MARGIN
    depth_m = points @ back
    middle, far_m = np.zeros(3), -math.inf
    for axis, slope in ((right, tangent * aspect), (up, tangent)):
        # An eye at a along the axis and t back sees a point x if |x - a| <= slope * (t - depth).
        one, other = (float((depth_m + sign * (points @ axis) / slope).max()) for sign in (1, -1))
        middle = middle + slope * (one - other) / 2 * axis
        far_m = max(far_m, (one + other) / 2)
    center_m = float(depth_m.min() + depth_m.max()) / 2
    return Look(middle + far_m * back, middle + center_m * back)
