"""Poses of the scans in a bag: from odometry, stamped poses, a path, or the tree of transforms (TF)."""

import itertools
import re
from array import array
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from radarsdf.arrays import Floats
from radarsdf.checks import check
from radarsdf.io import bag_messages
from radarsdf.io import poses as pose_files
from radarsdf.io.poses import StampedPoses, Trajectory, TransformChain
from radarsdf.io.recordings import FindPoses, Request

# Names of topics with desired or assumed poses, not measured ones.
_DESIRED_POSE = re.compile(
    r"goal|set_?point|way_?point|initial_?pose|desired|(^|[/_.-])(plans?|planned|planner|target|cmd)(?![a-z])",
    re.IGNORECASE,
)
_CONSTANT = 1e-9  # largest change of a constant transform that is published repeatedly


@dataclass
class Track:
    parent: str
    child: str = ""  # empty where the messages do not name it
    static: bool = False
    numbers: "array[float]" = field(default_factory=lambda: array("d"))  # stamp, record time, pose

    def add(self, numbers: tuple[float, ...]) -> None:
        self.numbers.extend(numbers)

    @cached_property
    def table(self) -> Floats:
        """(P, 9) the usable poses: finite, with a unit quaternion."""
        table = np.array(self.numbers).reshape(-1, 9)
        return table[pose_files.are_poses(table[:, 2:])]

    @cached_property
    def constant(self) -> bool:
        """Whether all poses are the same."""
        return bool((np.abs(self.table[:, 2:] - self.table[0, 2:]) <= _CONSTANT).all())

    @cached_property
    def matrix(self) -> Floats:
        """T_parent_child (4, 4) of a constant transform."""
        return np.asarray(pose_files.pose_matrices_of(self.table[-1:, 2:])[0])

    def trajectory(self, name: str, request: Request) -> Trajectory:
        """Trajectory of the poses. Damaged ones are left out and noted."""
        count = len(self.numbers) // 9
        if damaged := count - len(self.table):
            request.notes.add(f"poses of {name} left out: {damaged} of {count} are not finite and rigid")
        times_s = self.table[:, :2].T
        clock = bag_messages.Clock.of(times_s, name, request.stamps, request.notes)
        return pose_files.trajectory_of(np.column_stack([clock.times(*times_s), self.table[:, 2:]]), name)

    def link(self, request: Request) -> Trajectory | Floats:
        """T_parent_child: constant, static from one time to the next, or moving."""
        name = f"TF from {self.parent} to {self.child}"
        if self.constant:
            return self.matrix
        if not self.static:
            return self.trajectory(name, request)
        changed = np.abs(np.diff(self.table[:, 2:], axis=0)).max(axis=1) > _CONSTANT
        table = self.table[np.r_[True, changed]]
        by_stamp = request.stamps != "record" and (np.diff(table[:, 0]) > 0).all() and table[1, 0] > 0
        times_s = np.r_[-np.inf, table[1:, 0 if by_stamp else 1]]
        listed = ", ".join(f"{time_s:.3f} s" for time_s in times_s[1:4])
        request.notes.add(f"{name} is static, and changes {len(times_s) - 1} times: at {listed}")
        return Trajectory(times_s, table[:, 2:5], Rotation.from_quat(table[:, 5:]), held=True)


class TransformTree:
    """A tree of frames, each with the transform from its parent."""

    def __init__(self, tracks: Mapping[str, Track]) -> None:
        self.tracks = dict(tracks)  # keyed by child frame
        self.moving = {frame for frame, track in tracks.items() if not (track.static or track.constant)}

    def chain(self, frame: str) -> list[str]:
        """Return the frame and its ancestors up to the root. Raises a ValueError on a cycle."""
        chain = [frame]
        while chain[-1] in self.tracks:
            parent = self.tracks[chain[-1]].parent
            check(parent not in chain, f"the transforms form a cycle: {' -> '.join([*chain, parent])}")
            chain.append(parent)
        return chain

    def rigid_top(self, frame: str) -> tuple[str, Floats]:
        """Return the highest frame rigidly attached to this one, and T_top_frame (4, 4)."""
        T_top_frame = np.eye(4)
        for top in self.chain(frame):
            track = self.tracks.get(top)
            if track is None or not track.constant:
                break
            T_top_frame = track.matrix @ T_top_frame
        return top, T_top_frame

    def mountings(self, frames: Sequence[str]) -> tuple[str, dict[str, Floats]]:
        """Return the highest frame rigidly attached to all known ones of `frames`, and T_top_frame of each; else the first, and none."""
        known = {*self.tracks, *(track.parent for track in self.tracks.values())}
        tops = {frame: self.rigid_top(frame) for frame in frames if frame in known}
        names = {top for top, _ in tops.values()}
        if len(names) != 1:
            return frames[0], {}
        return names.pop(), {frame: T_top_frame for frame, (_, T_top_frame) in tops.items()}

    def mounted_on(self, frame: str) -> str:
        """Return the highest frame that moves with this one, apart from changes of static transforms."""
        return next(top for top in self.chain(frame) if top in self.moving or top not in self.tracks)

    def attach(self, poses: StampedPoses, base: str, request: Request) -> FindPoses:
        """Assign poses to `base` and to all frames below the highest one rigidly attached to it."""
        top, T_top_base = self.rigid_top(base)
        T_pose_base = np.eye(4) if request.extrinsic is None else request.extrinsic
        return self.finder(top, request, poses, T_pose_base @ np.linalg.inv(T_top_base))

    def finder(self, top: str, request: Request, *above: Any) -> Callable[[str], TransformChain | None]:
        """Return a function from a frame below `top`, whose poses are the product of `above`, to its poses."""

        @cache
        def find(frame: str) -> TransformChain | None:
            try:
                chain = self.chain(frame)
                tracks = [self.tracks[child] for child in reversed(chain[: chain.index(top)])]
                links: list[Any] = [track.link(request) for track in tracks]
            except ValueError:  # it is not below, or has a single pose
                return None
            moving = [i for i, link in enumerate(links) if isinstance(link, Trajectory) and not link.held]
            for i, below in itertools.pairwise(moving):
                links[i] = _held_corrections(links[i], links[below], tracks[i], request)
            return TransformChain((*above, *links)) if above or links else None

        return find


def _held_corrections(slow: Trajectory, below: Trajectory, track: Track, request: Request) -> Trajectory:
    """Let poses hold, as in tf2, that correct those of the frame below too rarely to be interpolated."""
    gap_s = float(np.median(np.diff(slow.times_s)))
    if gap_s <= request.max_gap_s:
        return slow
    base = np.stack([np.interp(slow.times_s, below.times_s, axis) for axis in below.positions.T], axis=1)
    at = slow.rotations.apply(base) + slow.positions
    uncorrected = slow.rotations[:-1].apply(base[1:]) + slow.positions[:-1]
    corrected_m, moved_m = (np.linalg.norm(uncorrected - x, axis=1).sum() for x in (at[1:], at[:-1]))
    if corrected_m > moved_m:  # it moves more than the frame below
        return slow
    name = f"TF from {track.parent} to {track.child}"
    request.notes.add(f"{name} comes every {gap_s:.3g} s: the last one before a scan holds")
    return replace(slow, held=True)


class Tracks:
    """The poses of messages so far, by topic, and the transforms of TF."""

    def __init__(self, make: type[Track] = Track) -> None:
        self.by_topic: dict[str, Track] = {}
        self._parents: dict[str, dict[str, Track]] = {}  # by child and parent frame
        self._make = make

    def add(self, message: bag_messages.Message) -> None:
        if message.message_type == bag_messages.PATH:
            self.by_topic.pop(message.topic, None)  # each holds the whole path so far: the last one is used
        static = "static" in message.topic  # /tf_static: transforms that hold for all times
        for pose in message.content:
            tracks, key = self.by_topic, message.topic
            if message.message_type in bag_messages.TRANSFORM_TYPES:
                tracks, key = self._parents.setdefault(pose.child, {}), pose.parent
            track = tracks.setdefault(key, self._make(pose.parent, pose.child, static))
            track.add((pose.stamp_s, message.recorded_s, *pose.values))

    def tree(self, request: Request) -> TransformTree:
        """Tree of the transforms. Of a frame with several parents, one is chosen and noted."""
        edges, wanted = {}, (request.world_frame or "").lstrip("/")
        rank = lambda t: (t.parent == wanted, not t.constant, np.ptp(t.table[:, 1]).round(1))
        for child, tracks in self._parents.items():
            options = [track for track in tracks.values() if len(track.table)]
            if options:
                edges[child] = max(options, key=rank)
            if len(options) > 1:
                request.notes.add(f"{child} has several parents in TF: {edges[child].parent} is used")
        return TransformTree(edges)


def transforms_in(paths: list[Path], request: Request) -> TransformTree:
    topics = bag_messages.topics_with(bag_messages.TRANSFORM_TYPES, bag_messages.topics_of(paths))
    return _tracks_in(paths, set(topics), request).tree(request)


def poses_in_bags(paths: list[Path], request: Request, frames: list[str], preferred: str | None) -> FindPoses:
    """Return a function from frame to poses, if possible of the topic `preferred`. `frames`: of scans, the most frequent first."""
    notes, wanted, topics = request.notes, request.pose_topic, bag_messages.topics_of(paths)
    transforms = set(bag_messages.topics_with(bag_messages.TRANSFORM_TYPES, topics))
    fitting = set(bag_messages.topics_with(bag_messages.POSE_TYPES, topics))
    wants_tf = wanted in transforms or (wanted is not None and wanted.strip("/") == "tf" and bool(transforms))
    listed = ", ".join(sorted(fitting | transforms)) or "none"
    known = wanted is None or wants_tf or wanted in fitting
    check(known, f"{paths[0]} has no poses in {wanted}: topics with poses are {listed}")
    names = {n for n in fitting if not _DESIRED_POSE.search(n)} if wanted is None else fitting & {wanted}
    found = _tracks_in(paths, names | transforms, request)
    tree = found.tree(request)
    # Topics with a single pose are left out.
    tracks = {n: t for n, t in found.by_topic.items() if len(np.unique(t.table[:, :2], axis=0)) > 1}
    sensor = next((frame for frame in frames if frame in tree.tracks), frames[0])
    name, find = "" if wants_tf else wanted or _choose(tracks, tree, sensor, preferred), None
    try:
        find = None if name else tree_poses(tree, sensor, request)
    except ValueError:
        if wants_tf or not tracks:
            raise
        listed = ", ".join(sorted(tracks))
        what = "has several topics with poses: choose one with pose_topic"
        check(len(tracks) == 1, f"{notes.about} {what}, of {listed}")
        (name,) = tracks
    for other in sorted(fitting - {name}):
        notes.add(f"poses of {other} are ignored; pose_topic selects them")
    check(find or name in tracks, f"{paths[0]}: {name} holds no poses")
    return find or topic_poses(name, tracks[name], tree, sensor, request)


def _tracks_in(paths: list[Path], topics: set[str], request: Request) -> Tracks:
    tracks = Tracks()
    for message in bag_messages.read_messages(paths, topics, request.notes):
        tracks.add(message)
    return tracks


def _choose(tracks: dict[str, Track], tree: TransformTree, sensor: str, preferred: str | None) -> str:
    """Return the preferred topic, or the only one whose child frame is rigidly attached to that of the scans; else ``""``."""
    if preferred is not None and preferred in tracks:
        return preferred
    known, top = sensor in tree.tracks, tree.mounted_on(sensor)
    children = {name: track.child for name, track in tracks.items() if track.child}
    leading = [n for n, child in children.items() if not known or tree.mounted_on(child) == top]
    return leading[0] if len(leading) == 1 else ""


def topic_poses(name: str, track: Track, tree: TransformTree, sensor: str, request: Request) -> FindPoses:
    """Poses of a topic: of the frame that it names, or else of the one that moves with the sensor."""
    notes = request.notes
    request.refuse(f"the poses are those of {name}, and not of TF", "world_frame")
    trajectory = track.trajectory(name, request)
    notes.add(f"poses: {len(trajectory.times_s)} of {name}")
    if request.extrinsic is not None:
        return tree.attach(trajectory, sensor, request)
    child = track.child
    base = child or tree.mounted_on(sensor)
    if tree.mounted_on(base) != tree.mounted_on(sensor) or (not child and base == sensor):
        notes.add(
            f"no extrinsic is known between the frame of {name}, {child or '(unnamed)'}, and that of the scans, "
            f"{sensor or '(unnamed)'}: the poses are taken as those of the radar; give extrinsic if they are not"
        )
        base = sensor
    elif base != sensor:
        notes.add(f"extrinsic of the poses of {name}: of the static transforms, {base} -> {sensor}")
    return tree.attach(trajectory, base, request)


def tree_poses(tree: TransformTree, sensor: str, request: Request) -> FindPoses:
    """Poses of the frames below the world. Raises a ValueError if TF has none of the sensor."""
    about, moving = request.notes.about, tree.moving
    what = "TF that moves" if tree.tracks else "Odometry, PoseStamped, Path or TF"
    remedy = f"give a file of poses, such as TUM; {pose_files.FIND_POSES}"
    check(moving, f"{about} has no poses ({what}): {remedy}", pose_files.NoPoses)
    base = sensor
    if request.extrinsic is not None or sensor not in tree.tracks:
        lowest = moving - {above for frame in moving for above in tree.chain(frame)[1:]}
        frames = ", ".join(sorted(tree.tracks))
        known = request.extrinsic is not None and len(lowest) == 1
        what = f"{sensor or '(unnamed)'}: they have {frames}; give extrinsic"
        check(known, f"{about}: the transforms do not lead to the frame of the scans, {what}")
        (base,) = lowest
    chain = tree.chain(base)
    world = chain[-1] if request.world_frame is None else request.world_frame.lstrip("/")
    check(world in chain, f"world_frame {world} is not above {base}, whose frames are {' -> '.join(chain)}")
    below = chain[: chain.index(world)]
    still = f"no transform between {world} and {base} moves: TF has no poses of the radar"
    check(moving & set(below), f"{about}: {still}", pose_files.NoPoses)
    find = tree.finder(world, request)
    poses = find(base)
    check(poses, f"{about}: a transform between {world} and {base} has a single pose")
    request.notes.add(f"poses: TF, {' -> '.join([world, *reversed(below)])}")
    return tree.attach(poses, sensor, request) if poses and request.extrinsic is not None else find
