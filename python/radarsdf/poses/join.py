"""Joining of several sessions at one place in one frame (multi-session mapping)."""

import itertools
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from radarsdf.arrays import Floats, Ints
from radarsdf.checks import check, instance
from radarsdf.config.fit_config import FitConfig
from radarsdf.poses.agreement import Verdict
from radarsdf.poses.checked_scans import CheckedScans, checked_settings, join_radars
from radarsdf.poses.motion import Motion, unsteadiness
from radarsdf.poses.odometry import odometry
from radarsdf.poses.planes import SensorReturns, plane_cell_m
from radarsdf.poses.refine import FIRST_SIGMAS, JointEstimator, held_out
from radarsdf.poses.rigid import aligned
from radarsdf.poses.search import Lost, OrientedPoints, SurfaceIndex, search_scans
from radarsdf.rig import Rig
from radarsdf.scans import Scans

JOINED, APART, AMBIGUOUS = "joined", "apart", "ambiguous"
# Agreement with surfaces of another session, at the best place, from which several places are alike; below, none is the same.
_ALIKE = 0.5
_RIGID_VARIANCES = np.square([1e-4, 1e-5])  # of a step, m² and rad²: less than returns observe


@dataclass(frozen=True)
class Joined:
    """Sessions in one frame."""

    poses: list[Floats]
    """(F_i, 4, 4) each, T_world_sensor, m, in the world of the first session. NaN for scans that were not joined."""
    verdicts: dict[tuple[int, int], str]
    """Of each pair of sessions, by their numbers: `joined`, found in each other directly; `apart`, of different places, or
    hardly overlapping; or `ambiguous`, where several places fit alike."""
    report: dict[str, Any]
    """`verdict` in words, `joined`, numbers of the sessions in the frame of the first one, and `seconds`."""


def join(sessions: Sequence[Scans], *, config: FitConfig | None = None) -> Joined:
    """Find the poses of several sessions at one place in one frame, to fit or compare them.

    Sessions without poses are first placed by :func:`odometry`. Submaps of each session are searched in the surfaces of each
    other one, as in :func:`locate`, and the scans of all sessions that belong together are refined jointly.

    Parameters
    ----------
    sessions : sequence of Scans
        Each with poses, or with what :func:`odometry` needs. Only the longest segment of its drive is joined.
    config : FitConfig, optional
        Settings, of which ranges, leaf cells and threads are used.

    Returns
    -------
    Joined
        Poses in the world of the first session.

    Raises
    ------
    TypeError, ValueError
        As :func:`odometry`, and for fewer than two sessions.
    """
    begin = time.perf_counter()
    config = checked_settings(config)
    check(len(sessions) > 1, f"sessions must be at least two, not {len(sessions)}")
    placed = [_Session.of(session, config) for session in sessions]
    verdicts: dict[tuple[int, int], str] = {}
    transforms: dict[int, Floats] = {0: np.eye(4)}
    found: dict[tuple[int, int], Floats] = {}
    indices = [one.index(config) for one in placed]
    for i, k in itertools.combinations(range(len(placed)), 2):
        try:
            T, _ = search_scans(indices[i], placed[k].returns, placed[k].poses, config.num_threads)
            found[i, k], found[k, i] = T, np.linalg.inv(T).astype(np.float64)
            verdicts[i, k] = JOINED
        except Lost as lost:
            verdicts[i, k] = AMBIGUOUS if lost.agreeing > _ALIKE else APART
    while new := [(i, k) for i, k in found if i in transforms and k not in transforms]:
        i, k = new[0]
        transforms[k] = transforms[i] @ found[i, k]
    together = sorted(transforms)
    poses = [np.full((len(session), 4, 4), np.nan) for session in sessions]
    for k, refined in zip(transforms, _refine(placed, transforms, config), strict=True):
        poses[k][placed[k].rows] = refined
    words = [f"{len(together)} of {len(sessions)} sessions are in one frame."]
    words += [f"Sessions {i} and {k} are {of}." for (i, k), of in verdicts.items() if of != JOINED]
    report = {"verdict": " ".join(words), "joined": together, "seconds": time.perf_counter() - begin}
    return Joined(poses, verdicts, report)


@dataclass(frozen=True)
class _Session:
    rows: Ints  # (K,) scans with poses
    scans: list[Floats]  # (N_i, 3) static returns of these, frame of the poses, m
    returns: SensorReturns
    mountings: Floats  # (K, 4, 4) T_body_sensor, m; the identity without a rig
    poses: Floats  # (K, 4, 4) in the world of the session

    @classmethod
    def of(cls, session: Scans, config: FitConfig) -> "_Session":
        instance(session, Scans, "a session")
        rig, radars = CheckedScans.of_radars(session, None, None)
        scans = join_radars(rig, [replace(checked, velocities=None) for checked in radars]).scans
        poses, rows = session.poses, np.arange(len(session))
        if not np.isfinite(poses).all():
            motion = odometry(session, config=config, progress=False)
            poses, rows = motion.poses, rows[motion.longest_segment()]
        limits, own = config.returns, [scans[i] for i in rows]
        own_rig = None if rig is None else rig.select(rows)
        returns = SensorReturns.of(own, limits.min_range_m, limits.max_range_m, own_rig)
        mountings = np.tile(np.eye(4), (len(own), 1, 1)) if own_rig is None else own_rig.mountings
        return cls(rows, own, returns, mountings, poses[rows])

    def index(self, config: FitConfig) -> SurfaceIndex:
        leaf_m, origin = config.leaf_size_m, self.poses[:, :3, 3].mean(axis=0)
        surface = OrientedPoints.of_returns(self.returns, self.poses, leaf_m, config.num_threads)
        return SurfaceIndex.of_surface(surface, origin, leaf_m)


class _RigidMotion(Motion):
    def updated(self, *_: Floats) -> Motion:
        return self


def _refine(placed: Sequence[_Session], transforms: dict[int, Floats], config: FitConfig) -> list[Floats]:
    """Refine the poses of the sessions jointly, in the world of the first: as rigid bodies unless held-out returns show that they bend."""
    poses = [np.einsum("ij,fjk->fik", T, placed[k].poses) for k, T in transforms.items()]
    sessions, before = [placed[k] for k in transforms], np.concatenate(poses)
    if len(sessions) == 1:
        return poses
    begins, scans = np.cumsum([0, *map(len, poses)]), [scan for one in sessions for scan in one.scans]
    cell_m = plane_cell_m(scans, config.leaf_size_m)
    radars, row = np.unique(np.concatenate([one.mountings for one in sessions]), axis=0, return_inverse=True)
    rig = Rig(tuple(range(len(radars))), row.ravel().astype(np.int32), radars)
    returns = SensorReturns.of(scans, config.returns.min_range_m, config.returns.max_range_m, rig)
    at_s = np.arange(len(before), dtype=np.float64)  # as if they were evenly spaced
    own = [unsteadiness(one, at_s[: len(one)]) for one in poses]
    sigma_m, sigma_rad = np.max([FIRST_SIGMAS, *own], axis=0).tolist()
    bending = Motion.of(before, sigma_m, sigma_rad, at_s)
    bending.shares[begins[1:-1] - 1] = np.inf  # from one session to the next
    rigid = _RigidMotion(bending.steps, bending.shares, bending.spans, variances=_RIGID_VARIANCES)
    found = JointEstimator(returns, [rigid], cell_m, config).estimate(before).poses
    # Its own motion measured a session, too: freely bent, sessions of true poses and of Doppler lost up to 5 points of the F-score.
    held, used = held_out(returns, config.seed)
    bent = JointEstimator(used, [bending], cell_m, config).estimate(found)
    if Verdict.of(held, used, found, bent.poses, bent.noise).closed:
        found = bent.poses
    whole = aligned(found[: begins[1]], poses[0])[0] @ np.linalg.inv(found[0])
    return np.split(np.einsum("ij,fjk->fik", whole, found), begins[1:-1])
