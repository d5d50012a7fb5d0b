# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The input of a check, with shapes that fit together, and what a check finds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

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
Arrays = list[NDArray[Any]]

Severity = Literal["error", "warning", "note"]
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")
"""From the worst to the mildest."""

_SAMPLE = 40  # scans that show what returns of a sensor are like


@dataclass(frozen=True)
class Finding:
    """One thing that is worth knowing before a fit."""

    name: str
    """A short name in lower case that does not change between versions, such as ``poses_inverted``."""
    severity: Severity
    """``error``: a map of these data would be nonsense. ``warning``: it would suffer. ``note``: for information."""
    evidence: str
    """One sentence with the numbers that show it."""
    mend: str
    """One sentence that says what to do."""

    def __str__(self) -> str:
        return f"{self.severity}: {self.name}: {self.evidence} {self.mend}".rstrip()


@dataclass(frozen=True)
class Recording:
    """F scans with N_i returns each. Only shapes are valid: the values are what is checked."""

    points: Arrays
    """F arrays (N_i, 3); sensor frame, m, if nothing is wrong."""
    poses: FloatArray
    """(F, 4, 4); T_world_sensor, m, if nothing is wrong."""
    intensities: Arrays | None
    """F arrays (N_i,), sensor units."""
    doppler_mps: Arrays | None
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
        """Raises a TypeError or a ValueError that names the argument whose shape or type does not fit."""
        scans = [_numbers(scan, f"scan {i}") for i, scan in enumerate(one_for_each_scan(points, "points"))]
        check_scan_shapes(scans)
        T_world_sensor = pose_matrices(poses, len(scans))
        times = None if times_s is None else real_array(times_s, "times_s").copy()
        if times is not None and times.shape != (len(scans),):
            msg = f"times_s must have shape ({len(scans)},), not {times.shape}"
            raise ValueError(msg)
        if times is not None:
            times[np.abs(times) > MAX_TIME_S] = np.nan
        return cls(
            scans,
            T_world_sensor,
            _values(intensities, scans, "intensities"),
            _values(doppler_mps, scans, "doppler_mps"),
            times,
        )

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

    def without(self, left_out: Sequence[NDArray[np.bool_]]) -> Recording:
        """Without the rows of each scan in its mask (N_i,)."""

        def kept(arrays: Arrays) -> Arrays:
            return [values[~mask] for values, mask in zip(arrays, left_out, strict=True)]

        intensities, doppler = (a if a is None else kept(a) for a in (self.intensities, self.doppler_mps))
        return Recording(kept(self.points), self.poses, intensities, doppler, self.times_s)

    def some_scans(self, count: int = _SAMPLE) -> NDArray[np.int64]:
        """Numbers of at most about `count` scans, at equal steps."""
        return np.arange(0, len(self), -(-len(self) // count))


def _numbers(values: ArrayLike, name: str) -> NDArray[Any]:
    """`values` as an array of real numbers. float32 stays float32: only samples are computed with."""
    if isinstance(values, np.ndarray) and values.dtype.kind == "f":
        refuse_masked(values, name)
        return values
    return real_array(values, name)


def _values(given: Sequence[ArrayLike] | None, scans: Arrays, name: str) -> Arrays | None:
    if given is None:
        return None
    values = [
        _numbers(value, f"{name} of scan {i}") for i, value in enumerate(one_for_each_scan(given, name))
    ]
    check_values_of_scans(values, scans, name)
    return values
