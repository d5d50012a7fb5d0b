"""Rigs: several radars and an inertial measurement unit (IMU) on one body, each with its own mounting."""

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from radarsdf.arrays import ArrayLike, Floats, Ints, Ints32
from radarsdf.checks import are_rigid, check, check_pose, one_for_each_scan, real_array


@dataclass(frozen=True, eq=False)
class Imu:
    """G measurements of an inertial measurement unit, in its own axes.

    Raises a ValueError for non-finite or inconsistent arrays, descending times, or an `R_sensor_imu` that is no rotation.
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
    R: Floats = real_array(R_sensor_imu, "R_sensor_imu")
    whole = np.eye(4)
    whole[:3, :3] = R[:3, :3] if R.shape in ((3, 3), (4, 4)) else 0.0
    what = f"R_sensor_imu, of shape {R.shape}, is no rotation matrix (3, 3): orthogonal, with determinant 1"
    check(are_rigid(whole[None]).all(), what)
    return whole[:3, :3]


Label: TypeAlias = Hashable  # name of a radar, such as that of its frame or topic


class Mounted(NamedTuple):
    label: Label
    T_body_sensor: Floats  # (4, 4) m


def checked_mountings(T_body_sensor: Mapping[Any, ArrayLike]) -> dict[Label, Floats]:
    """Convert mountings by label to rigid transforms (4, 4), m. Raise a ValueError if one is none."""
    return {label: check_pose(T, f"T_body_sensor of {label!r:.50}") for label, T in T_body_sensor.items()}


@dataclass(frozen=True, eq=False)
class Rig:
    """Radars of F scans, whose poses are T_world_body if the mountings are known, else T_world_sensor."""

    labels: tuple[Label, ...]  # of K radars
    of_scan: Ints32  # (F,) row in `labels` of the radar of each scan
    T_body_sensor: Floats | None  # (K, 4, 4) m

    @classmethod
    def of(
        cls, sensors: Sequence[Label] | None, T_body_sensor: Mapping[Any, ArrayLike] | None
    ) -> "Rig | None":
        """Build from the label of each scan and the mountings by label. None without labels. Raise a ValueError if they do not match."""
        if sensors is None:
            check(T_body_sensor is None, "T_body_sensor needs sensors: the label of the radar of each scan")
            return None
        of_scan = list(one_for_each_scan(sensors, "sensors"))
        labels = tuple(sorted(set(of_scan), key=str)) if T_body_sensor is None else tuple(T_body_sensor)
        row = {label: i for i, label in enumerate(labels)}
        missing = sorted({str(label) for label in of_scan if label not in row})
        check(not missing, f"T_body_sensor has no mounting of {', '.join(missing)}")
        rows = np.array([row[label] for label in of_scan], np.int32)
        known = None if T_body_sensor is None else np.stack([*checked_mountings(T_body_sensor).values()])
        return cls(labels, rows, known)

    @property
    def mountings(self) -> Floats:
        """(F, 4, 4) T_body_sensor of each scan, m; the identity if unknown."""
        if self.T_body_sensor is None:
            return np.tile(np.eye(4), (len(self.of_scan), 1, 1))
        return self.T_body_sensor[self.of_scan]

    def sensor_poses(self, poses: Floats) -> Floats:
        """Return T_world_sensor (F, 4, 4) of the scans from their `poses` (F, 4, 4), m."""
        return np.einsum("fij,fjk->fik", poses, self.mountings)

    def in_body(self, scans: Sequence[Floats]) -> list[Floats]:
        """Transform scans (N_i, 3) from the frames of their radars to that of the body, m."""
        return [scan @ T[:3, :3].T + T[:3, 3] for scan, T in zip(scans, self.mountings, strict=True)]

    def in_sensors(self, scans: Sequence[Floats]) -> list[Floats]:
        """Transform scans (N_i, 3) from the frame of the body to those of their radars, m."""
        return [(scan - T[:3, 3]) @ T[:3, :3] for scan, T in zip(scans, self.mountings, strict=True)]

    def scans_of_radars(self) -> dict[Label, Ints]:
        """Scans of each of the radars that have any, by its label."""
        return {self.labels[i]: np.flatnonzero(self.of_scan == i) for i in np.unique(self.of_scan)}

    def select(self, rows: slice | Ints | Sequence[int]) -> "Rig":
        return Rig(self.labels, self.of_scan[rows], self.T_body_sensor)
