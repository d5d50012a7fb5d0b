# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Poses of all scans at once, from common planes and measured motion."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from tqdm import tqdm

from radarsdf.checks import hides_bar
from radarsdf.config.groups import ReturnsConfig
from radarsdf.poses.motion import Motion
from radarsdf.poses.planes import Groups, PlaneGrid, SensorReturns, common_planes
from radarsdf.poses.rigid import Floats, aligned, moved
from radarsdf.returns.noise import SensorNoise

# Of scans in short windows, the drift is small beside a cell. So each window may be twice as long as the one before.
_FIRST_WINDOW = 8  # scans
# Longer windows only say how their parts lie to each other. With as many groups and returns as one of these, all long windows
# together take no longer than two rounds of all scans, whatever the length of the drive.
_LONGEST_WINDOW = 64  # scans that each move on their own
_OF_WINDOWS = (4, 2)  # edges of cells, in those of a map's surfels
_OF_ALL = (4, 4, 2, 2)  # likewise, once all scans are together
_MOST_ROUNDS = 12  # with cells as small as a map's surfels
# Standard deviations that poses still move by. Planes are drawn anew in each round, so that 0.1 is often never reached; 0.3
# ends with the same errors in half the time.
_SETTLED = 0.3
_TOLERANCE, _MOST_ITERATIONS = 1e-2, 100  # of the conjugate gradients
_EXACT = 1e-3  # likewise, where differences of solutions count
_WEAK = (
    1e-4  # information about each pose, 1/m² and 1/rad²: what returns and steps leave free stays where it is
)
_FIXED = 1e10  # likewise, about the pose that the covariance is relative to


@dataclass(frozen=True)
class PosesEstimate:
    """Poses, and what was found with them."""

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
        """From `given` (F, 4, 4) and what was measured, by Gauss and Newton's method, with planes drawn anew in each round."""
        poses, noise, rounds, motions = given, None, 0, list(motions)
        plan = list(plan_of(len(given), cell_m, first_window))
        for grid in tqdm(plan, desc="poses", unit="round", disable=hides_bar(progress)):
            # The noise is estimated every other round: with the poses, it changes slowly.
            planes, noise = common_planes(
                returns, poses, grid, None if rounds % 2 == 0 else noise, config, num_threads
            )
            groups = Groups(len(given), grid.together)
            diagonal, below, gradient = groups.prior(_prior(motions, poses), poses)
            increments, inverse, inverse_below, decrement = planes.solve(
                diagonal, below, gradient, _TOLERANCE, _MOST_ITERATIONS, True, num_threads
            )
            before, poses = poses, aligned(moved(poses, groups.increments(increments, poses)), given)
            motions = [motion.at(poses) for motion in motions]
            if groups.size == 1:  # or the covariances of steps are not known
                motions = [motion.learnt(poses, before, inverse, inverse_below) for motion in motions]
            rounds += 1
            finest = grid.window == len(given) and grid.cell_m == cell_m
            if finest and decrement < _SETTLED**2 * increments.size:
                break
        assert noise is not None
        evidence = [motion.as_evidence() for motion in motions]
        diagonal, below, gradient = _prior(evidence, poses)
        diagonal[len(given) // 2] += _FIXED * np.eye(6)
        covariance = planes.solve(diagonal, below, gradient, _TOLERANCE, 0, True, num_threads)[1]

        def solved(more: Floats | float) -> Floats:
            return planes.solve(
                diagonal, below, gradient + more, _EXACT, _MOST_ITERATIONS, False, num_threads
            )[0]

        return cls(poses, covariance + _by_biases(evidence, poses, solved), motions, noise, rounds)


def _by_biases(
    motions: Sequence[Motion], poses: Floats, solved: Callable[[Floats | float], Floats]
) -> Floats:
    """(F, 6, 6) covariance of the poses that errors make which all steps have in common, as far as returns leave them open.

    `solved` are the increments (F, 6) once something is added to the gradient. The biases are unknowns, too, which the poses
    are eliminated from (the Schur complement).
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


def _prior(motions: Sequence[Motion], poses: Floats) -> tuple[Floats, Floats, Floats]:
    """What all that was measured says together, as :meth:`Motion.prior`."""
    diagonal, below, gradient = (
        np.sum(parts, axis=0) for parts in zip(*(motion.prior(poses) for motion in motions), strict=True)
    )
    return diagonal + _WEAK * np.eye(6), below, gradient


def plan_of(num_scans: int, cell_m: float, window: int) -> Iterator[PlaneGrid]:
    """Coarse to fine, and from short windows to all scans."""
    plan = []
    while window < num_scans:
        plan += [(window, cells) for cells in _OF_WINDOWS]
        window *= 2
    plan += [(num_scans, cells) for cells in _OF_ALL] + [(num_scans, 1)] * _MOST_ROUNDS
    for i, (window, cells) in enumerate(plan):
        together = max(1, window // _LONGEST_WINDOW) if window < num_scans else 1
        yield PlaneGrid(window, i % 2 == 1, cells * cell_m, together)
