# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Tracking of a drive without poses, in passes that learn its motion prior."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from tqdm import tqdm

from radarsdf.config.fit_config import FitConfig
from radarsdf.poses.doppler import DopplerMotion, SensorVelocities
from radarsdf.poses.gyroscope import Gyroscope
from radarsdf.poses.motion import ExpectedStep, Motion, MotionPrior, Rate
from radarsdf.poses.planes import plane_cell_m
from radarsdf.poses.rigid import Floats, rotation, rotation_vector
from radarsdf.poses.tracking import Tracked, Tracker
from radarsdf.progress import hides_bar

# Initial priors. The drive's own rates replace them after the first pass. With 1 rad/s, the first steps of sparse real
# scans were lost, up to 9 degrees.
_TURNS = MotionPrior(np.full(3, 0.3**2), np.full(3, 0.3**2), True)
_MOVES = MotionPrior(np.full(3, 5.0**2), np.full(3, 2.0**2), False)
_PASSES = 3
# Share of a step's variance that the returns must remove where nothing else measures the translation. Below a half, the motion before
# says more than they do. Simulated walls: 0.08 and 0.10; all other kinds of scenes, seeds 81 and 82, and real drives: 0.58 to 0.95.
LEAST_TOLD = 0.5
_NO_CHANCE = 3.0  # standard deviations
# Deviation of the acceleration across the trajectory: what moves fast turns slowly. Vehicles on roads: about 1; drones and hands: 2.
LATERAL_MPS2 = 2.0
# Deviation of the rate of turning up to which it may stay unknown from step to step: the joint estimate and the covariance hold
# for small rotations. That of a sensor faster than 20 m/s.
_SLOW_TURN_RAD_S = 0.1
_TRACKED_M, _TRACKED_RAD = 0.03, 0.003  # deviations of a tracked step, until the estimate finds them


@dataclass(frozen=True)
class Drive:
    """Measurements of a drive without poses."""

    scans: list[Floats]  # (N_i, 3) static returns, sensor frame, m
    times_s: Floats
    velocities: SensorVelocities | None
    gyroscope: Gyroscope | None
    turns: MotionPrior = _TURNS  # of the sensor, in its own frame
    moves: MotionPrior = _MOVES

    def expected(self, i: int, turn: Rate | None, move: Rate | None) -> ExpectedStep:
        """The step to scan `i`, after one with these rates. None: they are unknown."""
        duration_s = float(self.times_s[i] - self.times_s[i - 1])
        before_s = float(self.times_s[i - 1] - self.times_s[i - 2]) if i > 1 else 0.0
        elapsed_s = (duration_s + before_s) / 2
        if self.gyroscope is not None:
            by = self.gyroscope.step(i - 1)
        else:
            rate = self.turns.after(turn, elapsed_s)
            by = Rate(rate.mean * duration_s, rate.covariance * duration_s**2)
        if self.velocities is not None:
            covariance = self.velocities.step_covariance(i - 1, duration_s)
            return ExpectedStep(by, *self.velocities.mean_mps[i - 1 : i + 1], covariance, duration_s)
        rate = self.moves.after(move, elapsed_s)
        return ExpectedStep(by, rate.mean, rate.mean, rate.covariance * duration_s**2, duration_s)

    @property
    def usual_turn_rad_s(self) -> float:
        """Prior deviation of the rates at which a sensor with these velocities turns."""
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
        """The measured motions from scan to scan among these."""
        times_s, poses = self.times_s[rows], np.stack([found.pose for found in tracked[rows]])
        # The tracked steps initialise the estimate; it finds how good they are. Other measurements replace them.
        motion = Motion.of(poses, _TRACKED_M, _TRACKED_RAD, times_s)
        duration_s = float(np.median(np.diff(times_s)))
        # They are no evidence in addition to the returns that they were tracked by, but for how this sensor usually moves.
        least = duration_s**2 * np.array([self.moves.usual.max(), self.usual_turn_rad_s**2])
        turn_sigma_rad_s = np.full(3, self.usual_turn_rad_s)
        if self.gyroscope is not None:
            least[1] = 0.0
            turns = [self.gyroscope.step(i).mean for i in range(rows.start, rows.stop - 1)]
            motion.steps[:, :3, :3] = rotation(np.stack(turns))
            turn_sigma_rad_s = np.sqrt(self.gyroscope.bias.covariance.diagonal())
        motion = dataclasses.replace(motion, least_variances=least)
        if self.velocities is None:
            return [motion]
        # Tracked translations in addition to Doppler, or in its place, double the errors of positions on simulated drives. What
        # few returns hardly change of an expected turn is an error that all steps have in common.
        motion.shares[:, :3] = np.inf
        common = np.concatenate([np.zeros(3), turn_sigma_rad_s * duration_s])
        turns = np.stack([found.turn for found in tracked[rows][1:]])
        return [
            dataclasses.replace(motion, bias_sigma=common),
            DopplerMotion.by(self.velocities.select(rows), times_s, poses, turns),
        ]

    def new_returns(self, tracked: Sequence[Tracked], rows: slice) -> list[Floats]:
        """The scans (N_i, 3) among these, empty where the sensor stood and repeated them.

        Repeated returns have the same errors: counted as new, they would draw all poses to these errors.
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


Rates = (
    tuple[Rate, Rate] | tuple[None, None]
)  # of turning, rad/s, and moving, m/s. None: the drive was lost there


def _tracked(drive: Drive, tracker: Tracker) -> tuple[list[Tracked], list[Rates]]:
    """One pass over the scans, and the rates of each step."""
    tracked = [tracker.follow(drive.scans[0], None)]
    rates: list[Rates] = []
    last: Rates = None, None
    for i in range(1, len(drive.scans)):
        expected = drive.expected(i, *last)
        before, now = tracked[-1], tracker.follow(drive.scans[i], expected)
        followed = now.piece == before.piece and expected.duration_s > 0
        last = rates_of(before.pose, now, expected.duration_s) if followed else (None, None)
        rates.append(last)
        tracked.append(now)
    return tracked, rates


def followed(
    drive: Drive, config: FitConfig, num_threads: int, progress: bool | None = False
) -> tuple[Drive, list[Tracked]]:
    """The drive with its own motion prior, and its scans where the last pass found them."""
    gyroscope, drive = drive.gyroscope, dataclasses.replace(drive, gyroscope=None)
    cell_m, durations_s = plane_cell_m(drive.scans, config.leaf_size_m), np.diff(drive.times_s)
    tracked: list[Tracked] = []
    for i in tqdm(range(_PASSES), desc="odometry", unit="pass", disable=hides_bar(progress)):
        tracked, rates = _tracked(drive, Tracker(cell_m, config.returns, num_threads))
        turn_prior = drive.turns
        if i == 0 and drive.turns_slowly and tracked[-1].piece > 0:
            # Its returns agree nowhere. The next passes search less far.
            usual = np.full(3, drive.usual_turn_rad_s**2)
            turn_prior = MotionPrior(usual, usual, True)
        drive = dataclasses.replace(
            drive,
            turns=turn_prior.learnt([turn for turn, _ in rates], durations_s),
            moves=drive.moves.learnt([move for _, move in rates], durations_s),
        )
        if i == 0 and gyroscope is not None:
            # Rotations that were found with its help could not show its bias.
            vectors, covariance = np.full((len(rates), 3), np.nan), np.tile(np.eye(3), (len(rates), 1, 1))
            for k, ((turn, _), duration_s) in enumerate(zip(rates, durations_s, strict=True)):
                if turn is not None:
                    vectors[k], covariance[k] = turn.mean * duration_s, turn.covariance * duration_s**2
            drive = dataclasses.replace(drive, gyroscope=gyroscope.learnt(vectors, covariance))
    return drive, tracked
