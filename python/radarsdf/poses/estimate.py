"""Joint estimate of the poses of all scans, from common planes and measured motion."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from tqdm import tqdm

from radarsdf.arrays import Floats
from radarsdf.checks import hides_bar
from radarsdf.config.groups import ReturnsConfig
from radarsdf.poses.motion import Motion, step_variances
from radarsdf.poses.planes import PlaneGrid, SensorReturns, common_planes
from radarsdf.poses.rigid import aligned, moved
from radarsdf.returns.noise import SensorNoise

# Within short windows of scans, the drift is small compared with a cell. The window doubles from stage to stage.
_FIRST_WINDOW = 8
_OF_WINDOWS = (4, 2)  # cell edges for windows, relative to a map's surfels
_OF_ALL = (4, 4, 2, 2)  # cell edges for all scans
_MOST_ROUNDS = 12  # maximum number of rounds with the cells of a map's surfels
# Coarse planes are kept if fine ones double the standard deviation of a component of the steps, of few returns. By less, they do not
# lose: surfaces are less flat in coarse cells, which no variance includes.
_COARSER = np.log(4)
# Convergence threshold on the step, standard deviations. Planes change in each round, so that 0.1 is often never reached;
# 0.3 results in the same errors in half the time.
_SETTLED = 0.3
_TOLERANCE, _MOST_ITERATIONS = 1e-2, 100  # of the conjugate gradients
_EXACT = 1e-3  # tolerance for differences of solutions
# Information of a weak prior on each pose, 1/m² and 1/rad²: unobserved components are not changed.
WEAK = 1e-4
_FIXED = 1e10  # information that fixes the reference pose of the covariance

# Measurement of absolute poses (F, 4, 4): its Hessian (F, 6, 6) and gradient (F, 6) by increments.
Anchor: TypeAlias = Callable[[Floats], tuple[Floats, Floats]]


@dataclass(frozen=True)
class PosesEstimate:
    """Estimated poses (F, 4, 4), their covariance (F, 6, 6), motions and noise."""

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
        anchor: Anchor | None = None,
    ) -> PosesEstimate:
        """Estimate from `given` (F, 4, 4) and measured motions by the Gauss-Newton method, with new planes in each round.

        Without an anchor, the mean pose is that of `given`, and the covariance relative to the middle scan.
        """
        poses, count, noise, motions = given, len(given), None, list(motions)
        plan, finest, spread = _plan(count, first_window), 1, np.zeros(6)
        rounds = 0
        for window, planned in tqdm(plan, desc="poses", unit="round", disable=hides_bar(progress)):
            cells = max(planned, finest)
            grid = PlaneGrid(window, rounds % 2 == 1, cells * cell_m)
            # The noise is estimated every other round: it changes slowly.
            known = None if rounds % 2 == 0 else noise
            planes, noise = common_planes(returns, poses, grid, known, config, num_threads)
            steps, inverse, inverse_below, decrement = planes.solve(
                *_prior(motions, poses, anchor), _TOLERANCE, _MOST_ITERATIONS, True, num_threads
            )
            rounds += 1
            coarser, spread = spread, np.log(step_variances(poses, inverse, inverse_below)).mean(axis=0)
            if rounds == len(plan) - _MOST_ROUNDS + 1 and (spread - coarser > _COARSER).any():
                finest = _OF_ALL[-1]
                continue
            before, poses = poses, moved(poses, steps)
            poses = aligned(poses, given) if anchor is None else poses
            motions = [motion.at(poses).learnt(poses, before, inverse, inverse_below) for motion in motions]
            if window == count and cells == finest and decrement < _SETTLED**2 * steps.size:
                break
        assert noise is not None
        evidence = [motion.evidence() for motion in motions]
        diagonal, below, gradient = _prior(evidence, poses, anchor)
        if anchor is None:
            diagonal[count // 2] += _FIXED * np.eye(6)
        covariance = planes.solve(diagonal, below, gradient, _TOLERANCE, 0, True, num_threads)[1]

        def solved(more: Floats | float) -> Floats:
            """Solve for increments (F, 6) with `more` added to the gradient."""
            right = gradient + more
            return planes.solve(diagonal, below, right, _EXACT, _MOST_ITERATIONS, False, num_threads)[0]

        return cls(poses, covariance + _by_biases(evidence, poses, solved), motions, noise, rounds)


def _plan(num_scans: int, window: int) -> list[tuple[int, int]]:
    """List windows of scans and cell edges, coarse to fine, from short windows to all scans."""
    plan = []
    while window < num_scans:
        plan += [(window, cells) for cells in _OF_WINDOWS]
        window *= 2
    return plan + [(num_scans, cells) for cells in _OF_ALL] + [(num_scans, 1)] * _MOST_ROUNDS


def _prior(motions: Sequence[Motion], poses: Floats, anchor: Anchor | None) -> tuple[Floats, Floats, Floats]:
    """Sum the normal equations of motions, see :meth:`Motion.prior`, and anchor."""
    parts = [motion.prior(poses) for motion in motions]
    diagonal, below, gradient = (np.sum(part, axis=0) for part in zip(*parts, strict=True))
    if anchor is not None:
        of_poses, of_gradient = anchor(poses)
        diagonal, gradient = diagonal + of_poses, gradient + of_gradient
    return diagonal + WEAK * np.eye(6), below, gradient


def _by_biases(
    motions: Sequence[Motion], poses: Floats, solved: Callable[[Floats | float], Floats]
) -> Floats:
    """Return the covariance (F, 6, 6) of the poses due to systematic errors of all steps, given the returns."""
    # The biases are unknowns, too: the poses are eliminated (Schur complement).
    by, own = (np.concatenate(parts) for parts in zip(*(m.by_bias(poses) for m in motions), strict=True))
    if len(by) == 0:
        return np.zeros((len(poses), 6, 6))
    moved_by = np.stack([solved(each) for each in by]) - solved(0.0)
    information = np.diag(own) + np.einsum("kfi,lfi->kl", by, moved_by)
    values, axes = np.linalg.eigh((information + information.T) / 2)
    root = np.einsum("kfi,kl->lfi", moved_by, axes / np.sqrt(1 + np.maximum(values, 0.0)))
    return np.einsum("lfi,lfj->fij", root, root)
