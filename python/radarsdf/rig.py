"""Rigs: several radars on one body, each with its own mounting."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from radarsdf.arrays import Floats, Ints, Ints32
from radarsdf.checks import check, check_pose, one_for_each_scan

Label: TypeAlias = Hashable
"""Name of a radar, such as that of its frame or topic."""


class Mounted(NamedTuple):
    """Radar on a body."""

    label: Label
    T_body_sensor: Floats  # (4, 4) m


def checked_mountings(T_body_sensor: Mapping[Any, ArrayLike]) -> dict[Label, Floats]:
    """Convert mountings by label to rigid transforms (4, 4), m. Raise a ValueError if one is none."""
    return {label: check_pose(T, f"T_body_sensor of {label!r:.50}") for label, T in T_body_sensor.items()}


@dataclass(frozen=True, eq=False)
class Rig:
    """Radars of F scans.

    The poses of their scans are T_world_body if the mountings are known, else T_world_sensor.
    """

    labels: tuple[Label, ...]  # of K radars
    of_scan: Ints32  # (F,) row in `labels` of the radar of each scan
    T_body_sensor: Floats | None  # (K, 4, 4) m

    @classmethod
    def of(cls, sensors: Sequence[Label] | None, T_body_sensor: Mapping[Any, ArrayLike] | None) -> Rig | None:
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
        if T_body_sensor is None:
            return cls(labels, rows, None)
        return cls(labels, rows, np.stack([*checked_mountings(T_body_sensor).values()]))

    @property
    def sensors(self) -> list[Label]:
        """Label of the radar of each scan, F of them."""
        return [self.labels[i] for i in self.of_scan]

    @property
    def mountings(self) -> Floats:
        """(F, 4, 4) T_body_sensor of each scan, m; the identity if unknown."""
        if self.T_body_sensor is None:
            return np.tile(np.eye(4), (len(self.of_scan), 1, 1))
        return self.T_body_sensor[self.of_scan]

    def sensor_poses(self, poses: Floats) -> Floats:
        """Return T_world_sensor (F, 4, 4) of the scans from their `poses` (F, 4, 4), m."""
        return np.einsum("fij,fjk->fik", poses, self.mountings)

    def body_poses(self, T_world_sensor: Floats) -> Floats:
        """Return the poses (F, 4, 4) of the scans, m, the inverse of :meth:`sensor_poses`."""
        return np.einsum("fij,fjk->fik", T_world_sensor, np.linalg.inv(self.mountings))

    def in_body(self, scans: Sequence[Floats]) -> list[Floats]:
        """Transform scans (N_i, 3) from the frames of their radars to that of the body, m."""
        return [scan @ T[:3, :3].T + T[:3, 3] for scan, T in zip(scans, self.mountings, strict=True)]

    def in_sensors(self, scans: Sequence[Floats]) -> list[Floats]:
        """Transform scans (N_i, 3) from the frame of the body to those of their radars, m."""
        return [(scan - T[:3, 3]) @ T[:3, :3] for scan, T in zip(scans, self.mountings, strict=True)]

    def scans_of_radars(self) -> dict[Label, Ints]:
        """Scans of each of the radars that have any, by its label."""
        return {self.labels[i]: np.flatnonzero(self.of_scan == i) for i in np.unique(self.of_scan)}

    def select(self, rows: slice | Ints | Sequence[int]) -> Rig:
        return Rig(self.labels, self.of_scan[rows], self.T_body_sensor)
