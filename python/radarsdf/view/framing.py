"""Camera poses from which a whole mesh is visible and fills the frame."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from radarsdf.arrays import Floats

FOV_RAD = 0.85  # vertical field of view: less than viser's, so that walls stay upright
ASPECT = 1.3  # width over height of a page's frame, until the page reports its own
_TO_EYE = np.array([-0.33, -0.57, 0.5])
_MARGIN = 1.08


class CameraPose(NamedTuple):
    position: Floats  # (3,) m
    look_at: Floats  # (3,) m, centre of the orbit of the user's rotations


def framing_pose(points: Floats, to_eye: Floats = _TO_EYE, aspect: float = ASPECT) -> CameraPose:
    """Nearest camera, with z up, that sees all points (N, 3), m, in the direction `to_eye` (3,), which must not be vertical."""
    back = to_eye / np.linalg.norm(to_eye)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    up = np.cross(back, right)
    tangent = math.tan(FOV_RAD / 2) / _MARGIN
    depth_m = points @ back
    # A camera at a along an axis and t back sees a point x if |x - a| <= slope * (t - depth).
    sides = [(axis, points @ axis, slope) for axis, slope in ((right, tangent * aspect), (up, tangent))]
    ends = [((depth_m + x / slope).max(), (depth_m - x / slope).max(), slope) for _, x, slope in sides]
    far_m = max(float(one + other) / 2 for one, other, _ in ends)
    middle = np.zeros(3)
    for (axis, x, _), (one, other, slope) in zip(sides, ends, strict=True):
        a = slope * (one - other) / 2
        for _ in range(4):  # if the frame is wider than needed, the middle shifts
            at = (x - a) / (far_m - depth_m)
            a += (at.max() + at.min()) / 2 * float(far_m - depth_m.mean())
        middle = middle + a * axis
    center_m = float(depth_m.min() + depth_m.max()) / 2
    return CameraPose(middle + far_m * back, middle + center_m * back)
