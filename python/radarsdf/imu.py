"""Data of an inertial measurement unit (IMU)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from radarsdf.arrays import Floats
from radarsdf.checks import are_rigid, check, real_array


@dataclass(frozen=True, eq=False)
class Imu:
    """G measurements of an inertial measurement unit, in its own axes.

    Construction raises a ValueError for arrays that are not finite or of inconsistent shapes, times that do not ascend, and an
    `R_sensor_imu` that is not a rotation.
    """

    times_s: Floats
    """(G,) s, ascending, by the clock of the scans."""
    angular_velocity: Floats
    """(G, 3) rad/s."""
    specific_force: Floats | None = None
    """(G, 3) specific force, m/s²: at rest 9.81 upwards. None: there is no accelerometer."""
    R_sensor_imu: Floats | None = None
    """(3, 3) rotation from the axes of the IMU to those of the radar. None: unknown."""

    def __post_init__(self) -> None:
        count = np.shape(self.times_s)[:1] or ("G",)
        shapes = {"times_s": count, "angular_velocity": (*count, 3), "specific_force": (*count, 3)}
        for name, shape in shapes.items():
            if (values := getattr(self, name)) is None:
                continue
            array = real_array(values, name)
            fits = array.shape == shape and array.size != 0 and np.isfinite(array).all()
            check(fits, f"{name} of an IMU must be finite numbers of shape {shape}, not {array.shape}")
            object.__setattr__(self, name, array)
        check(not (np.diff(self.times_s) < 0).any(), "times_s of an IMU must ascend")
        if self.R_sensor_imu is not None:
            object.__setattr__(self, "R_sensor_imu", checked_rotation(self.R_sensor_imu))

    def __len__(self) -> int:
        """Number of measurements."""
        return len(self.times_s)


def checked_rotation(R_sensor_imu: ArrayLike) -> Floats:
    """Convert to a rotation (3, 3); of a rigid transform (4, 4), take its rotation."""
    matrix: Floats = real_array(R_sensor_imu, "R_sensor_imu")
    whole = np.eye(4)
    whole[:3, :3] = matrix[:3, :3] if matrix.shape in ((3, 3), (4, 4)) else 0.0
    if not are_rigid(whole[None]).all():
        msg = f"R_sensor_imu, of shape {matrix.shape}, is no rotation matrix (3, 3): orthogonal, with determinant 1"
        raise ValueError(msg)
    return whole[:3, :3]
