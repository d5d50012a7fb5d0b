# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What was recorded besides poses, checked."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from radarsdf.checks import MAX_TIME_S, real_array
from radarsdf.io.scans import Scans, filled
from radarsdf.poses.by_doppler import NOT_USED, NoVelocityError, SensorVelocities
from radarsdf.poses.rigid import Floats
from radarsdf.returns.doppler import without_filler
from radarsdf.returns.movers import checked_doppler
from radarsdf.returns.rays import check_scans


@dataclass(frozen=True)
class CheckedScans:
    """F scans of one drive."""

    scans: list[Floats]
    """(N_i, 3) each, sensor frame, m; without the returns that move."""
    times_s: Floats | None
    """(F,) from the first scan on."""
    begin_s: float
    """Time of the first scan."""
    velocities: SensorVelocities | None
    """By the Doppler. None: there is none, or it tells no velocity."""
    movers: int
    """Number of returns that were left out, because they move."""
    notes: list[str]
    """Sentences on what was not used."""

    @classmethod
    def of(
        cls,
        points: Iterable[ArrayLike] | Scans,
        doppler_mps: Sequence[ArrayLike] | None,
        times: ArrayLike | None,
    ) -> CheckedScans:
        """Of scans (N_i, 3), Doppler (N_i,) and times (F,). Raises TypeError or ValueError where they are none."""
        if doppler_mps is not None and times is None and not isinstance(points, Scans):
            msg = "Doppler needs times: when each scan was taken, s"
            raise ValueError(msg)
        given, doppler_mps, times = filled(points, doppler_mps=doppler_mps, times_s=times)
        scans, _, left_out = check_scans(given)
        times_s = None if times is None else _checked_times(times, len(scans))
        begin_s = 0.0 if times_s is None else float(times_s[0])
        times_s = None if times_s is None else times_s - begin_s
        if doppler_mps is None or times_s is None:
            return cls(scans, times_s, begin_s, None, 0, left_out.notes)
        speeds, filler = without_filler(scans, checked_doppler(scans, doppler_mps))
        notes = left_out.notes if filler is None else [*left_out.notes, f"{filler}."]
        try:
            velocities = SensorVelocities.of(scans, speeds, times_s)
        except NoVelocityError as why:
            return cls(scans, times_s, begin_s, None, 0, [*notes, f"{NOT_USED}: {why}."])
        if velocities.climb_assumed:
            notes.append(
                f"Assumed: the sensor climbs by about a tenth of its speed, up or down; the Doppler of {velocities.climb_assumed} of "
                f"{len(scans)} scans does not measure its vertical velocity as well."
            )
        movers = sum(int((~static).sum()) for static in velocities.static)
        standing = [scan[static] for scan, static in zip(scans, velocities.static, strict=True)]
        return cls(standing, times_s, begin_s, velocities, movers, notes)


def _checked_times(times: ArrayLike, num_scans: int) -> Floats:
    """(F,) s."""
    times_s: Floats = real_array(times, "times")
    if times_s.shape != (num_scans,):
        msg = f"times must be one for each of {num_scans} scans, not {times_s.shape}"
        raise ValueError(msg)
    if not (np.abs(times_s) <= MAX_TIME_S).all() or (np.diff(times_s) < 0).any():
        msg = f"times must be finite, within {MAX_TIME_S:g} s, and ascend from scan to scan"
        raise ValueError(msg)
    return times_s
