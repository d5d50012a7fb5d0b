# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Where a scan without a pose is: on the planes of the last ones, near where its Doppler or the motion so far lead."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from radarsdf.config.fit_config import FitConfig
from radarsdf.live.scan_log import LoggedScan
from radarsdf.poses.by_doppler import LEAST_MPS, SensorVelocities, doppler_sign, upright
from radarsdf.poses.drive import Drive, rates_of
from radarsdf.poses.odometry import LEAST_TOLD
from radarsdf.poses.rates import Rate
from radarsdf.poses.rigid import Floats, rotation_vector
from radarsdf.poses.tracking import WINDOW, Tracked, Tracker, begun
from radarsdf.returns.doppler import SensorVelocity, sensor_velocities
from radarsdf.returns.surfels import LEAVES_PER_SURFEL

_STEPS = 100  # of the motion so far, that habits are learnt from
_SIGN_FROM, _SIGN_UNTIL = 3, 30  # scans, after which the sign of the Doppler is looked for
_TOLD_STEPS = 10  # over which it is asked whether returns alone tell the way
_GIVEN = np.diag([0.01**2] * 3 + [0.001**2] * 3)  # covariance of a step between given poses, about


class Lost(ValueError):
    """The returns of a scan agree nowhere near where it was expected: where it was taken is not known."""


@dataclass(frozen=True)
class Step:
    """A scan, and where it was found."""

    scan: Floats
    """(N, 3) of the returns that stand still, sensor frame, m."""
    time_s: float
    velocity: SensorVelocity | None
    found: Tracked


@dataclass
class Follower:
    """Follows the sensor. :meth:`seek` changes nothing, so that a scan which is refused leaves no trace."""

    config: FitConfig
    num_threads: int
    _tracker: Tracker = field(init=False)
    _steps: deque[Step] = field(default_factory=lambda: deque(maxlen=_STEPS))
    _rates: deque[tuple[Rate | None, Rate | None]] = field(default_factory=lambda: deque(maxlen=_STEPS))
    _given: deque[tuple[LoggedScan, float]] = field(default_factory=lambda: deque(maxlen=WINDOW))
    _speeds: deque[Floats] = field(default_factory=lambda: deque(maxlen=WINDOW))  # of the last scans, m/s
    _sign: int = 0  # of the Doppler. 0: not known yet, so that it is not used

    def __post_init__(self) -> None:
        size_m = LEAVES_PER_SURFEL * self.config.leaf_size_m
        self._tracker = Tracker(size_m, self.config.returns, self.num_threads)

    def seek(self, logged: LoggedScan, time_s: float) -> Step:
        """Where a scan is. Raises a ValueError if it is late, Lost if it is nowhere near. The pose of `logged` does not count."""
        for before, at_s in self._given:
            self._place(before, at_s)
        self._given.clear()
        scan, velocity = _standing(logged), self._velocity(logged)
        if not self._steps:
            return Step(scan, time_s, velocity, begun(np.eye(4)))
        last = self._steps[-1]
        if not time_s > last.time_s:
            msg = f"a scan without a pose must be later than the one before it: {time_s:.6f} s is not after {last.time_s:.6f} s"
            raise ValueError(msg)
        drive = self._drive([*list(self._steps)[-2:], Step(scan, time_s, velocity, last.found)])
        turn, move = self._rates[-1] if self._rates else (None, None)
        found = self._tracker.seek(scan, drive.expected(len(drive.times_s) - 1, turn, move))
        if found.piece != last.found.piece:
            msg = f"the scan at {time_s:.6f} s agrees with the last ones nowhere near: give its pose"
            raise Lost(msg)
        told = [step.found.told[0] for step in self._steps][-_TOLD_STEPS:]
        if drive.velocities is None and len(told) == _TOLD_STEPS and np.median(told) < LEAST_TOLD:
            missing = "their Doppler (doppler_mps), or poses"
            if logged.doppler_mps is not None:
                why = "the last two scans agree on no velocity" if self._sign else "its sign is not known yet"
                missing = f"poses. The Doppler is not used: {why}"
            msg = f"the returns alone do not tell how the sensor moves: give {missing}"
            raise Lost(msg)
        return Step(scan, time_s, velocity, found)

    def keep(self, logged: LoggedScan, time_s: float | None, step: Step | None) -> None:
        """The scan was there: the next one is looked for from it. `step` None: its pose was given."""
        if step is not None:
            self._take(step, logged)
        elif time_s is not None:  # only looked at once a scan comes without its pose
            self._given.append((logged, time_s))

    def _take(self, step: Step, logged: LoggedScan) -> None:
        if logged.doppler_mps is not None:
            self._speeds.append(logged.doppler_mps)
        if self._steps:
            before = self._steps[-1]
            duration_s = step.time_s - before.time_s
            known = duration_s > 0 and step.found.piece == before.found.piece
            rates = rates_of(before.found.pose, step.found, duration_s) if known else (None, None)
            self._rates.append(rates)
        self._tracker.keep(step.scan, step.found)
        self._steps.append(step)
        if self._sign == 0 and _SIGN_FROM <= len(self._steps) <= _SIGN_UNTIL:
            self._sign = self._found_sign()

    def _place(self, logged: LoggedScan, time_s: float) -> None:
        """A scan came with its pose."""
        pose, piece, turn = logged.pose, 0, np.zeros(3)
        if self._steps:
            last = self._steps[-1]
            if not time_s > last.time_s:
                return
            piece, turn = last.found.piece, rotation_vector(last.found.pose[:3, :3].T @ pose[:3, :3])
        found = Tracked(pose, _GIVEN, 1.0, piece, turn)
        self._take(Step(_standing(logged), time_s, self._velocity(logged), found), logged)

    def _velocity(self, logged: LoggedScan) -> SensorVelocity | None:
        """By the Doppler of a scan. None: it has none."""
        if logged.doppler_mps is None:
            return None
        return sensor_velocities([logged.points], [logged.doppler_mps], self._speeds)[0]

    def _drive(self, steps: list[Step]) -> Drive:
        """Of the last scans, with the habits so far."""
        times_s = np.array([step.time_s for step in steps])
        usual = Drive([], times_s, None, None)
        durations_s = np.array(
            [b.time_s - a.time_s for a, b in zip(self._steps, list(self._steps)[1:], strict=False)]
        )[-len(self._rates) :]
        turns, moves = ([rates[k] for rates in self._rates] for k in (0, 1))
        return Drive(
            [step.scan for step in steps],
            times_s,
            self._velocities(steps, self._sign) if self._sign else None,
            None,
            usual.turns.learnt(turns, durations_s),
            usual.moves.learnt(moves, durations_s),
        )

    def _velocities(self, steps: list[Step], sign: int) -> SensorVelocities | None:
        """By their Doppler. None: one of the last two tells none."""
        if any(step.velocity is None or not step.velocity.found for step in steps[-2:]):
            return None
        mean, covariance = np.zeros((len(steps), 3)), np.tile(np.eye(3), (len(steps), 1, 1))
        for i, step in enumerate(steps):
            if step.velocity is not None and step.velocity.found:
                mean[i] = sign * step.velocity.velocity_mps
                covariance[i] = step.velocity.covariance + LEAST_MPS**2 * np.eye(3)
        mean, covariance, _ = upright(mean, covariance)
        known = [step for step in self._steps if step.velocity is not None and step.velocity.found]
        speeds = np.array([step.velocity.velocity_mps for step in known if step.velocity is not None])
        duration_s = max(known[-1].time_s - known[0].time_s, 1e-9) if known else 1.0
        changes = np.square(np.diff(speeds, axis=0)).sum(axis=0) if len(known) > 1 else np.ones(3)
        static = [np.ones(len(step.scan), bool) for step in steps]
        found = np.ones(len(steps), bool)
        return SensorVelocities(mean, covariance, changes / duration_s + LEAST_MPS**2, static, found)

    def _found_sign(self) -> int:
        """-1 if the radar's Doppler is positive as the sensor comes nearer, 1 if it is negative; 0 if that is not clear."""
        steps = list(self._steps)
        velocities = self._velocities(steps, 1)
        if velocities is None:
            return 0
        scans, times_s = [step.scan for step in steps], np.array([step.time_s for step in steps])
        if doppler_sign(scans, velocities, times_s) < 0:
            return -1
        return 1 if doppler_sign(scans, velocities.turned, times_s) < 0 else 0


def _standing(logged: LoggedScan) -> Floats:
    points = logged.points if logged.standing is None else logged.points[logged.standing]
    return np.ascontiguousarray(points, np.float64)
