# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Joint estimate of the poses of all scans, from common planes and measured motion."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from tqdm import tqdm

from radarsdf.config.groups import ReturnsConfig
from radarsdf.poses.motion import Motion
from radarsdf.poses.planes import PlaneGrid, SensorReturns, common_planes
from radarsdf.poses.rigid import Floats, aligned, moved
from radarsdf.progress import hides_bar
from radarsdf.returns.noise import SensorNoise

# Within short windows of scans, the drift is small compared with a cell. Each window may be twice as long as the one before.
_FIRST_WINDOW = 8
_OF_WINDOWS = (4, 2)  # edges of cells, in those of a map's surfels
_OF_ALL = (4, 4, 2, 2)  # the same, once all scans are together
_MOST_ROUNDS = 12  # with cells as small as a map's surfels
# Standard deviations that poses still move by. Planes change in each round, so that 0.1 is often never reached; 0.3
# ends with the same errors in half the time.
_SETTLED = 0.3
_TOLERANCE, _MOST_ITERATIONS = 1e-2, 100  # of the conjugate gradients
_EXACT = 1e-3  # tolerance where differences of solutions count
_WEAK = (
    1e-4  # information about each pose, 1/m² and 1/rad²: what returns and steps leave free stays where it is
)
_FIXED = 1e10  # information about the pose that the covariance is relative to


@dataclass(frozen=True)
class PosesEstimate:
    """Poses (F, 4, 4), their covariance (F, 6, 6), and what was estimated with them."""

    poses: Floats
    covariance: Floats
    motions: list[Motion]
    noise: SensorNoise
    rounds: int

    @classmethod
    def of(
        cls,
        returns: SensorReturns,
        given: Floats,
        motions: Sequence[Motion],
        cell_m: float,
        config: ReturnsConfig,
        num_threads: int,
        first_window: int = _FIRST_WINDOW,
        progress: bool | None = False,
    ) -> PosesEstimate:
        """From `given` (F, 4, 4) and measured motions, by Gauss and Newton's method, with new planes in each round."""
        poses, count, noise, motions = given, len(given), None, list(motions)
        plan = _plan(count, first_window)
        rounds = 0
        for window, cells in tqdm(plan, desc="poses", unit="round", disable=hides_bar(progress)):
            grid = PlaneGrid(window, rounds % 2 == 1, cells * cell_m)
            # The noise is estimated every other round: with the poses, it changes slowly.
            known = None if rounds % 2 == 0 else noise
            planes, noise = common_planes(returns, poses, grid, known, config, num_threads)
            steps, inverse, inverse_below, decrement = planes.solve(
                *_prior(motions, poses), _TOLERANCE, _MOST_ITERATIONS, True, num_threads
            )
            before, poses = poses, aligned(moved(poses, steps), given)
            motions = [motion.at(poses).learnt(poses, before, inverse, inverse_below) for motion in motions]
            rounds += 1
            if window == count and cells == 1 and decrement < _SETTLED**2 * steps.size:
                break
        assert noise is not None
        evidence = [motion.as_evidence() for motion in motions]
        diagonal, below, gradient = _prior(evidence, poses)
        diagonal[count // 2] += _FIXED * np.eye(6)
        covariance = planes.solve(diagonal, below, gradient, _TOLERANCE, 0, True, num_threads)[1]

        def solved(more: Floats | float) -> Floats:
            """Increments (F, 6) once something is added to the gradient."""
            right = gradient + more
            return planes.solve(diagonal, below, right, _EXACT, _MOST_ITERATIONS, False, num_threads)[0]

        return cls(poses, covariance + _by_biases(evidence, poses, solved), motions, noise, rounds)


def _plan(num_scans: int, window: int) -> list[tuple[int, int]]:
    """Windows of scans and edges of cells, coarse to fine, and from short windows to all scans."""
    plan = []
    while window < num_scans:
        plan += [(window, cells) for cells in _OF_WINDOWS]
        window *= 2
    return plan + [(num_scans, cells) for cells in _OF_ALL] + [(num_scans, 1)] * _MOST_ROUNDS


def _prior(motions: Sequence[Motion], poses: Floats) -> tuple[Floats, Floats, Floats]:
    """The sum of the motions' normal equations, as :meth:`Motion.prior`."""
    parts = [motion.prior(poses) for motion in motions]
    diagonal, below, gradient = (np.sum(part, axis=0) for part in zip(*parts, strict=True))
    return diagonal + _WEAK * np.eye(6), below, gradient


def _by_biases(
    motions: Sequence[Motion], poses: Floats, solved: Callable[[Floats | float], Floats]
) -> Floats:
    """(F, 6, 6) covariance of the poses by errors that all steps have in common, as far as returns leave them open.

    The biases are unknowns, too, which the poses are eliminated from (the Schur complement).
    """
    by, own = (np.concatenate(parts) for parts in zip(*(m.by_bias(poses) for m in motions), strict=True))
    if len(by) == 0:
        return np.zeros((len(poses), 6, 6))
    moved_by = np.stack([solved(each) for each in by]) - solved(0.0)
    information = np.diag(own) + np.einsum("kfi,lfi->kl", by, moved_by)
    values, axes = np.linalg.eigh((information + information.T) / 2)
    root = np.einsum("kfi,kl->lfi", moved_by, axes / np.sqrt(1 + np.maximum(values, 0.0)))
    found: Floats = np.einsum("lfi,lfj->fij", root, root)
    return found
