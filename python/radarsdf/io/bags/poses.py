# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Poses in bags: of odometry, stamped poses, a path, or the tree of transforms (TF)."""

from __future__ import annotations

import re
from array import array
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache, cached_property, reduce
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from radarsdf.io.bags.files import by_record, read_messages, topics_of, topics_with
from radarsdf.io.bags.messages import PATH, POSE_TYPES, TRANSFORM_TYPES, PoseMessage
from radarsdf.io.poses.reading import (
    FIND_POSES,
    NoPoses,
    ScanPoses,
    StampedPoses,
    TransformChain,
)
from radarsdf.io.poses.trajectory import Trajectory, are_poses, pose_matrices_of, trajectory_of
from radarsdf.io.scans import Notes
from radarsdf.io.sources import Request

FindPoses = Callable[[str], ScanPoses | None]
"""The poses of a frame of scans; None: none are known."""

_STATIC = "static"  # in the name of a topic whose transforms hold for all times: /tf_static
_SAME = 1e-9  # a transform that changes by no more is constant, though it is published again and again
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


@dataclass
class _Track:
    """The poses of one frame in another, as they come."""

    parent: str
    child: str = ""
    static: bool = False
    numbers: array[float] = field(default_factory=lambda: array("d"))
    """Of each pose: stamp, record time, x, y, z, qx, qy, qz, qw."""

    def add(self, pose: PoseMessage, recorded_s: float) -> None:
        self.numbers.extend((pose.header.stamp_s, recorded_s, *pose.values))

    @cached_property
    def table(self) -> NDArray[np.float64]:
        """(P, 9) all poses."""
        return np.array(self.numbers).reshape(-1, 9)

    @cached_property
    def usable(self) -> NDArray[np.bool_]:
        """Mask (P,) of those that are poses."""
        return are_poses(self.table[:, 2:])

    @cached_property
    def constant(self) -> bool:
        poses = self.table[self.usable, 2:]
        return self.static or bool((np.abs(poses - poses[0]) <= _SAME).all())

    @cached_property
    def matrix(self) -> NDArray[np.float64]:
        """(4, 4) of a constant transform."""
        matrix: NDArray[np.float64] = pose_matrices_of(self.table[self.usable, 2:][-1:])[0]
        return matrix

    def extent(self, max_gap_s: float) -> tuple[float, int]:
        """The time in which there are poses, to 0.1 s, and their number."""
        gaps_s = np.diff(self.table[:, 1])
        return round(float(gaps_s[gaps_s <= max_gap_s].sum()), 1), len(self.table)

    def trajectory(self, name: str, request: Request, notes: Notes | None = None) -> Trajectory:
        table, usable = self.table, self.usable
        if notes is not None and not usable.all():
            first = int(np.argmin(usable))
            notes.add(
                f"poses of {name} left out: {(~usable).sum()} of {len(usable)} are not finite, or have no unit quaternion; "
                f"the first, pose {first}, was recorded at {table[first, 1]:.3f} s"
            )
        clock = int(by_record(table[:, 0], name, request.stamps, notes))
        return trajectory_of(table[usable][:, [clock, *range(2, 9)]], name)


@dataclass(frozen=True, eq=False)
class _Candidate:
    """What may be the poses of the sensor."""

    agrees: bool
    """Whether its frames are connected with that of the scans."""
    names_child: bool
    """Whether it names the frame whose poses it has."""
    poses: StampedPoses
    interval_s: float


def poses_in_bags(
    paths: list[Path],
    request: Request,
    frames: list[str],
    preferred: str | None,
    scan_times_s: Callable[[], NDArray[np.float64]],
) -> FindPoses:
    """Poses of each frame of scans, by time; `frames` are those of the first scans.

    The topic `preferred` is taken before others; `scan_times_s` is called only for a choice among several.
    """
    notes = request.notes
    topics = topics_of(paths)
    transforms = set(topics_with(TRANSFORM_TYPES, topics))
    fitting = topics_with(POSE_TYPES, topics)
    wanted = request.pose_topic
    of_tree = wanted in transforms or (wanted is not None and wanted.strip("/") == "tf" and bool(transforms))
    if wanted is not None and not of_tree and wanted not in fitting:
        listed = ", ".join(sorted([*fitting, *transforms]))
        msg = f"{paths[0]} has no poses in {wanted}: topics with poses are {listed or 'none'}"
        raise ValueError(msg)
    passed_over = {n: "a goal, a plan or the like, by its name" for n in fitting if _NOT_MEASURED.search(n)}
    names = set(fitting) - set(passed_over) if wanted is None else {wanted} & set(fitting)
    tracks, tree = _tracks_and_tree(paths, names, transforms, request)
    sensor = next((frame for frame in frames if frame in tree), frames[0])
    name = wanted
    if wanted is None:
        name = _chosen(tracks, tree, sensor, passed_over, preferred, scan_times_s, request)
        for other, why in sorted(passed_over.items()):
            notes.add(f"poses of {other} are passed over ({why}); pose_topic chooses them")
    if of_tree or name is None:
        return _of_tree(tree, sensor, request)
    track = tracks.get(name)
    if track is None:
        msg = f"{paths[0]}: {name} holds no poses"
        raise ValueError(msg)
    trajectory = track.trajectory(name, request, notes)
    notes.add(f"poses: {len(trajectory.times_s)} of {name}")
    base = sensor if request.extrinsic is not None else _base(track, name, tree, sensor, notes)
    return attached(trajectory, base, lambda: tree, request)


def attached(
    poses: StampedPoses, base: str, tree: Callable[[], dict[str, _Track]], request: Request
) -> FindPoses:
    """Poses of the frames that do not move against `base`, whose poses are given, but for the extrinsic of the user."""

    @cache
    def find(frame: str) -> ScanPoses | None:
        T_base_sensor = np.eye(4) if frame == base else _fixed(tree(), base, frame)
        if T_base_sensor is None:
            return None
        extrinsic = np.eye(4) if request.extrinsic is None else request.extrinsic
        return ScanPoses(poses, extrinsic @ T_base_sensor, request.max_gap_s)

    return find


def transforms_of(paths: list[Path], request: Request) -> dict[str, _Track]:
    """The transforms in bags; see :func:`attached`."""
    return _tracks_and_tree(paths, set(), set(topics_with(TRANSFORM_TYPES, topics_of(paths))), request)[1]


def _chosen(
    tracks: dict[str, _Track],
    tree: dict[str, _Track],
    sensor: str,
    passed_over: dict[str, str],
    preferred: str | None,
    scan_times_s: Callable[[], NDArray[np.float64]],
    request: Request,
) -> str | None:
    """The topic of the poses; None means TF. Says why others are passed over."""
    about = request.notes.about
    candidates: dict[str, _Candidate] = {}
    for name, track in tracks.items():
        try:
            trajectory = track.trajectory(name, request)
        except ValueError as error:
            passed_over[name] = str(error)
            continue
        # In a frame that moves with the sensor are poses of other things.
        agrees = not track.parent or _fixed(tree, track.parent, sensor) is None
        if track.child and sensor in tree:
            agrees = agrees and _fixed(tree, track.child, sensor) is not None
        candidates[name] = _Candidate(agrees, bool(track.child), trajectory, _interval_s(trajectory))
    try:
        of_tree = _of_tree(tree, sensor, request, quiet=True)(sensor) if tree else None
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


def _listed(passed_over: dict[str, str]) -> str:
    return "".join(f"; {name} is passed over ({why})" for name, why in sorted(passed_over.items()))


def _interval_s(trajectory: Trajectory) -> float:
    return float(np.median(np.diff(trajectory.times_s)))


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
    unfit |= {
        name: f"it covers {share:.0%} of the scans" for name, share in covered.items() if share < enough
    }
    fastest_s = min(c.interval_s for name, c in candidates.items() if name not in unfit)
    for name, c in candidates.items():
        if c.interval_s > max(_SLOW_S, _SLOWER * fastest_s):
            unfit.setdefault(name, f"a pose every {c.interval_s:.2g} s, of others every {fastest_s:.2g} s")
    return unfit


def _positions_m(poses: StampedPoses, times_s: list[float], max_gap_s: float) -> NDArray[np.float64]:
    """(N, 3) world frame; NaN where there are none."""
    found = (poses.pose_at(time_s, max_gap_s) for time_s in times_s)
    return np.array([np.full(3, np.nan) if pose is None else pose[:3, 3] for pose in found])


def _length_m(positions_m: NDArray[np.float64]) -> float:
    return float(np.linalg.norm(np.diff(positions_m, axis=0), axis=1).sum())


def _base(track: _Track, name: str, tree: dict[str, _Track], sensor: str, notes: Notes) -> str:
    """The frame whose poses a topic has. Where it names none, it is by convention that which moves with the sensor."""
    base = track.child
    if not base and sensor in tree:
        chain = _ancestors(tree, sensor)
        rigid = [tree[frame].constant and tree[frame].parent != track.parent for frame in chain[:-1]]
        base = chain[rigid.index(False) if False in rigid else len(rigid)]
        if base != sensor:
            notes.add(f"{name} names no child frame: its poses are taken as those of {base}")
    if track.child and track.child == sensor:
        return sensor
    if base and base != sensor and _fixed(tree, base, sensor) is not None:
        notes.add(f"extrinsic: of the static transforms, {base} -> {sensor}")
        return base
    notes.add(
        f"no extrinsic is known between the frame of {name}, {base or '(unnamed)'}, and that of the scans, "
        f"{sensor or '(unnamed)'}: the poses are taken as those of the radar; give extrinsic if they are not"
    )
    return sensor


def _tracks_and_tree(
    paths: list[Path], topics: set[str], transforms: set[str], request: Request
) -> tuple[dict[str, _Track], dict[str, _Track]]:
    """The poses of each of `topics` that has some, and the transform to each frame from its parent."""
    by_topic: dict[str, _Track] = {}
    edges: dict[str, dict[str, _Track]] = {}
    for message in read_messages(paths, topics | transforms, request.notes):
        if message.message_type == PATH:  # each message holds the whole path so far: the last one counts
            by_topic.pop(message.topic, None)
        for pose in message.content:
            tracks, name = by_topic, message.topic
            if message.topic in transforms:
                tracks, name = edges.setdefault(pose.child, {}), pose.header.frame
            if name not in tracks:
                tracks[name] = _Track(pose.header.frame, static=_STATIC in message.topic)
            tracks[name].child = pose.child
            tracks[name].add(pose, message.recorded_s)
    choices = {child: [t for t in parents.values() if t.usable.any()] for child, parents in edges.items()}
    for options in choices.values():
        options.sort(key=lambda track: track.extent(request.max_gap_s), reverse=True)
    tree = {child: options[0] for child, options in choices.items() if options}
    for child, options in choices.items():
        if len(options) > 1:
            moving = (
                track for track in options if _moves({**tree, child: track}, child, request.world_frame)
            )
            tree[child] = next(moving, options[0])
            listed = ", ".join(f"{track.parent} ({len(track.table)} transforms)" for track in options)
            request.notes.add(f"{child} has several parents in TF, {listed}: {tree[child].parent} is used")
    return by_topic, tree


def _moves(tree: dict[str, _Track], frame: str, world: str | None) -> bool:
    """Whether a frame moves in its root, and has the wanted world above it."""
    try:
        chain = _ancestors(tree, frame)
    except ValueError:
        return False
    above = world is None or world.lstrip("/") in chain
    return above and not all(tree[child].constant for child in chain[:-1])


def _ancestors(tree: dict[str, _Track], frame: str) -> list[str]:
    """The frame, its parent, and so on up to the root."""
    chain = [frame]
    while chain[-1] in tree:
        parent = tree[chain[-1]].parent
        if parent in chain:
            msg = f"the transforms run in a circle: {' -> '.join([*chain, parent])}"
            raise ValueError(msg)
        chain.append(parent)
    return chain


def _of_tree(tree: dict[str, _Track], sensor: str, request: Request, *, quiet: bool = False) -> FindPoses:
    """Poses of the frames below the world."""
    notes = None if quiet else request.notes
    moving = [child for child, track in tree.items() if not track.constant]
    base = sensor
    if request.extrinsic is not None or sensor not in tree:
        # The frame that moves and has no other moving frame below it.
        lowest = set(moving) - {frame for child in moving for frame in _ancestors(tree, child)[1:]}
        if request.extrinsic is None or len(lowest) != 1:
            msg = (
                f"{request.notes.about}: the transforms do not lead to the frame of the scans, {sensor or '(unnamed)'}: they have "
                f"{', '.join(sorted(tree)) or 'no frames'}; give extrinsic, the pose of the radar in the frame that moves"
            )
            raise (ValueError if moving else NoPoses)(msg)
        (base,) = lowest
    chain = _ancestors(tree, base)
    world = _world(tree, chain, request)
    if notes is not None and request.world_frame is None and world in tree:
        notes.add(f"TF above {world} is passed over: it changes rarely; world_frame chooses another world")
    if world not in chain:
        msg = f"world_frame {world} is not above {base}, whose frames are {' -> '.join(chain)}"
        raise ValueError(msg)
    if not set(chain[: chain.index(world)]) & set(moving):
        msg = f"{request.notes.about}: no transform between {world} and {base} moves: TF has no poses of the radar"
        raise NoPoses(msg)

    def found(frame: str) -> ScanPoses | None:
        chain = _ancestors(tree, frame)
        if world not in chain[1:]:
            return None
        chain = chain[: chain.index(world) + 1]
        links = [
            tree[child].matrix
            if tree[child].constant
            else tree[child].trajectory(f"TF from {tree[child].parent} to {child}", request, notes)
            for child in reversed(chain[:-1])
        ]
        if notes is not None:
            notes.add(f"poses: TF, {' -> '.join(reversed(chain))}")
        return ScanPoses(TransformChain(tuple(links)), np.eye(4), request.max_gap_s)

    of_base = found(base)
    assert of_base is not None
    assert not isinstance(of_base.poses, np.ndarray)
    if request.extrinsic is not None:
        return attached(of_base.poses, sensor, lambda: tree, request)

    @cache
    def find(frame: str) -> ScanPoses | None:
        try:
            return of_base if frame == base else found(frame)
        except ValueError:  # no poses, or a circle of frames
            return None

    return find


def _world(tree: dict[str, _Track], chain: list[str], request: Request) -> str:
    """The wanted one, or the root; but the frame below it where that is corrected rarely, and its own poses are dense."""
    if request.world_frame is not None:
        return request.world_frame.lstrip("/")
    moving = [frame for frame in chain[:-1] if not tree[frame].constant]
    intervals_s = [_interval_s(tree[frame].trajectory(frame, request)) for frame in moving]
    if len(moving) > 1 and intervals_s[-1] > max(_SLOW_S, _SLOWER * min(intervals_s)):
        return moving[-1]
    return chain[-1]


def static_between(paths: list[Path], base: str, sensor: str, request: Request) -> NDArray[np.float64] | None:
    """T_base_sensor (4, 4) by the static transforms in bags; None where they do not lead from one to the other."""
    return _fixed(transforms_of(paths, request), base, sensor) if base else None


def _fixed(tree: dict[str, _Track], base: str, sensor: str) -> NDArray[np.float64] | None:
    """T_base_sensor through frames that do not move against each other. None: they do."""
    up_base, up_sensor = _ancestors(tree, base), _ancestors(tree, sensor)
    common = next((frame for frame in up_sensor if frame in up_base), None)
    if common is None:
        return None
    T_common = []
    for frames in (up_base[: up_base.index(common)], up_sensor[: up_sensor.index(common)]):
        if not all(tree[frame].constant for frame in frames):
            return None
        T_common.append(reduce(np.matmul, (tree[frame].matrix for frame in reversed(frames)), np.eye(4)))
    T_base_sensor: NDArray[np.float64] = np.linalg.inv(T_common[0]) @ T_common[1]
    return T_base_sensor
