# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What an inertial measurement unit (IMU) measured beside the scans."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from radarsdf.checks import check_pose, real_array

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Imu:
    """G measurements of an IMU, in its own axes.

    Raises
    ------
    ValueError
        If arrays are not finite, do not fit together, times do not ascend, or `R_sensor_imu` is no rotation.
    """

    times_s: FloatArray
    """(G,) s, ascending, by the clock of the scans."""
    angular_velocity: FloatArray
    """(G, 3) rad/s."""
    specific_force: FloatArray | None = None
    """(G, 3) m/s², as an accelerometer measures it: at rest it is 9.81 upwards. None: there is no accelerometer."""
    R_sensor_imu: FloatArray | None = None
    """(3, 3) rotation from the axes of the IMU to those of the radar. None: it is not known."""

    def __post_init__(self) -> None:
        """Checks the arrays."""
        times_s = _checked(self.times_s, "times_s", None)
        if (np.diff(times_s) < 0).any():
            msg = "times_s of an IMU must ascend"
            raise ValueError(msg)
        checked = {"times_s": times_s}
        for name in ("angular_velocity", "specific_force"):
            if getattr(self, name) is not None:
                checked[name] = _checked(getattr(self, name), name, len(times_s))
        if self.R_sensor_imu is not None:
            checked["R_sensor_imu"] = checked_rotation(self.R_sensor_imu)
        for name, array in checked.items():
            object.__setattr__(self, name, array)

    def __len__(self) -> int:
        """Number of measurements."""
        return len(self.times_s)


def checked_rotation(R_sensor_imu: ArrayLike) -> FloatArray:
    """`R_sensor_imu` as a rotation (3, 3); of a rigid transform (4, 4), its rotation."""
    matrix: FloatArray = real_array(R_sensor_imu, "R_sensor_imu")
    whole = np.eye(4)
    if matrix.shape not in ((3, 3), (4, 4)):
        msg = f"R_sensor_imu must be a rotation (3, 3), not {matrix.shape}"
        raise ValueError(msg)
    whole[:3, :3] = matrix[:3, :3]
    try:
        return check_pose(whole, "R_sensor_imu")[:3, :3]
    except ValueError as error:
        msg = "R_sensor_imu is no rotation matrix (orthogonal, with determinant 1)"
        raise ValueError(msg) from error


def _checked(values: Any, name: str, rows: int | None) -> FloatArray:
    array: FloatArray = real_array(values, name)
    shape = array.shape[:1] if rows is None else (rows, 3)
    if array.shape != shape or array.ndim == 0 or len(array) == 0 or not np.isfinite(array).all():
        msg = f"{name} of an IMU must be finite numbers of shape {'(G,)' if rows is None else shape}, not {array.shape}"
        raise ValueError(msg)
    return array
