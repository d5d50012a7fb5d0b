# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The transforms between the frames of a bag (TF), as a tree."""

from __future__ import annotations

from array import array
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property, reduce
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from radarsdf.io.bags.files import by_record, read_messages, topics_of, topics_with
from radarsdf.io.bags.messages import PATH, TRANSFORM_TYPES, PoseMessage
from radarsdf.io.poses.trajectory import Trajectory, are_poses, pose_matrices_of, trajectory_of
from radarsdf.io.recordings import Request
from radarsdf.io.scans import Notes

_STATIC = "static"  # in the name of a topic whose transforms hold for all times: /tf_static
_SAME = 1e-9  # a transform that changes by no more is constant, though it is published again and again


@dataclass
class Track:
    """The poses of one frame in another, as they were recorded."""

    parent: str
    child: str = ""
    """Empty where the messages do not name it."""
    static: bool = False
    numbers: array[float] = field(default_factory=lambda: array("d"))
    """Of each pose: stamp, record time, x, y, z, qx, qy, qz, qw."""

    def add(self, pose: PoseMessage, recorded_s: float) -> None:
        """Adds a pose of a message."""
        self.child = pose.child
        self.numbers.extend((pose.header.stamp_s, recorded_s, *pose.values))

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

    def trajectory(self, name: str, request: Request, notes: Notes | None = None) -> Trajectory:
        """The poses by time. Damaged ones are left out, and noted."""
        table, usable = self.table, self.usable
        if notes is not None and not usable.all():
            first = int(np.argmin(usable))
            notes.add(
                f"poses of {name} left out: {(~usable).sum()} of {len(usable)} are not finite, or have no unit quaternion; "
                f"the first, pose {first}, was recorded at {table[first, 1]:.3f} s"
            )
        clock = int(by_record(table[:, 0], name, request.stamps, notes))
        return trajectory_of(table[usable][:, [clock, *range(2, 9)]], name)


class TransformTree:
    """Frames, each with the transform from its parent."""

    def __init__(self, edges: Mapping[str, Track]) -> None:
        self.edges = edges
        """By child."""

    def __contains__(self, frame: str) -> bool:
        """Whether a frame has a parent."""
        return frame in self.edges

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

    def moving(self) -> list[str]:
        """The frames that move in their parents."""
        return [frame for frame, track in self.edges.items() if not track.constant]

    def lowest_moving(self) -> set[str]:
        """Those of them with no other moving frame below."""
        moving = self.moving()
        return set(moving) - {above for frame in moving for above in self.chain(frame)[1:]}

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
    topics = set(topics_with(TRANSFORM_TYPES, topics_of(paths)))
    return tracks_and_transforms(paths, set(), topics, request)[1]


def tracks_and_transforms(
    paths: list[Path], pose_topics: set[str], transform_topics: set[str], request: Request
) -> tuple[dict[str, Track], TransformTree]:
    """The poses of each of `pose_topics` that has some, and the transforms, in one pass through the bags."""
    by_topic: dict[str, Track] = {}
    parents: dict[str, dict[str, Track]] = {}
    for message in read_messages(paths, pose_topics | transform_topics, request.notes):
        if message.message_type == PATH:  # each message holds the whole path so far: the last one counts
            by_topic.pop(message.topic, None)
        static = _STATIC in message.topic
        for pose in message.content:
            if message.topic in transform_topics:
                tracks, key = parents.setdefault(pose.child, {}), pose.header.frame
            else:
                tracks, key = by_topic, message.topic
            if key not in tracks:
                tracks[key] = Track(pose.header.frame, static=static)
            tracks[key].add(pose, message.recorded_s)
    return by_topic, _tree(parents, request)


def _tree(parents: Mapping[str, Mapping[str, Track]], request: Request) -> TransformTree:
    """Of several parents of a frame, the one with transforms for the longest time under which the frame moves."""
    options_of = {}
    for child, tracks in parents.items():
        usable = [track for track in tracks.values() if track.usable.any()]
        usable.sort(key=lambda track: track.extent(request.max_gap_s), reverse=True)
        if usable:
            options_of[child] = usable
    edges = {child: options[0] for child, options in options_of.items()}
    for child, options in options_of.items():
        if len(options) > 1:
            moving = (
                t for t in options if TransformTree({**edges, child: t}).moves(child, request.world_frame)
            )
            edges[child] = next(moving, options[0])
            listed = ", ".join(f"{track.parent} ({len(track.table)} transforms)" for track in options)
            request.notes.add(f"{child} has several parents in TF, {listed}: {edges[child].parent} is used")
    return TransformTree(edges)
