"""Trajectory of a body as a cubic B-spline, with the mountings, time offsets and errors of the radars that it carries."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import sparse
from scipy.interpolate import BSpline
from scipy.spatial.transform import Rotation, RotationSpline

from radarsdf.arrays import Floats, Ints32
from radarsdf.poses.rigid import moved, rotation

# Unknowns of a knot, and of a radar: lever arm, rotation, time offset, systematic error of its velocities, share of the speed.
OF_KNOT, OF_RADAR = 6, 10


@dataclass(frozen=True)
class BodyMotion:
    """Motion of the body at F times."""

    weights: Floats  # (F, J) of the knots
    rates: Floats  # (F, J) derivatives of the weights
    R: Floats
    p: Floats
    v: Floats  # world, m/s
    omega: Floats  # body, rad/s
    change: Floats  # (F, 12) derivatives of position, orientation, velocity and turn rate, world


@dataclass(frozen=True)
class BodyPath:
    knots_s: Floats
    positions: Floats  # (J, 3)
    turns: Floats  # (J, 3) rotation vectors, world
    first: RotationSpline  # that the turns refine
    mountings: Floats  # (K, 4, 4)
    late_s: Floats  # (K,)
    shares: Floats  # (K, 3)

    @classmethod
    def of(cls, times_s: Floats, poses: Floats, end_s: float, step_s: float, mountings: Floats) -> "BodyPath":
        """Fit a spline from 0 to `end_s`, with knots every `step_s`, to poses (F, 4, 4) at times (F,)."""
        count = int(np.ceil(end_s / step_s)) + 3
        knots_s = step_s * np.linspace(-3, count, count + 4)
        first = RotationSpline(times_s, Rotation.from_matrix(poses[:, :3, :3]))
        within = (times_s >= 0) & (times_s <= end_s)
        weights, positions = BSpline(knots_s, np.eye(count), 3)(times_s[within]), poses[within, :3, 3]
        # Knots before and after the drive are not observed: the spline continues smoothly (P-spline).
        weights = np.concatenate([weights, 1e-3 * np.diff(np.eye(count), 2, axis=0)])
        ahead = np.concatenate([positions - positions.mean(axis=0), np.zeros((count - 2, 3))])
        positions = np.linalg.lstsq(weights, ahead, rcond=None)[0]
        own = np.zeros((len(mountings), 4))
        return cls(knots_s, positions, np.zeros((count, 3)), first, mountings, own[:, 0], own[:, 1:])

    def motion(self, times_s: Floats) -> BodyMotion:
        times_s = np.clip(times_s, self.knots_s[3], self.knots_s[-4])
        basis = BSpline(self.knots_s, np.eye(len(self.positions)), 3)
        weights = np.stack([basis(times_s, order) for order in range(3)])
        p, v, acceleration = weights @ self.positions
        turns = weights @ self.turns
        R = rotation(turns[0]) @ self.first(times_s).as_matrix()
        omega, alpha = (self.first(times_s, i) + np.einsum("fji,fj->fi", R, turns[i]) for i in (1, 2))
        turning, accelerating = np.einsum("fij,kfj->kfi", R, [omega, alpha])
        change = np.concatenate([v, turning, acceleration, accelerating], axis=1)
        return BodyMotion(weights[0], weights[1], R, p, v, omega, change)

    def moved(self, step: Floats) -> "BodyPath":
        count = len(self.positions)
        path = step[: OF_KNOT * count].reshape(count, OF_KNOT)
        own = step[OF_KNOT * count :].reshape(-1, OF_RADAR)
        return replace(
            self,
            positions=self.positions + path[:, :3],
            turns=self.turns + path[:, 3:],
            mountings=moved(self.mountings, own[:, :6]),
            late_s=self.late_s + own[:, 6],
            shares=self.shares + own[:, 7:],
        )

    def columns(
        self, at: BodyMotion, by_motion: Floats, own: Floats | None = None, of_scan: Ints32 | None = None
    ) -> Any:
        """Derivatives (F * M, U), sparse, from those by the motion (F, M, 12) and the unknowns of the radars (F, M, 10)."""
        count, rows, _ = by_motion.shape
        path = np.einsum("fmi,fj->fmji", by_motion[..., :6], at.weights)
        path += np.einsum("fmi,fj->fmji", by_motion[..., 6:], at.rates)
        radars = np.zeros((count, rows, len(self.mountings), OF_RADAR))
        if own is not None:
            own[..., 6] = -np.einsum("fmi,fi->fm", by_motion, at.change)
            radars[np.arange(count), :, of_scan] = own
        whole = [path.reshape(count * rows, -1), radars.reshape(count * rows, -1)]
        return sparse.csr_matrix(np.concatenate(whole, axis=1))
