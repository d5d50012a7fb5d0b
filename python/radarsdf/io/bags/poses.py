# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Which poses of a bag are those of the scans: of odometry, stamped poses, a path, or the tree of transforms (TF).

A topic that a user names counts. Otherwise each topic with poses, and TF, is a candidate; :func:`_choose` passes some over,
and an error asks the user where several are left.
"""

from __future__ import annotations

import re
from array import array
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache, cached_property, reduce
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from radarsdf.io.bags.files import by_record, read_messages, topics_of, topics_with
from radarsdf.io.bags.messages import PATH, POSE_TYPES, TRANSFORM_TYPES
from radarsdf.io.poses.files import FIND_POSES
from radarsdf.io.poses.trajectory import (
    NoPoses,
    ScanPoses,
    StampedPoses,
    Trajectory,
    TransformChain,
    are_poses,
    pose_matrices_of,
    trajectory_of,
)
from radarsdf.io.recordings import FindPoses, Request
from radarsdf.io.scans import Notes

_WANTED_POSE = re.compile(
    r"goal|set_?point|way_?point|initial_?pose|desired|(^|[/_.-])(plans?|planned|planner|target|cmd)(?![a-z])",
    re.IGNORECASE,
)
"""In the names of topics with poses that somebody wants or assumes: no sensor was there."""
_TF = "TF"
_SAME = 1e-9  # a transform that changes by no more is constant, though it is published again and again
_SAMPLES = 200  # scans whose times are compared with poses
_SAME_LENGTH, _SAME_LENGTH_M = 0.3, 1.0  # of the paths of one vehicle: its parts swing, and poses are noisy
_NEARLY_ALL = 0.9  # of what the best covers
_SLOW_S, _SLOWER = 0.2, 3.0  # interval of poses that correct others, and its ratio to that of the others


@dataclass
class Track:
    """The poses of one frame in another, as they were recorded."""

    parent: str
    child: str
    """Empty where the messages do not name it."""
    static: bool
    numbers: array[float] = field(default_factory=lambda: array("d"))
    """Of each pose: stamp, record time, x, y, z, qx, qy, qz, qw."""

    @cached_property
    def table(self) -> NDArray[np.float64]:
        """(P, 9) all poses."""
        return np.array(self.numbers).reshape(-1, 9)

    @cached_property
    def usable(self) -> NDArray[np.bool_]:
        """Mask (P,) of those that are finite, with a unit quaternion."""
        return are_poses(self.table[:, 2:])

    @cached_property
    def constant(self) -> bool:
        """Whether all poses are the same."""
        poses = self.table[self.usable, 2:]
        return self.static or bool((np.abs(poses - poses[0]) <= _SAME).all())

    @cached_property
    def matrix(self) -> NDArray[np.float64]:
        """T_parent_child (4, 4) of a constant transform."""
        matrix: NDArray[np.float64] = pose_matrices_of(self.table[self.usable, 2:][-1:])[0]
        return matrix

    def extent(self, max_gap_s: float) -> tuple[float, int]:
        """The time in which there are poses, to 0.1 s, and their number."""
        gaps_s = np.diff(self.table[:, 1])
        return round(float(gaps_s[gaps_s <= max_gap_s].sum()), 1), len(self.table)

    def trajectory(self, name: str, request: Request) -> Trajectory:
        """The poses by time. Damaged ones are left out, and noted."""
        table, usable = self.table, self.usable
        if not usable.all():
            first = int(np.argmin(usable))
            request.notes.add(
                f"poses of {name} left out: {(~usable).sum()} of {len(usable)} are not finite, or have no unit quaternion; "
                f"the first, pose {first}, was recorded at {table[first, 1]:.3f} s"
            )
        clock = int(by_record(table[:, 0], name, request.stamps, request.notes))
        return trajectory_of(table[usable][:, [clock, *range(2, 9)]], name)


class TransformTree:
    """Frames, each with the transform from its parent."""

    def __init__(self, edges: Mapping[str, Track]) -> None:
        self.edges = edges
        """By child."""

    def chain(self, frame: str) -> list[str]:
        """The frame, its parent, and so on up to the root. Raises a ValueError if they run in a circle."""
        chain = [frame]
        while chain[-1] in self.edges:
            parent = self.edges[chain[-1]].parent
            if parent in chain:
                msg = f"the transforms run in a circle: {' -> '.join([*chain, parent])}"
                raise ValueError(msg)
            chain.append(parent)
        return chain

    def moves(self, frame: str, world: str | None) -> bool:
        """Whether a frame moves in its root, and has the wanted world above it."""
        try:
            chain = self.chain(frame)
        except ValueError:
            return False
        above = world is None or world.lstrip("/") in chain
        return above and not all(self.edges[child].constant for child in chain[:-1])

    def fixed(self, base: str, sensor: str) -> NDArray[np.float64] | None:
        """T_base_sensor (4, 4) where the two frames do not move against each other; None: they do, or nothing is known."""
        up_base, up_sensor = self.chain(base), self.chain(sensor)
        common = next((frame for frame in up_sensor if frame in up_base), None)
        if common is None:
            return None
        T_common = []
        for frames in (up_base[: up_base.index(common)], up_sensor[: up_sensor.index(common)]):
            if not all(self.edges[frame].constant for frame in frames):
                return None
            matrices = (self.edges[frame].matrix for frame in reversed(frames))
            T_common.append(reduce(np.matmul, matrices, np.eye(4)))
        T_base_sensor: NDArray[np.float64] = np.linalg.inv(T_common[0]) @ T_common[1]
        return T_base_sensor


def transforms_in(paths: list[Path], request: Request) -> TransformTree:
    """The transforms of all frames in bags."""
    return _tracks_and_tree(paths, set(), set(topics_with(TRANSFORM_TYPES, topics_of(paths))), request)[1]


def attached(
    poses: StampedPoses, base: str, tree: Callable[[], TransformTree], request: Request
) -> FindPoses:
    """Poses of the frames that do not move against `base`, whose poses are known, but for the extrinsic of the user."""
    extrinsic = np.eye(4) if request.extrinsic is None else request.extrinsic

    @cache
    def find(frame: str) -> ScanPoses | None:
        T_base_sensor = np.eye(4) if frame == base else tree().fixed(base, frame)
        return (
            T_base_sensor
            if T_base_sensor is None
            else ScanPoses(poses, extrinsic @ T_base_sensor, request.max_gap_s)
        )

    return find


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
    fitting = set(topics_with(POSE_TYPES, topics))
    wants_tf = wanted in transforms or (wanted is not None and wanted.strip("/") == "tf" and bool(transforms))
    if wanted is not None and not wants_tf and wanted not in fitting:
        listed = ", ".join(sorted(fitting | transforms))
        msg = f"{paths[0]} has no poses in {wanted}: topics with poses are {listed or 'none'}"
        raise ValueError(msg)
    passed_over = {n: "a goal, a plan or the like, by its name" for n in fitting if _WANTED_POSE.search(n)}
    names = fitting - set(passed_over) if wanted is None else fitting & {wanted}
    tracks, tree = _tracks_and_tree(paths, names, transforms, request)
    sensor = next((frame for frame in frames if frame in tree.edges), frames[0])
    name = wanted
    if wanted is None:
        name = _choose(tracks, tree, sensor, passed_over, preferred, scan_times_s, request)
        for other, why in sorted(passed_over.items()):
            notes.add(f"poses of {other} are passed over ({why}); pose_topic chooses them")
    if wants_tf or name is None:
        return _of_tree(tree, sensor, request)
    if name not in tracks:
        msg = f"{paths[0]}: {name} holds no poses"
        raise ValueError(msg)
    trajectory = tracks[name].trajectory(name, request)
    notes.add(f"poses: {len(trajectory.times_s)} of {name}")
    base = sensor if request.extrinsic is not None else _base(tracks[name], name, tree, sensor, notes)
    return attached(trajectory, base, lambda: tree, request)


def _tracks_and_tree(
    paths: list[Path], pose_topics: set[str], transform_topics: set[str], request: Request
) -> tuple[dict[str, Track], TransformTree]:
    """The poses of each of `pose_topics` that has some, and the transforms, in one pass through the bags."""
    by_topic: dict[str, Track] = {}
    parents: dict[str, dict[str, Track]] = {}
    for message in read_messages(paths, pose_topics | transform_topics, request.notes):
        if message.message_type == PATH:  # each message holds the whole path so far: the last one counts
            by_topic.pop(message.topic, None)
        static = "static" in message.topic  # /tf_static: transforms that hold for all times
        for pose in message.content:
            if message.topic in transform_topics:
                tracks, key = parents.setdefault(pose.child, {}), pose.header.frame
            else:
                tracks, key = by_topic, message.topic
            track = tracks.setdefault(key, Track(pose.header.frame, pose.child, static))
            track.child = pose.child
            track.numbers.extend((pose.header.stamp_s, message.recorded_s, *pose.values))
    return by_topic, _tree(parents, request)


def _tree(parents: Mapping[str, Mapping[str, Track]], request: Request) -> TransformTree:
    """Of several parents of a frame, the one with transforms for the longest time under which the frame moves."""
    options_of: dict[str, list[Track]] = {}
    for child, tracks in parents.items():
        usable = [track for track in tracks.values() if track.usable.any()]
        if usable:
            options_of[child] = sorted(usable, key=lambda t: t.extent(request.max_gap_s), reverse=True)
    edges = {child: options[0] for child, options in options_of.items()}
    for child, options in options_of.items():
        if len(options) > 1:
            trees = ((track, TransformTree({**edges, child: track})) for track in options)
            moving = (track for track, tree in trees if tree.moves(child, request.world_frame))
            edges[child] = next(moving, options[0])
            listed = ", ".join(f"{track.parent} ({len(track.table)} transforms)" for track in options)
            request.notes.add(f"{child} has several parents in TF, {listed}: {edges[child].parent} is used")
    return TransformTree(edges)


@dataclass(frozen=True, eq=False)
class _Candidate:
    """What may be the poses of the sensor."""

    poses: StampedPoses
    interval_s: float
    names_child: bool
    """Whether it names the frame whose poses it has."""
    agrees: bool
    """Whether its frames are connected with that of the scans."""


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
    quiet = replace(request, notes=Notes(about, log=False))
    candidates: dict[str, _Candidate] = {}
    for name, track in tracks.items():
        try:
            trajectory = track.trajectory(name, quiet)
        except ValueError as error:
            passed_over[name] = str(error)
            continue
        # In a frame that moves with the sensor are poses of other things.
        agrees = not track.parent or tree.fixed(track.parent, sensor) is None
        if track.child and sensor in tree.edges:
            agrees = agrees and tree.fixed(track.child, sensor) is not None
        candidates[name] = _Candidate(trajectory, _interval_s(trajectory), bool(track.child), agrees)
    error_of_tree: ValueError = NoPoses(
        f"{about} has no poses (Odometry, PoseStamped, Path or TF): give a file of poses, such as TUM; {FIND_POSES}"
    )
    if tree.edges:
        try:
            of_tree = _of_tree(tree, sensor, quiet)(sensor)
        except ValueError as error:
            error_of_tree, of_tree = error, None
        if of_tree is not None and isinstance(of_tree.poses, TransformChain):
            interval_s = max(map(_interval_s, of_tree.poses.moving()))
            candidates[_TF] = _Candidate(of_tree.poses, interval_s, names_child=True, agrees=True)
    if not candidates:
        listed = "".join(f"; {name} is passed over ({why})" for name, why in sorted(passed_over.items()))
        msg = f"{error_of_tree}{listed}"
        raise type(error_of_tree)(msg) from error_of_tree
    if len(candidates) > 1:
        candidates = _fitting(candidates, scan_times_s(), request.max_gap_s, passed_over)
    left = sorted(set(candidates) - {_TF})
    if len(left) > 1 and preferred not in left:
        msg = (
            f"{about} has several topics with poses: say by pose_topic which one counts, of {', '.join(left)}"
        )
        raise ValueError(msg)
    if preferred in left:
        return preferred
    return left[0] if left else None


def _fitting(
    candidates: dict[str, _Candidate],
    times_s: NDArray[np.float64],
    max_gap_s: float,
    passed_over: dict[str, str],
) -> dict[str, _Candidate]:
    """Candidates that their frames, the times and the rate of the others do not rule out."""
    some = times_s[:: max(1, len(times_s) // _SAMPLES)].tolist()
    positions_m = {name: _positions_m(c.poses, some, max_gap_s) for name, c in candidates.items()}
    covered = {name: float(np.isfinite(xyz[:, 0]).mean()) for name, xyz in positions_m.items()}
    half = max(covered.values()) / 2
    connected = any(c.agrees and covered[name] > half for name, c in candidates.items())
    left = dict(candidates)

    def drop(name: str, why: str) -> None:
        passed_over[name] = why
        del left[name]

    for name, c in candidates.items():
        if connected and not c.agrees:
            drop(name, "its frames do not lead to that of the scans")
        elif not c.names_child and _TF in candidates:
            both = np.isfinite(positions_m[name] + positions_m[_TF]).all(axis=1)
            own_m, of_tree_m = (_length_m(positions_m[n][both]) for n in (name, _TF))
            if abs(own_m - of_tree_m) > _SAME_LENGTH_M + _SAME_LENGTH * max(own_m, of_tree_m):
                drop(name, f"it moved {own_m:.1f} m, the sensor {of_tree_m:.1f} m by TF")
    enough = _NEARLY_ALL * max(covered[name] for name in left)
    for name in list(left):
        if covered[name] < enough:
            drop(name, f"it covers {covered[name]:.0%} of the scans")
    fastest_s = min(c.interval_s for c in left.values())
    for name, c in list(left.items()):
        if c.interval_s > max(_SLOW_S, _SLOWER * fastest_s):
            drop(name, f"a pose every {c.interval_s:.2g} s, of others every {fastest_s:.2g} s")
    return left


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
    if base and base == sensor:
        return sensor
    if not base and sensor in tree.edges:
        chain = tree.chain(sensor)
        rigid = [tree.edges[f].constant and tree.edges[f].parent != track.parent for f in chain[:-1]]
        base = chain[rigid.index(False) if False in rigid else len(rigid)]
        if base != sensor:
            notes.add(f"{name} names no child frame: its poses are taken as those of {base}")
    if base and base != sensor and tree.fixed(base, sensor) is not None:
        notes.add(f"extrinsic: of the static transforms, {base} -> {sensor}")
        return base
    notes.add(
        f"no extrinsic is known between the frame of {name}, {base or '(unnamed)'}, and that of the scans, "
        f"{sensor or '(unnamed)'}: the poses are taken as those of the radar; give extrinsic if they are not"
    )
    return sensor


def _of_tree(tree: TransformTree, sensor: str, request: Request) -> FindPoses:
    """Poses of the frames below the world. Raises a ValueError where TF has none of the sensor."""
    about, notes = request.notes.about, request.notes
    base = sensor
    if request.extrinsic is not None or sensor not in tree.edges:
        moving = [frame for frame, track in tree.edges.items() if not track.constant]
        lowest = set(moving) - {above for frame in moving for above in tree.chain(frame)[1:]}
        if request.extrinsic is None or len(lowest) != 1:
            msg = (
                f"{about}: the transforms do not lead to the frame of the scans, {sensor or '(unnamed)'}: they have "
                f"{', '.join(sorted(tree.edges)) or 'no frames'}; give extrinsic, the pose of the radar in the frame that moves"
            )
            raise (ValueError if moving else NoPoses)(msg)
        (base,) = lowest
    chain = tree.chain(base)
    world = _world(tree, chain, request)
    if request.world_frame is None and world in tree.edges:
        notes.add(f"TF above {world} is passed over: it changes rarely; world_frame chooses another world")
    if world not in chain:
        msg = f"world_frame {world} is not above {base}, whose frames are {' -> '.join(chain)}"
        raise ValueError(msg)
    if all(tree.edges[frame].constant for frame in chain[: chain.index(world)]):
        msg = f"{about}: no transform between {world} and {base} moves: TF has no poses of the radar"
        raise NoPoses(msg)
    poses = _poses_below(tree, world, base, request)
    assert poses is not None
    if request.extrinsic is not None:
        return attached(poses, sensor, lambda: tree, request)

    @cache
    def find(frame: str) -> ScanPoses | None:
        try:
            found = poses if frame == base else _poses_below(tree, world, frame, request)
        except ValueError:  # no poses, or a circle of frames
            return None
        return None if found is None else ScanPoses(found, np.eye(4), request.max_gap_s)

    return find


def _poses_below(tree: TransformTree, world: str, frame: str, request: Request) -> TransformChain | None:
    """T_world_frame by time; None where the frame is not below the world."""
    chain = tree.chain(frame)
    if world not in chain[1:]:
        return None
    chain = chain[: chain.index(world) + 1]
    links = []
    for child in reversed(chain[:-1]):
        track = tree.edges[child]
        name = f"TF from {track.parent} to {child}"
        links.append(track.matrix if track.constant else track.trajectory(name, request))
    request.notes.add(f"poses: TF, {' -> '.join(reversed(chain))}")
    return TransformChain(tuple(links))


def _world(tree: TransformTree, chain: list[str], request: Request) -> str:
    """The wanted one, or the root; but the frame below it where that is corrected rarely, and its own poses are dense."""
    if request.world_frame is not None:
        return request.world_frame.lstrip("/")
    quiet = replace(request, notes=Notes(log=False))
    moving = [frame for frame in chain[:-1] if not tree.edges[frame].constant]
    intervals_s = [_interval_s(tree.edges[frame].trajectory(frame, quiet)) for frame in moving]
    if len(moving) > 1 and intervals_s[-1] > max(_SLOW_S, _SLOWER * min(intervals_s)):
        return moving[-1]
    return chain[-1]
