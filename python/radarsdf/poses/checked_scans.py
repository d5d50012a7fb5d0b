"""Validation of scans, times and Doppler: shapes, values and units."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from typing_extensions import Self

from radarsdf.arrays import ArrayLike, Floats, Ints
from radarsdf.checks import MAX_TIME_S, check, instance, real_array, values_of_scans
from radarsdf.config.fit_config import FitConfig
from radarsdf.poses.agreement import CLEAR, sign_significance, turns_fast
from radarsdf.poses.doppler import NOT_USED, BodyVelocities, NoVelocityError, SensorVelocities
from radarsdf.returns.moving import without_filler
from radarsdf.returns.rays import check_scans
from radarsdf.rig import Rig
from radarsdf.scans import Scans, chosen, filled
from radarsdf.threads import resolve_num_threads

_Points: TypeAlias = Iterable[ArrayLike] | Scans
_Doppler: TypeAlias = Sequence[ArrayLike] | None

_MOST_M = 500.0  # maximum median range, m. Imaging radars reach 300 m
_INTERVALS_S = 0.002, 20.0  # limits of the median scan interval: 500 Hz, and no overlap of moving scans
_NO_TIMES = "Doppler needs times: the time of each scan (times_s), s"
_MOST_REACHES = 10.0  # maximum distance between two scans, median ranges: they do not overlap


def checked_settings(config: FitConfig | None) -> FitConfig:
    """Return settings, by default the usual ones, with the number of threads to use."""
    config = FitConfig() if config is None else instance(config, FitConfig, "config")
    return config.override(num_threads=resolve_num_threads(config.num_threads))


@dataclass(frozen=True)
class CheckedScans:
    """Validated scans of one radar, or of a rig in the frame of its body, F of them."""

    rows: Ints  # (F,) numbers among the scans of all radars
    scans: list[Floats]  # (N_i, 3) static returns, sensor frame, m
    times_s: Floats  # (F,) relative to the first scan of all radars; numbers of scans if unknown
    velocities: SensorVelocities | None  # from Doppler. None without Doppler, or if it yields no velocity
    moving: int  # number of moving returns left out
    notes: list[str]  # sentences on unused input
    sign: int = 1  # -1 if its Doppler was positive for approaching objects
    # (2, F - 1) rough yaws between scans of a sensor that turns fast, for the sign of the Doppler and its reverse. NaN if unknown.
    yaws: Floats | None = None

    @classmethod
    def of(cls, points: Iterable[ArrayLike], doppler_mps: _Doppler, times: ArrayLike | None) -> Self:
        """Check scans (N_i, 3), Doppler (N_i,) and times (F,). Raise a TypeError or ValueError if they are invalid."""
        scans, _, left_out = check_scans(points)
        range_m = median_range_m(scans)
        check(range_m <= _MOST_M, f"points have a median range of {range_m:.0f} m: convert mm or cm to m")
        rows, notes, times_s = np.arange(len(scans)), left_out.notes, _checked_times(times, len(scans))
        times_s, repeated = _spread_times(times_s - times_s[0])
        if repeated:
            notes = [*notes, f"{repeated} scans repeat the previous time: they are spread evenly."]
        unused = cls(rows, scans, times_s, None, 0, notes)
        if doppler_mps is None or times is None:
            return unused
        speeds, filler = without_filler(scans, values_of_scans(doppler_mps, scans, "doppler_mps"))
        notes = notes if filler is None else [*notes, f"{filler}."]
        try:
            velocities = SensorVelocities.of(scans, speeds, times_s)
        except NoVelocityError as why:
            return replace(unused, notes=[*notes, f"{NOT_USED}: {why}."])
        if velocities.climb_assumed:
            count = f"{velocities.climb_assumed} of {len(scans)} scans"
            climb = f"Assumed: the sensor climbs by about a tenth of its speed; the Doppler of {count} hardly measures its climb."
            notes = [*notes, climb]
        each = zip(scans, speeds, velocities.of_scans, strict=True)
        known = velocities.offset is None  # with one, directions would be excluded
        static = [x[one.static | np.isnan(mps)] if known and one.found else x for x, mps, one in each]
        moving = sum(map(len, scans)) - sum(map(len, static))
        return cls(rows, static, times_s, velocities, moving, notes)

    @classmethod
    def of_radars(
        cls, points: _Points, doppler_mps: _Doppler, times: ArrayLike | None, *, mounted: bool = True
    ) -> tuple[Rig | None, list[Self]]:
        """:meth:`of` for each radar, and the rig if there are several, whose mountings must be known if `mounted`."""
        rig, given, speeds, times_ = filled(points, doppler_mps=doppler_mps, times_s=times)
        known = rig is None or rig.T_body_sensor is not None
        check(known or not mounted, "T_body_sensor is missing: the mounting of each radar")
        unused = rig is None and isinstance(points, Scans)  # of one radar, Doppler without times
        check(speeds is None or times_ is not None or unused, _NO_TIMES)
        if rig is None:
            return None, [cls.of(given, speeds, times_)]
        times_s, radars = _checked_times(times_, len(given)), []
        for rows in rig.scans_of_radars().values():
            checked = cls.of([given[i] for i in rows], chosen(speeds, rows), times_s[rows])
            since_s = checked.times_s + (times_s[rows[0]] - times_s[0])
            radars.append(replace(checked, rows=rows, times_s=since_s))
        return rig, radars

    def signed(self) -> Self:
        """Choose the sign of the Doppler with which neighbouring scans agree."""
        if self.velocities is None:
            return self
        significance, yaws = sign_significance(self.scans, self.velocities, self.times_s)
        sign = -1 if significance < -CLEAR else 1
        velocities, yaws = self.velocities.scaled(sign), yaws[::sign]
        known = yaws if turns_fast(yaws[0]) else None
        return replace(self, velocities=velocities, sign=sign, yaws=known)

    def check_intervals(self) -> None:
        """Raise a ValueError if the times between scans cannot be in seconds."""
        if len(self.scans) < 2:
            return
        interval_s = float(np.median(np.diff(self.times_s)))
        step_m = 0.0 if self.velocities is None else self.velocities.usual_mps * interval_s
        range_m = median_range_m(self.scans)
        low, high = _INTERVALS_S
        apart = f"times of scans are {interval_s:.3g} s apart, median, in which the sensor moves {step_m:.3g} m by its Doppler"
        msg = f"{apart}, while returns are {range_m:.1f} m away: give times in s, Doppler in m/s"
        check(step_m <= _MOST_REACHES * range_m and low <= interval_s <= high, msg)


def join_radars(rig: Rig | None, radars: Sequence[CheckedScans]) -> CheckedScans:
    """Return the scans of all radars in order, in the frame of the body."""
    if rig is None:
        return radars[0]
    rows = np.concatenate([each.rows for each in radars])
    order, scans = np.argsort(rows), [scan for each in radars for scan in each.scans]
    # They need not ascend after a correction of those of one radar.
    times_s = np.maximum.accumulate(np.concatenate([each.times_s for each in radars])[order])
    measured = [(each.rows, each.velocities) for each in radars if each.velocities is not None]
    velocities = BodyVelocities.of_radars(rig, measured, times_s) if measured else None
    scans, notes = rig.in_body([scans[i] for i in order]), [note for each in radars for note in each.notes]
    moving = sum(each.moving for each in radars)
    return CheckedScans(rows[order], scans, times_s, velocities, moving, notes)


def _spread_times(times_s: Floats) -> tuple[Floats, int]:
    """Spread repeated times (F,) evenly up to the next later one; return them with the number of repeats."""
    first = np.r_[True, np.diff(times_s) > 0]
    if first.all() or first.sum() < 2:
        return times_s, 0
    knots = np.flatnonzero(first)
    end_s = times_s[knots[-1]] + np.median(np.diff(times_s[knots]))
    at, known_s = np.append(knots, len(times_s)), np.append(times_s[knots], end_s)
    return np.interp(np.arange(len(times_s)), at, known_s), int((~first).sum())


def median_range_m(scans: Sequence[Floats]) -> float:
    """Return the median range of all returns (N_i, 3). 0 without returns."""
    ranges_m = np.concatenate([np.linalg.norm(scan, axis=1) for scan in scans])
    return float(np.median(ranges_m)) if len(ranges_m) else 0.0


def _checked_times(times: ArrayLike | None, num_scans: int) -> Floats:
    """Return times (F,), s, or numbers of scans without any. Raise a ValueError if they are invalid."""
    times_s = real_array(np.arange(num_scans) if times is None else times, "times_s")
    one_each = times_s.shape == (num_scans,)
    check(one_each, f"times_s must be one for each of {num_scans} scans, not {times_s.shape}")
    ascending = (np.abs(times_s) <= MAX_TIME_S).all() and not (np.diff(times_s) < 0).any()
    check(ascending, f"times_s must be finite, within {MAX_TIME_S:g} s, and ascend from scan to scan")
    return times_s
