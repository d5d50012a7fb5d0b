# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Poses that make returns of different scans agree."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from radarsdf.checks import check_poses, instance, not_negative, real_array
from radarsdf.config.fit_config import FitConfig
from radarsdf.config.groups import ReturnsConfig
from radarsdf.io.scans import Scans
from radarsdf.poses.motion import Motion
from radarsdf.poses.planes import Grid, SensorReturns, common_planes
from radarsdf.poses.rigid import Floats, aligned, moved, turned_by
from radarsdf.poses.verdict import Verdict
from radarsdf.returns.noise import SensorNoise
from radarsdf.returns.rays import check_scans
from radarsdf.returns.surfels import LEAVES_PER_SURFEL
from radarsdf.threads import Workers

# The errors of a step that the estimate begins with. It ends where the returns lead: measured, 0.1 m and 0.5 degrees end
# with the same deviations, to 3 %, as 0.03 m and 0.2 degrees.
_FIRST_SIGMA_M, _FIRST_SIGMA_RAD = 0.1, 0.01
# Of scans in short windows, the drift is small beside a cell. So each window may be twice as long as the one before.
_FIRST_WINDOW = 8  # scans
_OF_WINDOWS = (4, 2)  # edges of cells, in those of a map's surfels
_OF_ALL = (4, 4, 2, 2)  # likewise, once all scans are together
_MOST_ROUNDS = 12  # with cells as small as a map's surfels
# Standard deviations that poses still move by. Planes are drawn anew in each round, so that 0.1 is often never reached; 0.3
# ends with the same errors in half the time.
_SETTLED = 0.3
_TOLERANCE, _MOST_ITERATIONS = 1e-2, 100  # of the conjugate gradients
_WEAK = (
    1e-4  # information about each pose, 1/m² and 1/rad²: what returns and steps leave free stays where it is
)
_FIXED = 1e10  # likewise, about the pose that the covariance is relative to
_HELD_OUT = 0.2  # of the returns


@dataclass(frozen=True)
class RefinedPoses:
    """Poses that returns of different scans agree on, and whether they are better than the given ones."""

    poses: Floats
    """(F, 4, 4) T_world_sensor: the refined poses if they are an improvement, else the given ones. As a whole, they are
    neither moved nor turned: mean position and mean rotation are those of the given poses."""
    covariance: Floats
    """(F, 6, 6) of the refined poses, relative to that of the scan in the middle: translation, m, and rotation vector about
    the sensor, rad, in world axes. Loops over more than 32 scans are left out, so it is rather too large there."""
    improved: bool
    """Whether returns that took no part are nearer to those of other scans, by more than three standard errors."""
    report: dict[str, Any]
    """`verdict` in words; `gain`, by which the logarithm of that distance fell, and its `gain_error`; `sigma_m` and
    `sigma_rad` of a given step and its `bias`; how far the poses moved, `moved_m` and `moved_rad`, root mean square; `noise`
    of the sensor; `scans`, `returns`, `rounds`, `seconds`."""


def refine_poses(
    points: Iterable[ArrayLike] | Scans,
    poses: ArrayLike | None = None,
    *,
    times: ArrayLike | None = None,
    sigma_m: float | None = None,
    sigma_rad: float | None = None,
    config: FitConfig | None = None,
) -> RefinedPoses:
    """Refines the poses of scans, so that their returns lie on common surfaces.

    All scans at once: a return's distance from a plane that scans have in common is a residual, in which the planes are
    unknown, too; the given motions from scan to scan are others. The noise of the sensor, the errors of the given steps and
    their bias are found from the data. Scans that see the same place again close a loop, whatever the time between them.

    Parameters
    ----------
    points : iterable of F arrays, or Scans
        (N_i, 3) each: the returns of one scan, sensor frame, m. Of :class:`radarsdf.io.Scans`, poses and times are used
        where none are given here.
    poses : array_like, optional
        (F, 4, 4) T_world_sensor, m, one for each scan.
    times : (F,) array_like, optional
        Of the scans, s. After a gap, a step has larger errors. By default all steps are alike.
    sigma_m, sigma_rad : float, optional
        Standard deviations of each component of a step's translation, m, and rotation, rad. By default found from the data.
    config : FitConfig, optional
        Its ranges, noise, leaf cells and threads are used.

    Returns
    -------
    RefinedPoses
        With the given poses where returns that took no part do not agree better. The same bits with any number of threads.

    Raises
    ------
    ValueError
        If scans or poses are invalid (see :func:`radarsdf.returns.rays.prepare`), or times descend.

    Notes
    -----
    "Improved" says that a map is sharper. It does not say that the trajectory is nearer to the truth: what returns do not
    tell, along a corridor say, stays as the given steps have it.

    Examples
    --------
    >>> import radarsdf
    >>> scans = radarsdf.simulate.wall(frames=6)
    >>> refined = radarsdf.refine_poses(scans.points, scans.poses)
    >>> refined.improved  # they were true
    False
    """
    begin = time.perf_counter()
    config = FitConfig() if config is None else instance(config, FitConfig, "config")
    if isinstance(points, Scans):
        scans_, points = points, points.points  # first: it reads all there is, in one pass
        poses = scans_.poses if poses is None else poses
        times = scans_.times_s if times is None else times
    if poses is None:
        msg = "poses are missing: T_world_sensor (4, 4) of each scan"
        raise ValueError(msg)
    scans, _ = check_scans(points)
    given = check_poses(poses, len(scans))
    times_s = None if times is None else _checked_times(times, len(scans))
    known = sigma_m is not None, sigma_rad is not None
    sigma_m = _FIRST_SIGMA_M if sigma_m is None else not_negative(sigma_m, "sigma_m")
    sigma_rad = _FIRST_SIGMA_RAD if sigma_rad is None else not_negative(sigma_rad, "sigma_rad")
    limits = config.returns
    returns = SensorReturns.of(scans, limits.min_range_m, limits.max_range_m)
    with Workers(config.num_threads) as workers:
        if len(scans) < 2 or len(returns) == 0:
            return _kept(given, len(returns), "there are no two scans to compare", begin)
        held = np.random.default_rng(config.seed).random(len(returns)) < _HELD_OUT
        motion = Motion.of(given, sigma_m, sigma_rad, times_s)
        cell_m = LEAVES_PER_SURFEL * config.leaf_size_m
        found = _Estimate.of(returns.select(~held), given, motion, known, cell_m, limits, workers.num_threads)
        verdict = Verdict.of(returns.select(held), returns.select(~held), given, found.poses)
    report = {
        "verdict": verdict.words,
        "gain": verdict.gain,
        "gain_error": verdict.error,
        "sigma_m": found.motion.sigma_m,
        "sigma_rad": found.motion.sigma_rad,
        "bias": found.motion.bias.tolist(),
        "moved_m": float(np.sqrt(((found.poses - given)[:, :3, 3] ** 2).sum(axis=1).mean())),
        "moved_rad": float(np.sqrt((turned_by(given, found.poses) ** 2).mean())),
        "noise": vars(found.noise).copy(),
        "scans": len(scans),
        "returns": len(returns),
        "rounds": found.rounds,
        "seconds": time.perf_counter() - begin,
    }
    return RefinedPoses(
        found.poses if verdict.improved else given, found.covariance, verdict.improved, report
    )


def _checked_times(times: ArrayLike, num_scans: int) -> Floats:
    times_s: Floats = real_array(times, "times")
    if times_s.shape != (num_scans,):
        msg = f"times must be one for each of {num_scans} scans, not {times_s.shape}"
        raise ValueError(msg)
    if not np.isfinite(times_s).all() or (np.diff(times_s) < 0).any():
        msg = "times must be finite, and ascend from scan to scan"
        raise ValueError(msg)
    return times_s


def _kept(given: Floats, returns: int, why: str, begin: float) -> RefinedPoses:
    report = {"verdict": f"The given poses are kept: {why}.", "scans": len(given), "returns": returns}
    return RefinedPoses(
        given,
        np.zeros((len(given), 6, 6)),
        False,
        report | {"rounds": 0, "seconds": time.perf_counter() - begin},
    )


@dataclass(frozen=True)
class _Estimate:
    """Poses, and what was found with them."""

    poses: Floats
    covariance: Floats
    motion: Motion
    noise: SensorNoise
    rounds: int

    @classmethod
    def of(
        cls,
        returns: SensorReturns,
        given: Floats,
        motion: Motion,
        known: tuple[bool, bool],
        cell_m: float,
        config: ReturnsConfig,
        num_threads: int,
    ) -> _Estimate:
        """Gauss and Newton's method, with planes drawn anew in each round."""
        poses, noise, rounds = given, None, 0
        for grid in _grids(len(given), cell_m):
            # The noise is estimated every other round: with the poses, it changes slowly.
            planes, noise = common_planes(
                returns, poses, grid, None if rounds % 2 == 0 else noise, config, num_threads
            )
            diagonal, below, gradient = motion.prior(poses)
            diagonal += _WEAK * np.eye(6)
            increments, inverse, inverse_below, decrement = planes.solve(
                diagonal, below, gradient, _TOLERANCE, _MOST_ITERATIONS, True, num_threads
            )
            poses = aligned(moved(poses, increments), given)
            motion = motion.learnt(poses, inverse, inverse_below, known)
            rounds += 1
            finest = grid.window == len(given) and grid.cell_m == cell_m
            if finest and decrement < _SETTLED**2 * increments.size:
                break
        assert noise is not None
        diagonal, below, gradient = motion.prior(poses)
        diagonal[len(given) // 2] += _FIXED * np.eye(6)
        covariance = planes.solve(diagonal, below, gradient, _TOLERANCE, 0, True, num_threads)[1]
        return cls(poses, covariance, motion, noise, rounds)


def _grids(num_scans: int, cell_m: float) -> Iterator[Grid]:
    """Coarse to fine, and from short windows to all scans."""
    plan, window = [], _FIRST_WINDOW
    while window < num_scans:
        plan += [(window, cells) for cells in _OF_WINDOWS]
        window *= 2
    plan += [(num_scans, cells) for cells in _OF_ALL] + [(num_scans, 1)] * _MOST_ROUNDS
    for i, (window, cells) in enumerate(plan):
        yield Grid(window, i % 2 == 1, cells * cell_m)
