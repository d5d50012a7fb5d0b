# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Which poses of a bag are those of the scans: of odometry, stamped poses, a path, or the transforms (TF).

A topic that a user names counts. Otherwise each topic with poses, and TF, is a candidate; :func:`_choose` says why some
are passed over, and an error asks the user where several are left.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from radarsdf.io.bags.files import topics_of, topics_with
from radarsdf.io.bags.messages import POSE_TYPES, TRANSFORM_TYPES
from radarsdf.io.bags.tf import Track, TransformTree, tracks_and_transforms
from radarsdf.io.poses.files import FIND_POSES
from radarsdf.io.poses.trajectory import NoPoses, ScanPoses, StampedPoses, Trajectory, TransformChain
from radarsdf.io.recordings import FindPoses, Request
from radarsdf.io.scans import Notes

_NOT_MEASURED = re.compile(
    r"goal|set_?point|way_?point|initial_?pose|desired|(^|[/_.-])(plans?|planned|planner|target|cmd)(?![a-z])",
    re.IGNORECASE,
)
"""In the names of topics with poses that somebody wants or assumes: no sensor was there."""
_TF = "TF"
_SAMPLES = 200  # scans whose times are compared with poses
_SAME_LENGTH, _SAME_LENGTH_M = 0.3, 1.0  # of the paths of one vehicle: its parts swing, and poses are noisy
_NEARLY_ALL = 0.9  # of what the best covers
_SLOW_S, _SLOWER = 0.2, 3.0  # interval of poses that correct others, and its ratio to that of the others


def poses_in_bags(
    paths: list[Path],
    request: Request,
    frames: list[str],
    preferred: str | None,
    scan_times_s: Callable[[], NDArray[np.float64]],
) -> FindPoses:
    """Poses of each frame of scans, by time; `frames` are those of the first scans, the most frequent first.

    The topic `preferred` is taken before others; `scan_times_s` is called only for a choice among several.
    """
    notes, wanted = request.notes, request.pose_topic
    topics = topics_of(paths)
    transforms = set(topics_with(TRANSFORM_TYPES, topics))
    fitting = topics_with(POSE_TYPES, topics)
    wants_tf = wanted in transforms or (wanted is not None and wanted.strip("/") == "tf" and bool(transforms))
    if wanted is not None and not wants_tf and wanted not in fitting:
        listed = ", ".join(sorted([*fitting, *transforms]))
        msg = f"{paths[0]} has no poses in {wanted}: topics with poses are {listed or 'none'}"
        raise ValueError(msg)
    passed_over = {n: "a goal, a plan or the like, by its name" for n in fitting if _NOT_MEASURED.search(n)}
    names = set(fitting) - set(passed_over) if wanted is None else {wanted} & set(fitting)
    tracks, tree = tracks_and_transforms(paths, names, transforms, request)
    sensor = next((frame for frame in frames if frame in tree), frames[0])
    name = wanted
    if wanted is None:
        name = _choose(tracks, tree, sensor, passed_over, preferred, scan_times_s, request)
        for other, why in sorted(passed_over.items()):
            notes.add(f"poses of {other} are passed over ({why}); pose_topic chooses them")
    if wants_tf or name is None:
        return _of_tree(tree, sensor, request, notes)
    if name not in tracks:
        msg = f"{paths[0]}: {name} holds no poses"
        raise ValueError(msg)
    trajectory = tracks[name].trajectory(name, request, notes)
    notes.add(f"poses: {len(trajectory.times_s)} of {name}")
    base = sensor if request.extrinsic is not None else _base(tracks[name], name, tree, sensor, notes)
    return attached(trajectory, base, lambda: tree, request)


def attached(
    poses: StampedPoses, base: str, tree: Callable[[], TransformTree], request: Request
) -> FindPoses:
    """Poses of the frames that do not move against `base`, whose poses are known, but for the extrinsic of the user."""
    extrinsic = np.eye(4) if request.extrinsic is None else request.extrinsic

    @cache
    def find(frame: str) -> ScanPoses | None:
        T_base_sensor = np.eye(4) if frame == base else tree().fixed(base, frame)
        if T_base_sensor is None:
            return None
        return ScanPoses(poses, extrinsic @ T_base_sensor, request.max_gap_s)

    return find


# The choice of a topic.


@dataclass(frozen=True, eq=False)
class _Candidate:
    """What may be the poses of the sensor."""

    agrees: bool
    """Whether its frames are connected with that of the scans."""
    names_child: bool
    """Whether it names the frame whose poses it has."""
    poses: StampedPoses
    interval_s: float


def _choose(
    tracks: dict[str, Track],
    tree: TransformTree,
    sensor: str,
    passed_over: dict[str, str],
    preferred: str | None,
    scan_times_s: Callable[[], NDArray[np.float64]],
    request: Request,
) -> str | None:
    """The topic of the poses; None means TF. Adds to `passed_over` why others are."""
    about = request.notes.about
    candidates: dict[str, _Candidate] = {}
    for name, track in tracks.items():
        try:
            trajectory = track.trajectory(name, request)
        except ValueError as error:
            passed_over[name] = str(error)
            continue
        # In a frame that moves with the sensor are poses of other things.
        agrees = not track.parent or tree.fixed(track.parent, sensor) is None
        if track.child and sensor in tree:
            agrees = agrees and tree.fixed(track.child, sensor) is not None
        candidates[name] = _Candidate(agrees, bool(track.child), trajectory, _interval_s(trajectory))
    try:
        of_tree = _of_tree(tree, sensor, request)(sensor) if tree.edges else None
        if of_tree is not None and isinstance(of_tree.poses, TransformChain):
            interval_s = max(map(_interval_s, of_tree.poses.moving()))
            candidates[_TF] = _Candidate(True, True, of_tree.poses, interval_s)
    except ValueError as error:
        if not candidates:
            msg = f"{error}{_listed(passed_over)}"
            raise type(error)(msg) from error
    if not candidates:
        msg = f"{about} has no poses (Odometry, PoseStamped, Path or TF): give a file of poses, such as TUM; {FIND_POSES}{_listed(passed_over)}"
        raise NoPoses(msg)
    if len(candidates) > 1:
        passed_over |= _unfit(candidates, scan_times_s(), request.max_gap_s)
    left = sorted(set(candidates) - set(passed_over) - {_TF})
    if preferred in left:
        return preferred
    if len(left) > 1:
        msg = (
            f"{about} has several topics with poses: say by pose_topic which one counts, of {', '.join(left)}"
        )
        raise ValueError(msg)
    return left[0] if left else None


def _unfit(
    candidates: dict[str, _Candidate], times_s: NDArray[np.float64], max_gap_s: float
) -> dict[str, str]:
    """Why some of the candidates do not count, by topic: by the frames, the times and the rate of the others."""
    some = times_s[:: max(1, len(times_s) // _SAMPLES)].tolist()
    positions_m = {name: _positions_m(c.poses, some, max_gap_s) for name, c in candidates.items()}
    covered = {name: float(np.isfinite(xyz[:, 0]).mean()) for name, xyz in positions_m.items()}
    half = max(covered.values()) / 2
    connected = any(c.agrees and covered[name] > half for name, c in candidates.items())
    unfit: dict[str, str] = {}
    for name, c in candidates.items():
        if connected and not c.agrees:
            unfit[name] = "its frames do not lead to that of the scans"
        elif not c.names_child and _TF in candidates:
            both = np.isfinite(positions_m[name] + positions_m[_TF]).all(axis=1)
            own_m, of_tree_m = (_length_m(positions_m[n][both]) for n in (name, _TF))
            if abs(own_m - of_tree_m) > _SAME_LENGTH_M + _SAME_LENGTH * max(own_m, of_tree_m):
                unfit[name] = f"it moved {own_m:.1f} m, the sensor {of_tree_m:.1f} m by TF"
    enough = _NEARLY_ALL * max(share for name, share in covered.items() if name not in unfit)
    for name, share in covered.items():
        if share < enough:
            unfit[name] = f"it covers {share:.0%} of the scans"
    fastest_s = min(c.interval_s for name, c in candidates.items() if name not in unfit)
    for name, c in candidates.items():
        if c.interval_s > max(_SLOW_S, _SLOWER * fastest_s):
            unfit.setdefault(name, f"a pose every {c.interval_s:.2g} s, of others every {fastest_s:.2g} s")
    return unfit


def _listed(passed_over: dict[str, str]) -> str:
    return "".join(f"; {name} is passed over ({why})" for name, why in sorted(passed_over.items()))


def _interval_s(trajectory: Trajectory) -> float:
    return float(np.median(np.diff(trajectory.times_s)))


def _positions_m(poses: StampedPoses, times_s: list[float], max_gap_s: float) -> NDArray[np.float64]:
    """(N, 3) world frame; NaN where there are none."""
    found = (poses.pose_at(time_s, max_gap_s) for time_s in times_s)
    return np.array([np.full(3, np.nan) if pose is None else pose[:3, 3] for pose in found])


def _length_m(positions_m: NDArray[np.float64]) -> float:
    return float(np.linalg.norm(np.diff(positions_m, axis=0), axis=1).sum())


def _base(track: Track, name: str, tree: TransformTree, sensor: str, notes: Notes) -> str:
    """The frame whose poses a topic has. Where it names none, it is by convention that which moves with the sensor."""
    base = track.child
    if not base and sensor in tree:
        chain = tree.chain(sensor)
        rigid = [tree.edges[f].constant and tree.edges[f].parent != track.parent for f in chain[:-1]]
        base = chain[rigid.index(False) if False in rigid else len(rigid)]
        if base != sensor:
            notes.add(f"{name} names no child frame: its poses are taken as those of {base}")
    if track.child and track.child == sensor:
        return sensor
    if base and base != sensor and tree.fixed(base, sensor) is not None:
        notes.add(f"extrinsic: of the static transforms, {base} -> {sensor}")
        return base
    notes.add(
        f"no extrinsic is known between the frame of {name}, {base or '(unnamed)'}, and that of the scans, "
        f"{sensor or '(unnamed)'}: the poses are taken as those of the radar; give extrinsic if they are not"
    )
    return sensor


# Poses of TF.


def _of_tree(tree: TransformTree, sensor: str, request: Request, notes: Notes | None = None) -> FindPoses:
    """Poses of the frames below the world. Raises a ValueError where TF has none of the sensor."""
    about = request.notes.about
    base = sensor
    if request.extrinsic is not None or sensor not in tree:
        lowest = tree.lowest_moving()
        if request.extrinsic is None or len(lowest) != 1:
            msg = (
                f"{about}: the transforms do not lead to the frame of the scans, {sensor or '(unnamed)'}: they have "
                f"{', '.join(sorted(tree.edges)) or 'no frames'}; give extrinsic, the pose of the radar in the frame that moves"
            )
            raise (ValueError if tree.moving() else NoPoses)(msg)
        (base,) = lowest
    chain = tree.chain(base)
    world = _world(tree, chain, request)
    if notes is not None and request.world_frame is None and world in tree:
        notes.add(f"TF above {world} is passed over: it changes rarely; world_frame chooses another world")
    if world not in chain:
        msg = f"world_frame {world} is not above {base}, whose frames are {' -> '.join(chain)}"
        raise ValueError(msg)
    if all(tree.edges[frame].constant for frame in chain[: chain.index(world)]):
        msg = f"{about}: no transform between {world} and {base} moves: TF has no poses of the radar"
        raise NoPoses(msg)
    poses = _poses_below(tree, world, base, request, notes)
    assert poses is not None
    if request.extrinsic is not None:
        return attached(poses, sensor, lambda: tree, request)

    @cache
    def find(frame: str) -> ScanPoses | None:
        try:
            found = poses if frame == base else _poses_below(tree, world, frame, request, notes)
        except ValueError:  # no poses, or a circle of frames
            return None
        return None if found is None else ScanPoses(found, np.eye(4), request.max_gap_s)

    return find


def _poses_below(
    tree: TransformTree, world: str, frame: str, request: Request, notes: Notes | None
) -> TransformChain | None:
    """T_world_frame by time; None where the frame is not below the world."""
    chain = tree.chain(frame)
    if world not in chain[1:]:
        return None
    chain = chain[: chain.index(world) + 1]
    links = []
    for child in reversed(chain[:-1]):
        track = tree.edges[child]
        name = f"TF from {track.parent} to {child}"
        links.append(track.matrix if track.constant else track.trajectory(name, request, notes))
    if notes is not None:
        notes.add(f"poses: TF, {' -> '.join(reversed(chain))}")
    return TransformChain(tuple(links))


def _world(tree: TransformTree, chain: list[str], request: Request) -> str:
    """The wanted one, or the root; but the frame below it where that is corrected rarely, and its own poses are dense."""
    if request.world_frame is not None:
        return request.world_frame.lstrip("/")
    moving = [frame for frame in chain[:-1] if not tree.edges[frame].constant]
    intervals_s = [_interval_s(tree.edges[frame].trajectory(frame, request)) for frame in moving]
    if len(moving) > 1 and intervals_s[-1] > max(_SLOW_S, _SLOWER * min(intervals_s)):
        return moving[-1]
    return chain[-1]
