"""Refinement of given poses: the joint estimate of all scans, from common planes and measured motion, and its test."""

import itertools
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeAlias

import numpy as np
from tqdm import tqdm

from radarsdf.arrays import ArrayLike, Bools, Floats
from radarsdf.checks import check, hides_bar, usable_poses
from radarsdf.config.fit_config import FitConfig
from radarsdf.poses.agreement import Verdict
from radarsdf.poses.checked_scans import CheckedScans, checked_settings, join_radars
from radarsdf.poses.consistency import Consistency
from radarsdf.poses.doppler import DopplerMotion
from radarsdf.poses.loops import close_loop, open_loops, visits
from radarsdf.poses.motion import Motion, step_variances, unsteadiness
from radarsdf.poses.planes import PlaneMap, SensorReturns, common_planes, plane_cell_m
from radarsdf.poses.rigid import aligned, increments, moved, steps, turned_by
from radarsdf.returns.noise import SensorNoise
from radarsdf.returns.rays import LeftOut
from radarsdf.rig import Rig
from radarsdf.scans import Scans, filled

# Within short windows of scans, the drift is small compared with a cell. The window doubles from stage to stage.
_FIRST_WINDOW = 8
_OF_WINDOWS = (4, 2)  # cell edges for windows, relative to a map's surfels
_OF_ALL = (4, 4, 2, 2)  # cell edges for all scans
_MOST_ROUNDS = 12  # maximum number of rounds with the cells of a map's surfels
# Coarse planes are kept if fine ones double the standard deviation of a component of the steps, of few returns. By less, they do not
# lose: surfaces are less flat in coarse cells, which no variance includes.
_COARSER = np.log(4)
# Convergence threshold on increments, standard deviations. Planes change in each round: with 0.1, twice the time for the same errors.
_SETTLED = 0.3
_TOLERANCE, _MOST_ITERATIONS = 1e-2, 100  # of the conjugate gradients
# Information of a weak prior on each pose, 1/m² and 1/rad²: unobserved components are not changed.
WEAK = 1e-4
_HELD_OUT = 0.2  # share of the returns for the test
_FIXED = 1e10  # information of a pose that is fixed, such as the reference of the covariance

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


@dataclass(frozen=True)
class JointEstimator:
    """Estimates the poses of all scans jointly, from common planes and measured motions."""

    returns: SensorReturns
    motions: Sequence[Motion]
    cell_m: float
    config: FitConfig

    def estimate(
        self, given: Floats, *, far: bool = False, progress: bool | None = False, anchor: Anchor | None = None
    ) -> PosesEstimate:
        """Estimate from `given` (F, 4, 4) by the Gauss-Newton method, with new planes in each round.

        Poses that may be `far` from the truth are first estimated in short windows. Without an anchor, the mean pose is that of
        `given`, and the covariance relative to the middle scan.
        """
        poses, count, noise, motions = given, len(given), None, list(self.motions)
        limits, num_threads, finest, spread = self.config.returns, self.config.num_threads, 1, np.zeros(6)
        doubled = (_FIRST_WINDOW << k for k in itertools.count())
        short = itertools.takewhile(lambda window: far and window < count, doubled)
        of_all = *_OF_ALL, *[1] * _MOST_ROUNDS
        plan = [*itertools.product(short, _OF_WINDOWS), *itertools.product([count], of_all)]
        bar = tqdm(plan, desc="poses", unit="round", disable=hides_bar(progress))
        for rounds, (window, planned) in enumerate(bar, 1):
            cells = max(planned, finest)
            # The noise is estimated every other round: it changes slowly.
            even = rounds % 2 == 0
            grid = window, cells * self.cell_m, noise if even else None
            planes, noise = common_planes(self.returns, poses, *grid, limits, num_threads, shifted=even)
            equations = *_prior(motions, poses, anchor), _TOLERANCE, _MOST_ITERATIONS
            steps, inverse, inverse_below, decrement = planes.solve(*equations, True, num_threads)
            coarser, spread = spread, np.log(step_variances(poses, inverse, inverse_below)).mean(axis=0)
            if rounds == len(plan) - _MOST_ROUNDS + 1 and (spread - coarser > _COARSER).any():
                finest = _OF_ALL[-1]
                continue
            before, poses = poses, moved(poses, steps)
            poses = aligned(poses, given) if anchor is None else poses
            motions = [motion.updated(poses, before, inverse, inverse_below) for motion in motions]
            if window == count and cells == finest and decrement < _SETTLED**2 * steps.size:
                break
        assert noise is not None
        evidence = [motion.evidence() for motion in motions]
        prior, gradient = _prior(evidence, poses, anchor)
        if anchor is None:
            prior[count // 2, -1] += _FIXED * np.eye(6)
        covariance = planes.solve(prior, gradient, _TOLERANCE, 0, True, num_threads)[1]
        own = planes.equations[1].reshape(count, 6)

        def solve(gradient: Floats) -> Floats:
            """Solve for increments (F, 6) with this gradient (F, 6) alone."""
            others = gradient - own
            return planes.solve(prior, others, _TOLERANCE, _MOST_ITERATIONS, False, num_threads)[0]

        covariance = covariance + _by_biases(evidence, poses, solve)
        return PosesEstimate(poses, covariance, motions, noise, rounds)

    def estimate_closed(
        self, given: Floats, *, far: bool = False, progress: bool | None = False, anchor: Anchor | None = None
    ) -> PosesEstimate:
        """:meth:`estimate`, and close the loops that are beyond the reach of its planes."""
        found = self.estimate(given, far=far, progress=progress, anchor=anchor)
        for visit in visits(self.returns.median_range_m, found.poses):
            planes = PlaneMap(self.cell_m, found.noise.variances)
            prior = np.sum([found.covariance[scans].mean(axis=0) for scans in visit], axis=0)
            start = close_loop(self.returns, found.poses, visit, prior, planes, self.config.num_threads)
            if start is None:
                continue
            closed = self.estimate(start, anchor=anchor)
            if Verdict.of(*held_out(self.returns, 0), found.poses, closed.poses, closed.noise).closed:
                found = replace(closed, poses=aligned(closed.poses, given)) if anchor is None else closed
        return found


def _anchor_at(given: Floats, fixed: Bools, poses: Floats) -> tuple[Floats, Floats]:
    """Anchor at the `fixed` (F,) ones of `given` poses (F, 4, 4)."""
    information = _FIXED * fixed[:, None]
    return information[:, :, None] * np.eye(6), information * increments(given, poses)


def held_out(returns: SensorReturns, seed: int) -> tuple[SensorReturns, SensorReturns]:
    """Return the returns that are held out, and the others."""
    held = np.random.default_rng(seed).random(len(returns)) < _HELD_OUT
    return returns.select(held), returns.select(~held)


def _prior(motions: Sequence[Motion], poses: Floats, anchor: Anchor | None) -> tuple[Floats, Floats]:
    """Sum the normal equations of motions, see :meth:`Motion.prior`, and anchor."""
    bands, gradients = zip(*(motion.prior(poses) for motion in motions), strict=True)
    gradient, width = np.sum(gradients, axis=0), max(band.shape[1] for band in bands)
    total = np.sum(
        [np.pad(band, [(0, 0), (width - band.shape[1], 0), (0, 0), (0, 0)]) for band in bands], axis=0
    )
    if anchor is not None:
        of_poses, of_gradient = anchor(poses)
        total[:, -1] += of_poses
        gradient += of_gradient
    total[:, -1] += WEAK * np.eye(6)
    return total, gradient


def _by_biases(motions: Sequence[Motion], poses: Floats, solve: Callable[[Floats], Floats]) -> Floats:
    """Return the covariance (F, 6, 6) of the poses due to systematic errors of all steps, given the returns."""
    # The biases are unknowns, too: the poses are eliminated (Schur complement).
    by, own = (np.concatenate(parts) for parts in zip(*(m.by_bias(poses) for m in motions), strict=True))
    if len(by) == 0:
        return np.zeros((len(poses), 6, 6))
    moved_by = np.stack([solve(each) for each in by])
    information = np.diag(own) + np.einsum("kfi,lfi->kl", by, moved_by)
    values, axes = np.linalg.eigh((information + information.T) / 2)
    root = np.einsum("kfi,kl->lfi", moved_by, axes / np.sqrt(1 + np.maximum(values, 0.0)))
    return np.einsum("lfi,lfj->fij", root, root)


# Minimum initial standard deviations of a step, m and rad. They do not determine the result: measured, 0.1 m and 0.5 degrees
# converge to the same deviations, to 3 %, as 0.03 m and 0.2 degrees.
FIRST_SIGMAS = 0.1, 0.01


@dataclass(frozen=True)
class RefinedPoses:
    """Refined poses of scans, and whether they are better than the given ones."""

    poses: Floats
    """(F, 4, 4) T_world_sensor, of a rig T_world_body: the refined poses if they are an improvement, else the given ones. Mean position and mean
    rotation are those of the given poses, unless some are fixed."""
    covariance: Floats
    """(F, 6, 6) of `poses`, relative to the middle scan or the fixed ones: translation, m, and rotation vector about the sensor,
    rad, in world axes. Conservative for loops of more than 32 scans."""
    improved: bool
    """Whether held-out returns agree better with those of other scans, at a significance level of 0.001."""
    report: dict[str, Any]
    """`verdict` in words; `gain`, the mean increase of the log density of other scans' returns at held-out ones, and its
    `gain_error`; `sigma_m`, `sigma_rad` and `bias` of a given step; `moved_m` and `moved_rad`, root mean square change of the
    poses; `noise` of the sensor; `moving`, number of returns excluded by Doppler; `notes` on unused input and open
    loops; `scans`, `returns`, `rounds`, `seconds`."""


def refine_poses(
    points: Iterable[ArrayLike] | Scans,
    poses: ArrayLike | None = None,
    *,
    doppler_mps: Sequence[ArrayLike] | None = None,
    times_s: ArrayLike | None = None,
    fixed: ArrayLike | None = None,
    config: FitConfig | None = None,
    progress: bool | None = None,
) -> RefinedPoses:
    """Refine the poses of scans so that their returns lie on common surfaces.

    Adjusts all scans jointly: residuals are the distances of returns to common planes, which are re-estimated in each round, and
    the deviations from the given motion between scans. The noise of the sensor, the errors of the given steps and their bias
    are estimated. Scans that revisit a place close a loop, regardless of the time between them.

    Parameters
    ----------
    points : iterable of F arrays, or Scans
        (N_i, 3) each, with `doppler_mps`, `config` and `progress` as in :func:`odometry`. :class:`radarsdf.io.Scans` supply poses, too.
    poses : array_like, optional
        (F, 4, 4) T_world_sensor, m, one for each scan; of a rig, T_world_body.
    times_s : (F,) array_like, optional
        Times of the scans, s, needed with Doppler. Steps over gaps have larger errors. By default all steps are alike.
    fixed : (F,) array_like of bool, optional
        Poses to keep, relative to which the others are refined.

    Returns
    -------
    RefinedPoses
        Contains the given poses if held-out returns do not agree better. Bit-identical with any number of threads.

    Raises
    ------
    TypeError
        If an argument has the wrong type.
    ValueError
        If poses are missing, shapes do not match, all poses are fixed, ranges cannot be in m, or times descend.

    Notes
    -----
    "Improved" means that a map is sharper, not that the trajectory is more accurate: unobserved components, such as the
    position along a corridor, follow the given steps.

    Examples
    --------
    >>> import radarsdf
    >>> scans = radarsdf.simulate.wall(frames=6)
    >>> refined = radarsdf.refine_poses(scans.points, scans.poses)
    >>> refined.improved  # they were true
    False
    """
    begin = time.perf_counter()
    config = checked_settings(config)
    poses = filled(points, poses=poses)[2]
    rig, radars = CheckedScans.of_radars(points, doppler_mps, times_s)
    given, rigid = usable_poses(poses, sum(len(checked.rows) for checked in radars))
    kept = np.zeros(len(given), bool) if fixed is None else np.asarray(fixed)
    masks = kept.shape == (len(given),) and kept.dtype == bool and (fixed is None or not kept.all())
    check(masks, f"fixed must be one bool for each of {len(given)} poses, not all of them True")
    anchor = partial(_anchor_at, given, kept) if kept.any() else None
    joined = join_radars(rig, [_compare_doppler(checked, given, rig) for checked in radars])
    scans, times, velocities, notes = joined.scans, joined.times_s, joined.velocities, joined.notes
    if not rigid.all():
        notes += LeftOut(poses=np.flatnonzero(~rigid).tolist()).notes
        scans = [scan if usable else scan[:0] for scan, usable in zip(scans, rigid, strict=True)]
    returns = SensorReturns.of(scans, config.returns.min_range_m, config.returns.max_range_m, rig)
    report: dict[str, Any] = {"scans": len(scans), "returns": len(returns), "notes": notes}
    if len(scans) < 2 or len(returns) == 0:
        report["verdict"] = "The given poses are kept: there are no two scans to compare."
        return RefinedPoses(given, np.zeros((len(given), 6, 6)), False, report)
    sigma_m, sigma_rad = np.maximum(FIRST_SIGMAS, unsteadiness(given, times)).tolist()
    motions: list[Motion] = [Motion.of(given, sigma_m, sigma_rad, times)]
    if velocities is not None:
        motions.append(DopplerMotion.by(velocities, times, given))
    cell_m = plane_cell_m(scans, config.leaf_size_m)
    held, used = held_out(returns, config.seed)
    estimator = JointEstimator(used, motions, cell_m, config)
    found = estimator.estimate_closed(given, far=True, progress=progress, anchor=anchor)
    found.poses[kept] = given[kept]  # to the bit
    verdict = Verdict.of(held, used, given, found.poses, found.noise)
    still_open = open_loops(used, found.poses, found.noise)
    if not still_open and any(visits(used.median_range_m, found.poses)):
        # Scans that close a loop come closer together: that of a lap of a car park, open by 1.4 m, was kept.
        verdict = replace(verdict, crowding=0.0)
    notes += still_open if verdict.improved else open_loops(used, given, found.noise)
    sigma_m, sigma_rad = np.sqrt(found.motions[0].variances).tolist()
    report |= {
        "verdict": verdict.words,
        "gain": float(verdict.mean),
        "gain_error": float(verdict.error),
        "sigma_m": sigma_m,
        "sigma_rad": sigma_rad,
        "bias": found.motions[0].bias.tolist(),
        "moved_m": float(np.sqrt(((found.poses - given)[:, :3, 3] ** 2).sum(axis=1).mean())),
        "moved_rad": float(np.sqrt((turned_by(given, found.poses) ** 2).mean())),
        "noise": vars(found.noise.mean).copy(),
        "moving": joined.moving,
        "rounds": found.rounds,
        "seconds": time.perf_counter() - begin,
    }
    if verdict.improved:
        return RefinedPoses(found.poses, found.covariance, True, report)
    # Neither trajectory is rejected, so the errors of the given one may be as large as their difference.
    at = kept.argmax() if kept.any() else len(given) // 2
    placed = np.einsum("ij,fjk->fik", given[at] @ np.linalg.inv(found.poses[at]), found.poses)
    off = increments(given, placed)
    return RefinedPoses(given, found.covariance + np.einsum("fi,fj->fij", off, off), False, report)


def _compare_doppler(checked: CheckedScans, given: Floats, rig: Rig | None) -> CheckedScans:
    """Compare the Doppler of a radar with the given poses (F, 4, 4) of all scans."""
    if checked.velocities is None or len(checked.rows) < 2:
        return replace(checked, velocities=None)
    poses = given if rig is None else rig.sensor_poses(given)[checked.rows]
    if (checked.velocities.mean_mps[:-1] * steps(poses)[:, :3, 3]).sum() < 0:
        checked = replace(checked, velocities=checked.velocities.scaled(-1.0))
    assert checked.velocities is not None
    return Consistency.of_poses(checked.velocities, checked.times_s, poses).corrected(checked)
