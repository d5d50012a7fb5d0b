# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Tracking of a drive without poses, in passes that learn its motion prior."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from tqdm import tqdm

from radarsdf.checks import hides_bar
from radarsdf.config.fit_config import FitConfig
from radarsdf.poses.doppler import DopplerMotion, SensorVelocities
from radarsdf.poses.gyroscope import Gyroscope
from radarsdf.poses.motion import ExpectedStep, Motion, MotionPrior, Rate
from radarsdf.poses.planes import plane_cell_m
from radarsdf.poses.rigid import Floats, rotation, rotation_vector
from radarsdf.poses.tracking import Tracked, Tracker

# What a drive begins with. Its own rates replace them after the first pass. With 1 rad/s, the first steps of sparse real
# scans were lost, up to 9 degrees.
_TURNS = MotionPrior(np.full(3, 0.3**2), np.full(3, 0.3**2), True)
_MOVES = MotionPrior(np.full(3, 5.0**2), np.full(3, 2.0**2), False)
_PASSES = 3
# Of a step's variance, that the returns must take away where nothing else measures the way. Below a half, the motion before
# says more than they do. Simulated walls: 0.08 and 0.10; all other kinds of scenes, seeds 81 and 82, and real drives: 0.58 to 0.95.
LEAST_TOLD = 0.5
_NO_CHANCE = 3.0  # standard deviations
LATERAL_MPS2 = 2.0
"""Deviation of the acceleration across the trajectory: what moves fast turns slowly. Vehicles on roads: about 1; drones and hands: 2."""
# Deviation of the rate of turning up to which it may stay unknown from step to step: all scans together, and the covariance, hold
# for small rotations. That of a sensor faster than 20 m/s.
_SLOW_TURN_RAD_S = 0.1
_TRACKED_M, _TRACKED_RAD = 0.03, 0.003  # deviations of a tracked step, until the estimate finds them


@dataclass(frozen=True)
class Drive:
    """What is known of a drive without its poses."""

    scans: list[Floats]
    times_s: Floats
    velocities: SensorVelocities | None
    gyroscope: Gyroscope | None
    turns: MotionPrior = _TURNS
    """Of the sensor, in its own frame."""
    moves: MotionPrior = _MOVES
    """Likewise."""

    def expected(self, i: int, turn: Rate | None, move: Rate | None) -> ExpectedStep:
        """The step to scan `i`, after one with these rates. None: nothing came before."""
        duration_s = float(self.times_s[i] - self.times_s[i - 1])
        before_s = float(self.times_s[i - 1] - self.times_s[i - 2]) if i > 1 else 0.0
        elapsed_s = (duration_s + before_s) / 2
        if self.gyroscope is not None:
            by = self.gyroscope.step(i - 1)
        else:
            rate = self.turns.after(turn, elapsed_s)
            by = Rate(rate.mean * duration_s, rate.covariance * duration_s**2)
        if self.velocities is not None:
            begin, end = self.velocities.mean_mps[i - 1 : i + 1]
            return ExpectedStep(
                by, begin, end, self.velocities.step_covariance(i - 1, duration_s), duration_s
            )
        rate = self.moves.after(move, elapsed_s)
        return ExpectedStep(by, rate.mean, rate.mean, rate.covariance * duration_s**2, duration_s)

    @property
    def usual_turn_rad_s(self) -> float:
        """Deviation of the rates at which a sensor with these velocities turns, before its returns say more."""
        usual = float(np.sqrt(_TURNS.usual[0]))
        if self.velocities is None:
            return usual
        speed_mps = np.sqrt((self.velocities.mean_mps**2).sum(axis=1).mean())
        return min(usual, LATERAL_MPS2 / max(float(speed_mps), 1e-9))

    @property
    def turns_slowly(self) -> bool:
        """Whether it is so fast that it cannot turn far from scan to scan."""
        return self.usual_turn_rad_s < _SLOW_TURN_RAD_S

    def motions(self, tracked: Sequence[Tracked], rows: slice) -> list[Motion]:
        """What was measured of the motion from scan to scan among these."""
        times_s, poses = self.times_s[rows], np.stack([found.pose for found in tracked[rows]])
        # The tracked steps begin the estimate; it finds how good they are. Where something else was measured, that tells.
        motion = Motion.of(poses, _TRACKED_M, _TRACKED_RAD, times_s)
        duration_s = float(np.median(np.diff(times_s)))
        # No evidence beside the returns that they were tracked by, but for how this sensor usually moves.
        least = duration_s**2 * np.array([self.moves.usual.max(), self.usual_turn_rad_s**2])
        if self.gyroscope is not None:
            least[1] = 0.0
            motion = motion.with_turns(
                np.stack([self.gyroscope.step(i).mean for i in range(rows.start, rows.stop - 1)])
            )
        motion = dataclasses.replace(motion, least_variances=least)
        if self.velocities is None:
            return [motion]
        turns = np.stack([found.turn for found in tracked[rows][1:]])
        # What few returns hardly change of an expected turn is an error that all steps have in common.
        common = np.full((2, 3), [[0.0], [self.usual_turn_rad_s]])
        if self.gyroscope is not None:
            common[1] = np.sqrt(self.gyroscope.bias.covariance.diagonal())
        common = common.ravel() * duration_s
        # Tracked translations beside Doppler, or in its place, double the errors of positions on simulated drives.
        return [
            dataclasses.replace(motion.rotations_only(), bias_sigma=common),
            DopplerMotion.by(self.velocities.select(rows), times_s, poses, turns),
        ]

    def new_returns(self, tracked: Sequence[Tracked], rows: slice) -> list[Floats]:
        """The scans (N_i, 3) among these, without the returns of those that the sensor repeated while it stood.

        They are those of the first such scan again, with the same errors: counted as new, they would draw all poses to these errors.
        """
        scans = list(self.scans[rows])
        if self.velocities is None:
            return scans
        means, covariance = self.velocities.mean_mps[rows], self.velocities.covariance[rows]
        stands = _squared_deviations(means, covariance) < _NO_CHANCE**2
        first: Floats | None = None  # orientation, since which it stands
        for i, (found, stood) in enumerate(zip(tracked[rows], stands, strict=True)):
            R = found.pose[:3, :3]
            if first is not None and stood:
                turn = rotation_vector(np.einsum("ij,kj->ik", R, first))
                if _squared_deviations(turn, found.covariance[3:, 3:]) < _NO_CHANCE**2:
                    scans[i] = scans[i][:0]
                    continue
            first = R if stood else None
        return scans


def _squared_deviations(values: Floats, covariance: Floats) -> Floats:
    """(...) squares of values (..., 3) in standard deviations."""
    found: Floats = np.einsum("...i,...ij,...j->...", values, np.linalg.inv(covariance), values)
    return found


def rates_of(before: Floats, now: Tracked, duration_s: float) -> tuple[Rate, Rate]:
    """Of turning and moving, in the frame of the sensor."""
    back = before[:3, :3].T
    half = rotation(0.5 * now.turn).T @ back
    way = half @ (now.pose[:3, 3] - before[:3, 3])
    of_way, of_turn = (
        matrix @ now.covariance[rows, rows] @ matrix.T / duration_s**2
        for matrix, rows in ((half, slice(0, 3)), (back, slice(3, 6)))
    )
    return Rate(now.turn / duration_s, of_turn), Rate(way / duration_s, of_way)


def _rotations(turns: Sequence[Rate | None], times_s: Floats) -> tuple[Floats, Floats]:
    """(F - 1, 3) rotation vectors of steps with these rates, rad, and their covariances. NaN where the drive was lost."""
    durations_s = np.diff(times_s)
    vectors = np.full((len(durations_s), 3), np.nan)
    covariance = np.tile(np.eye(3), (len(durations_s), 1, 1))
    for i, (rate, duration_s) in enumerate(zip(turns, durations_s.tolist(), strict=True)):
        if rate is not None:
            vectors[i], covariance[i] = rate.mean * duration_s, rate.covariance * duration_s**2
    return vectors, covariance


def _tracked(
    drive: Drive, tracker: Tracker
) -> tuple[list[Tracked], tuple[list[Rate | None], list[Rate | None]]]:
    """One pass over the scans, and the rates of turning, rad/s, and moving, m/s, of each step. None: it was lost there."""
    tracked = [tracker.follow(drive.scans[0], None)]
    turns: list[Rate | None] = []
    moves: list[Rate | None] = []
    turn = move = None
    for i in range(1, len(drive.scans)):
        expected = drive.expected(i, turn, move)
        before, now = tracked[-1], tracker.follow(drive.scans[i], expected)
        turn = move = None
        if now.piece == before.piece and expected.duration_s > 0:
            turn, move = rates_of(before.pose, now, expected.duration_s)
        turns.append(turn)
        moves.append(move)
        tracked.append(now)
    return tracked, (turns, moves)


def followed(
    drive: Drive, config: FitConfig, num_threads: int, progress: bool | None = False
) -> tuple[Drive, list[Tracked]]:
    """The drive with its own motion prior, and its scans where the last pass found them."""
    gyroscope, drive = drive.gyroscope, dataclasses.replace(drive, gyroscope=None)
    cell_m = plane_cell_m(drive.scans, config.leaf_size_m)
    tracked: list[Tracked] = []
    for i in tqdm(range(_PASSES), desc="odometry", unit="pass", disable=hides_bar(progress)):
        tracked, rates = _tracked(drive, Tracker(cell_m, config.returns, num_threads))
        if i == 0 and drive.turns_slowly and tracked[-1].piece > 0:
            # Its returns agree nowhere. The next passes search less far.
            usual = np.full(3, drive.usual_turn_rad_s**2)
            drive = dataclasses.replace(drive, turns=MotionPrior(usual, usual, True))
        turns, moves = (
            prior.learnt(of_steps, np.diff(drive.times_s))
            for prior, of_steps in zip((drive.turns, drive.moves), rates, strict=True)
        )
        drive = dataclasses.replace(drive, turns=turns, moves=moves)
        if i == 0 and gyroscope is not None:
            # Rotations that were found with its help could not tell its bias.
            learnt = gyroscope.learnt(*_rotations(rates[0], drive.times_s))
            drive = dataclasses.replace(drive, gyroscope=learnt)
    return drive, tracked
