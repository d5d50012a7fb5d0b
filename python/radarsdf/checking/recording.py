# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The scans, poses and other arrays of a check. Only their shapes are right: their values are what is checked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from radarsdf.checks import (
    MAX_TIME_S,
    check_scan_shapes,
    check_values_of_scans,
    one_for_each_scan,
    pose_matrices,
    real_array,
    refuse_masked,
)
from radarsdf.io.scans import chosen

FloatArray = NDArray[np.float64]

_ENOUGH = 40  # scans tell what returns of this sensor are like


@dataclass(frozen=True)
class Recording:
    """F scans with N_i returns each."""

    points: list[NDArray[Any]]
    """F arrays (N_i, 3), as given: sensor frame, m, if nothing is wrong."""
    poses: FloatArray
    """(F, 4, 4), as given: T_world_sensor, m, if nothing is wrong."""
    intensities: list[NDArray[Any]] | None
    """F arrays (N_i,), sensor units."""
    doppler_mps: list[NDArray[Any]] | None
    """F arrays (N_i,), m/s."""
    times_s: FloatArray | None
    """(F,) time of each scan, s."""

    @classmethod
    def of(
        cls,
        points: Sequence[ArrayLike],
        poses: ArrayLike,
        intensities: Sequence[ArrayLike] | None,
        doppler_mps: Sequence[ArrayLike] | None,
        times_s: ArrayLike | None,
    ) -> Recording:
        """The arrays, if their shapes fit together. Else a TypeError or a ValueError that names the argument."""
        scans = [_numbers(scan, f"scan {i}") for i, scan in enumerate(one_for_each_scan(points, "points"))]
        check_scan_shapes(scans)
        T_world_sensor = pose_matrices(poses, len(scans))
        times = None if times_s is None else real_array(times_s, "times_s").copy()
        if times is not None and times.shape != (len(scans),):
            msg = f"times_s must have shape ({len(scans)},), not {times.shape}"
            raise ValueError(msg)
        if times is not None:
            times[np.abs(times) > MAX_TIME_S] = np.nan  # they are none
        values = [
            None if given is None else _values_of(given, scans, name)
            for given, name in ((intensities, "intensities"), (doppler_mps, "doppler_mps"))
        ]
        return cls(scans, T_world_sensor, values[0], values[1], times)

    def __len__(self) -> int:
        return len(self.points)

    @property
    def ascending_times_s(self) -> FloatArray | None:
        """`times_s`, if each is later than the one before; else None."""
        times = self.times_s
        return times if times is not None and (np.diff(times) > 0).all() else None

    def select(self, scans: NDArray[np.int64]) -> Recording:
        """The scans with these numbers (K,), in this order."""
        return Recording(
            [self.points[i] for i in scans],
            self.poses[scans],
            chosen(self.intensities, scans),
            chosen(self.doppler_mps, scans),
            None if self.times_s is None else self.times_s[scans],
        )

    def some_scans(self, count: int = _ENOUGH) -> NDArray[np.int64]:
        """Numbers of at most about `count` scans, at equal steps."""
        return np.arange(0, len(self), -(-len(self) // count))


def _numbers(values: ArrayLike, name: str) -> NDArray[Any]:
    """`values` as an array of real numbers. float32 stays float32: only samples are computed with."""
    if isinstance(values, np.ndarray) and values.dtype.kind == "f":
        refuse_masked(values, name)
        return values
    return real_array(values, name)


def _values_of(given: Sequence[ArrayLike], scans: list[NDArray[Any]], name: str) -> list[NDArray[Any]]:
    values = [
        _numbers(value, f"{name} of scan {i}") for i, value in enumerate(one_for_each_scan(given, name))
    ]
    check_values_of_scans(values, scans, name)
    return values
