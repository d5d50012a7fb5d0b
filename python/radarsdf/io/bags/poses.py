# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Poses in bags: of odometry, stamped poses, a path, or the tree of transforms (TF)."""

from __future__ import annotations

from array import array
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from radarsdf.io.bags.files import Topic, messages_of, topics_of, topics_with
from radarsdf.io.bags.messages import PATH, POSE_TYPES, TRANSFORM_TYPES, PoseMessage
from radarsdf.io.poses.reading import FIND_POSES, NoPoses, StampedPoses, TransformChain, trajectory_of
from radarsdf.io.poses.trajectory import Trajectory
from radarsdf.io.sources import Request

_STATIC = "static"  # in the name of a topic whose transforms hold for all times: /tf_static
_SAME = 1e-9  # a transform that changes by no more is constant, though it is published again and again


@dataclass
class _Track:
    """The poses of one frame in another, as they come."""

    parent: str
    stamps_s: array[float] = field(default_factory=lambda: array("d"))
    recorded_s: array[float] = field(default_factory=lambda: array("d"))
    values: array[float] = field(default_factory=lambda: array("d"))
    static: bool = False

    def add(self, pose: PoseMessage, recorded_s: float) -> None:
        self.stamps_s.append(pose.header.stamp_s)
        self.recorded_s.append(recorded_s)
        self.values.extend(pose.values)

    def table(self) -> NDArray[np.float64]:
        """(P, 7) x, y, z, qx, qy, qz, qw."""
        return np.frombuffer(self.values, np.float64).reshape(-1, 7)

    def is_constant(self) -> bool:
        table = self.table()
        return self.static or bool((np.abs(table - table[0]) <= _SAME).all())

    def matrix(self) -> NDArray[np.float64]:
        """(4, 4) of a constant transform."""
        table = self.table()
        if not np.isfinite(table[-1]).all() or not table[-1, 3:].any():
            msg = f"a transform from {self.parent} is not finite, or has no rotation"
            raise ValueError(msg)
        pose = np.eye(4)
        pose[:3, 3] = table[-1, :3]
        pose[:3, :3] = Rotation.from_quat(table[-1, 3:]).as_matrix()
        return pose

    def trajectory(self, name: str, request: Request) -> Trajectory:
        stamps = np.frombuffer(self.stamps_s, np.float64)
        if (
            request.stamps == "record"
            or not stamps.any()
            or (len(stamps) > 1 and (stamps == stamps[0]).all())
        ):
            if request.stamps is None:
                request.notes.add(
                    f"the stamps of {name} are zero or stand still: the record time is used instead"
                )
            stamps = np.frombuffer(self.recorded_s, np.float64)
        table = self.table()
        return trajectory_of(stamps, table[:, :3], table[:, 3:], name)


def poses_in_bags(
    paths: list[Path], request: Request, sensor_frame: str, preferred: str | None
) -> tuple[StampedPoses, NDArray[np.float64] | None]:
    """Poses by time in bags.

    Parameters
    ----------
    paths : list of Path
        The bags.
    request : Request
        What the user wants: `pose_topic`, `extrinsic`, `world_frame`, `stamps`. Its notes are told what was chosen.
    sensor_frame : str
        The frame of the scans, as their messages say.
    preferred : str or None
        The topic of poses that is taken before others, if it is there.

    Returns
    -------
    poses : StampedPoses
        T_world_base by time.
    T_base_sensor : (4, 4) ndarray or None
        The `extrinsic`, or that of the static transforms; None where the poses are the sensor's.

    Raises
    ------
    ValueError
        If there are no poses, or several topics that could be meant.
    """
    topics = topics_of(paths)
    transforms = set(topics_with(TRANSFORM_TYPES, topics))
    topic = _pose_topic(topics, transforms, request.pose_topic, preferred, paths[0])
    if topic is None:
        tree = _tree(paths, transforms)
        return _of_tree(tree, sensor_frame, request)
    track = _Track("")
    child = ""
    for message in messages_of(paths, {topic.name}):
        poses: list[PoseMessage] = message.read()
        if topic.message_type == PATH:  # each message holds the whole path so far: the last one counts
            track = _Track("")
        for pose in poses:
            child = pose.child
            track.add(pose, message.recorded_s)
    if not track.values:
        msg = f"{paths[0]}: {topic.name} holds no poses"
        raise ValueError(msg)
    trajectory = track.trajectory(topic.name, request)
    request.notes.add(f"poses: {len(trajectory.times_s)} of {topic.name}")
    if request.extrinsic is not None:
        return trajectory, request.extrinsic
    static = _tree(paths, transforms) if transforms else {}
    return trajectory, _static_extrinsic(static, child, sensor_frame, topic.name, request)


def _pose_topic(
    topics: dict[str, Topic], transforms: set[str], wanted: str | None, preferred: str | None, path: Path
) -> Topic | None:
    """The topic of the poses; None means TF."""
    fitting = topics_with(POSE_TYPES, topics)
    if wanted is not None:
        if wanted in fitting:
            return fitting[wanted]
        if wanted in transforms or (wanted.strip("/") == "tf" and transforms):
            return None
        listed = ", ".join(sorted([*fitting, *transforms]))
        msg = f"{path} has no poses in {wanted}: topics with poses are {listed or 'none'}"
        raise ValueError(msg)
    if preferred in fitting:
        return fitting[preferred]
    if len(fitting) == 1:
        return next(iter(fitting.values()))
    if fitting:
        msg = f"{path} has several topics with poses: say by pose_topic which one counts, of {', '.join(sorted(fitting))}"
        raise ValueError(msg)
    if not transforms:
        msg = f"{path} has no poses (Odometry, PoseStamped, Path or TF): give a file of poses, such as TUM; {FIND_POSES}"
        raise NoPoses(msg)
    return None


def _tree(paths: list[Path], transforms: set[str]) -> dict[str, _Track]:
    """The transform to each frame from its parent."""
    tree: dict[str, _Track] = {}
    for message in messages_of(paths, transforms):
        static = _STATIC in message.topic
        for pose in message.read():
            track = tree.get(pose.child)
            if track is None or track.parent != pose.header.frame:
                track = tree[pose.child] = _Track(pose.header.frame, static=static)
            track.add(pose, message.recorded_s)
    return tree


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


def _of_tree(
    tree: dict[str, _Track], sensor_frame: str, request: Request
) -> tuple[StampedPoses, NDArray[np.float64] | None]:
    moving = [child for child, track in tree.items() if not track.is_constant()]
    base = sensor_frame
    if request.extrinsic is not None or sensor_frame not in tree:
        # The frame that moves and has no other moving frame below it.
        above = {frame for child in moving for frame in _ancestors(tree, child)[1:]}
        lowest = [child for child in moving if child not in above]
        if request.extrinsic is None or len(lowest) != 1:
            msg = (
                f"{request.notes.about}: the transforms do not lead to the frame of the scans, {sensor_frame or '(unnamed)'}: they have "
                f"{', '.join(sorted(tree)) or 'no frames'}; give extrinsic, the pose of the radar in the frame that moves"
            )
            raise ValueError(msg)
        base = lowest[0]
    chain = _ancestors(tree, base)
    if request.world_frame is not None:
        wanted = request.world_frame.lstrip("/")
        if wanted not in chain:
            msg = f"world_frame {wanted} is not above {base}, whose frames are {' -> '.join(chain)}"
            raise ValueError(msg)
        chain = chain[: chain.index(wanted) + 1]
    if not set(chain[:-1]) & set(moving):
        msg = f"{request.notes.about}: no transform between {chain[-1]} and {base} moves: TF has no poses of the radar"
        raise ValueError(msg)
    links = [
        tree[child].matrix()
        if tree[child].is_constant()
        else tree[child].trajectory(f"TF from {tree[child].parent} to {child}", request)
        for child in reversed(chain[:-1])
    ]
    request.notes.add(f"poses: TF, {' -> '.join(reversed(chain))}")
    return TransformChain(tuple(links)), request.extrinsic


def static_between(
    paths: list[Path], transforms: set[str], base: str, sensor: str
) -> NDArray[np.float64] | None:
    """T_base_sensor (4, 4) by the static transforms in topics of bags; None where they do not lead from one to the other."""
    if base and base == sensor:
        return np.eye(4)
    return _fixed(_tree(paths, transforms), base, sensor) if base and transforms else None


def _fixed(tree: dict[str, _Track], base: str, sensor: str) -> NDArray[np.float64] | None:
    """T_base_sensor through frames that do not move against each other. None: there is no such way."""
    up_base, up_sensor = _ancestors(tree, base), _ancestors(tree, sensor)
    common = next((frame for frame in up_sensor if frame in up_base), None)
    if common is None:
        return None
    down = up_sensor[: up_sensor.index(common)]
    up = up_base[: up_base.index(common)]
    if not all(tree[frame].is_constant() for frame in (*down, *up)):
        return None
    return np.linalg.inv(_product(tree, up)) @ _product(tree, down)


def _static_extrinsic(
    tree: dict[str, _Track], base: str, sensor: str, topic: str, request: Request
) -> NDArray[np.float64] | None:
    """T_base_sensor by the static transforms; None where the frames are the same, or it is not known."""
    if base and base == sensor:
        return None
    if base and (extrinsic := _fixed(tree, base, sensor)) is not None:
        request.notes.add(f"extrinsic: of the static transforms, {base} -> {sensor}")
        return extrinsic
    request.notes.add(
        f"no extrinsic is known between the frame of {topic}, {base or '(unnamed)'}, and that of the scans, "
        f"{sensor or '(unnamed)'}: the poses are taken as those of the radar; give extrinsic if they are not"
    )
    return None


def _product(tree: dict[str, _Track], upwards: list[str]) -> NDArray[np.float64]:
    """T_top_frame of constant transforms, from the lowest frame upwards."""
    pose = np.eye(4)
    for frame in upwards:
        pose = tree[frame].matrix() @ pose
    return pose
