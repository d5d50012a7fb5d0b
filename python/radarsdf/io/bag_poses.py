# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Which poses of a bag are those of the scans: of odometry, stamped poses, a path, or the tree of transforms (TF)."""

from __future__ import annotations

import re
from array import array
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from radarsdf.io.bag_messages import (
    PATH,
    POSE_TYPES,
    TRANSFORM_TYPES,
    by_record,
    read_messages,
    topics_of,
    topics_with,
)
from radarsdf.io.files import check
from radarsdf.io.poses import (
    FIND_POSES,
    NoPoses,
    StampedPoses,
    Trajectory,
    TransformChain,
    are_poses,
    pose_matrices_of,
    trajectory_of,
)
from radarsdf.io.recordings import FindPoses, Request
from radarsdf.io.scans import Notes

# In the names of topics with poses that somebody wants or assumes: no sensor was there.
_WANTED_POSE = re.compile(
    r"goal|set_?point|way_?point|initial_?pose|desired|(^|[/_.-])(plans?|planned|planner|target|cmd)(?![a-z])",
    re.IGNORECASE,
)
_SAME = 1e-9  # a transform that changes by no more is constant, though it is published again and again
_WORLD = "the world of the poses"  # a frame that no tree has


@dataclass
class Track:
    """The poses of one frame in another, as they were recorded."""

    parent: str
    child: str = ""  # empty where the messages do not name it
    static: bool = False
    numbers: array[float] = field(default_factory=lambda: array("d"))  # stamp, record time, pose

    @cached_property
    def table(self) -> NDArray[np.float64]:
        """(P, 9) the usable poses: finite, with a unit quaternion."""
        table = np.array(self.numbers).reshape(-1, 9)
        return table[are_poses(table[:, 2:])]

    @cached_property
    def constant(self) -> bool:
        """Whether all poses are the same."""
        return self.static or bool((np.abs(self.table[:, 2:] - self.table[0, 2:]) <= _SAME).all())

    @cached_property
    def matrix(self) -> NDArray[np.float64]:
        """T_parent_child (4, 4) of a constant transform."""
        matrix: NDArray[np.float64] = pose_matrices_of(self.table[-1:, 2:])[0]
        return matrix

    def trajectory(self, name: str, request: Request) -> Trajectory:
        """The poses by time. Damaged ones are left out, and noted."""
        count = len(self.numbers) // 9
        if damaged := count - len(self.table):
            request.notes.add(
                f"poses of {name} left out: {damaged} of {count} are not finite, with a unit quaternion"
            )
        clock = int(by_record(self.table[:, 0], name, request.stamps, request.notes))
        return trajectory_of(self.table[:, [clock, *range(2, 9)]], name)


class _Attached(NamedTuple):
    """Poses of a frame in _WORLD, in place of its track."""

    chain: TransformChain
    parent: str = _WORLD
    constant: bool = False


class TransformTree:
    """Frames, each with the transform from its parent."""

    def __init__(self, tracks: Mapping[str, Track]) -> None:
        self.tracks: dict[str, Track | _Attached] = dict(tracks)  # by child

    def chain(self, frame: str) -> list[str]:
        """The frame, its parent, and so on up to the root. Raises a ValueError if they run in a circle."""
        chain = [frame]
        while chain[-1] in self.tracks:
            parent = self.tracks[chain[-1]].parent
            check(parent not in chain, f"the transforms run in a circle: {' -> '.join([*chain, parent])}")
            chain.append(parent)
        return chain

    def rigid_top(self, frame: str) -> tuple[str, NDArray[np.float64]]:
        """The highest frame that does not move against this one, and T_top_frame (4, 4)."""
        T_top_frame = np.eye(4)
        for top in self.chain(frame):
            track = self.tracks.get(top)
            if not isinstance(track, Track) or not track.constant:
                break
            T_top_frame = track.matrix @ T_top_frame
        return top, T_top_frame

    def fixed(self, base: str, sensor: str) -> NDArray[np.float64] | None:
        """T_base_sensor (4, 4) where the two frames do not move against each other; None: they do, or nothing is known."""
        (top, T_top_base), (other, T_top_sensor) = self.rigid_top(base), self.rigid_top(sensor)
        return np.linalg.inv(T_top_base) @ T_top_sensor if top == other else None

    def attach(self, poses: StampedPoses, base: str, request: Request) -> FindPoses:
        """Lets `base`, and all that does not move against it, have these poses, before the extrinsic of a user."""
        top, T_top_base = self.rigid_top(base)
        T_pose_base = np.eye(4) if request.extrinsic is None else request.extrinsic
        self.tracks[top] = _Attached(TransformChain((poses, T_pose_base @ np.linalg.inv(T_top_base))))
        return self.finder(_WORLD, request)

    def finder(self, world: str, request: Request) -> Callable[[str], TransformChain | None]:
        """Poses of the frames below the world."""

        @cache
        def find(frame: str) -> TransformChain | None:
            try:
                chain = self.chain(frame)
                if world not in chain[1:]:
                    return None
                chain = chain[: chain.index(world) + 1]
                if world != _WORLD:
                    request.notes.add(f"poses: TF, {' -> '.join(reversed(chain))}")
                return TransformChain(tuple(self._link(child, request) for child in reversed(chain[:-1])))
            except ValueError:  # a circle of frames, or a single pose
                return None

        return find

    def _link(self, child: str, request: Request) -> StampedPoses | NDArray[np.float64]:
        track = self.tracks[child]
        if isinstance(track, _Attached):
            return track.chain
        name = f"TF from {track.parent} to {child}"
        return track.matrix if track.constant else track.trajectory(name, request)


def transforms_in(paths: list[Path], request: Request) -> TransformTree:
    """The transforms of all frames in bags."""
    return _tracks_and_tree(paths, set(), set(topics_with(TRANSFORM_TYPES, topics_of(paths))), request)[1]


def poses_in_bags(paths: list[Path], request: Request, frames: list[str], preferred: str | None) -> FindPoses:
    """Poses of each frame of scans, by time; `frames` are those of the first scans, the most frequent first.

    Of several sources, the topic `preferred` is taken, or else :func:`_choose` decides.
    """
    notes, wanted = request.notes, request.pose_topic
    topics = topics_of(paths)
    transforms = set(topics_with(TRANSFORM_TYPES, topics))
    fitting = set(topics_with(POSE_TYPES, topics))
    wants_tf = wanted in transforms or (wanted is not None and wanted.strip("/") == "tf" and bool(transforms))
    listed = ", ".join(sorted(fitting | transforms)) or "none"
    known = wanted is None or wants_tf or wanted in fitting
    check(known, f"{paths[0]} has no poses in {wanted}: topics with poses are {listed}")
    names = {n for n in fitting if not _WANTED_POSE.search(n)} if wanted is None else fitting & {wanted}
    tracks, tree = _tracks_and_tree(paths, names, transforms, request)
    sensor = next((frame for frame in frames if frame in tree.tracks), frames[0])
    name = wanted
    if wanted is None:
        name = _choose(tracks, tree, sensor, preferred, fitting, request)
        for other in sorted(fitting - {name}):
            notes.add(f"poses of {other} are passed over; pose_topic chooses them")
    if wants_tf or name is None:
        return _of_tree(tree, sensor, request)
    check(name in tracks, f"{paths[0]}: {name} holds no poses")
    trajectory = tracks[name].trajectory(name, request)
    notes.add(f"poses: {len(trajectory.times_s)} of {name}")
    base = sensor if request.extrinsic is not None else _base(tracks[name].child, name, tree, sensor, notes)
    return tree.attach(trajectory, base, request)


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
            tracks, key = by_topic, message.topic
            if message.topic in transform_topics:
                tracks, key = parents.setdefault(pose.child, {}), pose.parent
            track = tracks.setdefault(key, Track(pose.parent, pose.child, static))
            track.numbers.extend((pose.stamp_s, message.recorded_s, *pose.values))
    edges = {}
    for child, tracks in parents.items():
        options = [track for track in tracks.values() if len(track.table)]
        if options:
            edges[child] = max(options, key=lambda track: _rank(track, request))
        if len(options) > 1:
            listed = ", ".join(f"{track.parent} ({len(track.table)} transforms)" for track in options)
            request.notes.add(f"{child} has several parents in TF, {listed}: {edges[child].parent} is used")
    return {name: track for name, track in by_topic.items() if len(track.table)}, TransformTree(edges)


def _rank(track: Track, request: Request) -> tuple[bool, bool, float, int]:
    """Of several parents of a frame, the wanted world counts, then the one in which the frame moves for longest."""
    recorded_s, wanted = track.table[:, 1], (request.world_frame or _WORLD).lstrip("/")
    return track.parent == wanted, not track.constant, round(float(np.ptp(recorded_s)), 1), len(recorded_s)


def _choose(
    tracks: dict[str, Track],
    tree: TransformTree,
    sensor: str,
    preferred: str | None,
    fitting: set[str],
    request: Request,
) -> str | None:
    """The topic of the poses; None means TF.

    It is the preferred one, or the only one; else the only one whose child frame leads to that of the scans; else TF.
    """
    about = request.notes.about
    topics = sorted(name for name, track in tracks.items() if len(np.unique(track.table[:, :2], axis=0)) > 1)
    if preferred in topics:
        return preferred
    try:
        _of_tree(tree, sensor, replace(request, notes=Notes(about, log=False)))
    except ValueError as error:
        if len(topics) == 1:
            return topics[0]
        if not topics:
            msg = f"{error}; {', '.join(sorted(fitting)) or 'no topic'} is passed over"
            raise type(error)(msg) from error
        of_tree = False
    else:
        of_tree = True
    children = {name: tracks[name].child for name in topics if tracks[name].child}
    known = sensor in tree.tracks
    leading = [n for n, child in children.items() if not known or tree.fixed(child, sensor) is not None]
    listed = ", ".join(topics)
    one = of_tree or len(leading) == 1
    check(one, f"{about} has several topics with poses: say by pose_topic which one counts, of {listed}")
    return leading[0] if len(leading) == 1 else None


def _base(child: str, name: str, tree: TransformTree, sensor: str, notes: Notes) -> str:
    """The frame whose poses a topic has. Where it names none, it is by convention that which moves with the sensor."""
    base = child or tree.rigid_top(sensor)[0]
    if not child and base != sensor:
        notes.add(f"{name} names no child frame: its poses are taken as those of {base}")
    if base != sensor and tree.fixed(base, sensor) is not None:
        notes.add(f"extrinsic: of the static transforms, {base} -> {sensor}")
    elif not child or base != sensor:
        notes.add(
            f"no extrinsic is known between the frame of {name}, {child or '(unnamed)'}, and that of the scans, "
            f"{sensor or '(unnamed)'}: the poses are taken as those of the radar; give extrinsic if they are not"
        )
        return sensor
    return base


def _of_tree(tree: TransformTree, sensor: str, request: Request) -> FindPoses:
    """Poses of the frames below the world. Raises a ValueError where TF has none of the sensor."""
    about, notes = request.notes.about, request.notes
    if not tree.tracks:
        msg = f"{about} has no poses (Odometry, PoseStamped, Path or TF): give a file of poses, such as TUM; {FIND_POSES}"
        raise NoPoses(msg)
    base = sensor
    moving = {frame for frame, track in tree.tracks.items() if not track.constant}
    if request.extrinsic is not None or sensor not in tree.tracks:
        lowest = moving - {above for frame in moving for above in tree.chain(frame)[1:]}
        if request.extrinsic is None or len(lowest) != 1:
            what = f"{sensor or '(unnamed)'}: they have {', '.join(sorted(tree.tracks))}; give extrinsic"
            msg = f"{about}: the transforms do not lead to the frame of the scans, {what}"
            raise (ValueError if moving else NoPoses)(msg)
        (base,) = lowest
    chain = tree.chain(base)
    world = chain[-1] if request.world_frame is None else request.world_frame.lstrip("/")
    above = [frame for frame in chain if frame in moving][1:] if request.world_frame is None else []
    for frame in above:
        track = tree.tracks[frame]
        if isinstance(track, Track) and np.median(np.diff(track.table[:, 1])) > request.max_gap_s:
            notes.add(f"TF above {frame} is passed over: it is rare; world_frame chooses another world")
            world = frame
            break
    check(world in chain, f"world_frame {world} is not above {base}, whose frames are {' -> '.join(chain)}")
    if not moving & set(chain[: chain.index(world)]):
        msg = f"{about}: no transform between {world} and {base} moves: TF has no poses of the radar"
        raise NoPoses(msg)
    find = tree.finder(world, request)
    poses = find(base)
    if poses is None:
        msg = f"{about}: a transform between {world} and {base} has a single pose"
        raise ValueError(msg)
    return find if request.extrinsic is None else tree.attach(poses, sensor, request)
