# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Scans with poses from bags: which topics, which clock, and the first message to the last in bounded memory."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from contextlib import closing
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from radarsdf.io.bags.files import Topic, bags_in, is_bag, messages_of, topics_of, topics_with
from radarsdf.io.bags.imu import imu_in_bags, imu_topic
from radarsdf.io.bags.messages import CLOUD_TYPES, POINT_A_MESSAGE, CloudMessage
from radarsdf.io.bags.poses import poses_in_bags
from radarsdf.io.clouds.reading import Columns
from radarsdf.io.imu import Imu
from radarsdf.io.poses.reading import ScanPoses, poses_of
from radarsdf.io.scans import Scans
from radarsdf.io.sources import RawScan, Request, posed, scan_poses

__all__ = ["bags_in", "is_bag", "read_bags"]

KNOWN_TOPICS = {
    "/hugin_raf_1/radar_data": "/icp_odom",  # Viking Hill
    "/radar_enhanced_pcl": None,  # NTU4DRadLM and others with an Oculii Eagle
    "/radar_enhanced_pcl2": None,  # SNAIL-Radar
    "/ti_mmwave/radar_scan_pcl": None,
}
"""Topics of radars in data sets, and of the poses there. They are preferred to others."""

_PAUSE_S = 0.02  # the points of a scan are sent at once; scans are 30 ms apart or more
_PEEKED_SCANS, _PEEKED_POINTS = 10, 400  # messages that are looked at for the clock: several scans


def read_bags(paths: list[Path], request: Request) -> Scans:
    """Scans of one drive in one or several bags; see :func:`radarsdf.io.read`."""
    if not paths:
        msg = "there is no bag to read: the list is empty"
        raise ValueError(msg)
    for path in paths:
        if not is_bag(path):
            msg = f"{path} is no bag: only bags can be read together"
            raise ValueError(msg)
    topics = topics_of(paths)
    topic = _scan_topic(topics, request.topic, paths)
    peeked = _peek(paths, topic)
    by_record = _by_record(peeked, topic, request)
    poses: Any = request.poses
    T_base_sensor = request.extrinsic
    if poses is None or _is_bag_of_poses(poses):
        pose_paths = paths if poses is None else [Path(poses)]
        poses, T_base_sensor = poses_in_bags(
            pose_paths, request, peeked[0].header.frame, KNOWN_TOPICS.get(topic.name)
        )
    else:
        poses = poses_of(poses, request.notes)

    def raw_scans() -> Iterator[RawScan]:
        return _raw_scans(paths, topic, by_record)

    if isinstance(poses, np.ndarray):
        count = sum(1 for _ in raw_scans()) if topic.message_type == POINT_A_MESSAGE else topic.count
        matched, _ = scan_poses(poses, count, None, T_base_sensor, request)
    else:
        matched = ScanPoses(poses, np.eye(4) if T_base_sensor is None else T_base_sensor, request.max_gap_s)
    of_imu = imu_topic(topics, request)

    def imu() -> Imu | None:
        if of_imu is None:
            return None
        return imu_in_bags(paths, topics, of_imu, peeked[0].header.frame, by_record, request)

    truth = request.truth or (lambda: None)
    return Scans.of_source(posed(raw_scans, matched, request), request.notes, truth, imu)


def _is_bag_of_poses(poses: Any) -> bool:
    return isinstance(poses, (str, PathLike)) and is_bag(Path(poses))


def _scan_topic(topics: dict[str, Topic], wanted: str | None, paths: list[Path]) -> Topic:
    """The topic of the scans: the wanted one, or the only one that can be meant."""
    where = paths[0] if len(paths) == 1 else f"{paths[0]} and {len(paths) - 1} more"
    fitting = topics_with(CLOUD_TYPES, topics)
    listed = ", ".join(f"{name} ({t.message_type})" for name, t in sorted(fitting.items()))
    if wanted is not None:
        if wanted in fitting:
            return fitting[wanted]
        if wanted in topics:
            msg = f"{where}: {wanted} has messages {topics[wanted].message_type}, or none; scans are {', '.join(CLOUD_TYPES)}"
        else:
            msg = f"{where} has no topic {wanted}: topics with points are {listed or 'none'}"
        raise ValueError(msg)
    if not fitting:
        found = ", ".join(f"{name} ({t.message_type})" for name, t in sorted(topics.items()))
        msg = f"{where} has no topic with points ({', '.join(CLOUD_TYPES)}): it has {found or 'no topics'}"
        raise ValueError(msg)
    choices: tuple[list[Topic], ...] = (
        list(fitting.values()),
        [t for name, t in fitting.items() if name in KNOWN_TOPICS],
        [t for name, t in fitting.items() if "radar" in name.lower() or "radar" in t.message_type.lower()],
    )
    for choice in choices:
        if len(choice) == 1:
            return choice[0]
    msg = f"{where} has several topics with points: say by topic which is the radar's, of {listed}"
    raise ValueError(msg)


def _peek(paths: list[Path], topic: Topic) -> list[CloudMessage]:
    """The first messages of a topic, as many as it takes to know its clock."""
    count = _PEEKED_POINTS if topic.message_type == POINT_A_MESSAGE else _PEEKED_SCANS
    with closing(messages_of(paths, {topic.name})) as messages:
        peeked = [message.read() for message in itertools.islice(messages, count)]
    if not peeked:
        msg = f"{paths[0]}: the topic {topic.name} has no messages"
        raise ValueError(msg)
    return peeked


def _by_record(peeked: list[CloudMessage], topic: Topic, request: Request) -> bool:
    """Whether the times of scans are when they were recorded: as wanted, or where stamps are zero or stand still."""
    if request.stamps is not None:
        return request.stamps == "record"
    stamps = [cloud.header.stamp_s for cloud in peeked]
    if not any(stamps):
        request.notes.add(f"the header stamps of {topic.name} are zero: the record time is used instead")
        return True
    if len(stamps) > 1 and len(set(stamps)) == 1:
        request.notes.add(f"the header stamps of {topic.name} stand still: the record time is used instead")
        return True
    return False


def _raw_scans(paths: list[Path], topic: Topic, by_record: bool) -> Iterator[RawScan]:
    if topic.message_type == POINT_A_MESSAGE:
        yield from _grouped(paths, topic, by_record)
        return
    for number, message in enumerate(messages_of(paths, {topic.name})):
        cloud: CloudMessage = message.read()
        time_s = message.recorded_s if by_record else cloud.header.stamp_s
        yield RawScan(cloud.columns, time_s, f"{message.bag}: message {number} of {topic.name}")


def _grouped(paths: list[Path], topic: Topic, by_record: bool) -> Iterator[RawScan]:
    """Scans of messages of one point each. A scan begins where the number of the point does not grow, or after a pause."""
    points: list[CloudMessage] = []
    last, last_s, start_s, number = -1, 0.0, 0.0, 0
    for message in messages_of(paths, {topic.name}):
        cloud: CloudMessage = message.read()
        point_id = -1 if cloud.point_id is None else cloud.point_id
        if points and (point_id <= last or message.recorded_s > last_s + _PAUSE_S):
            yield _joined(points, start_s, f"{message.bag}: scan {number} of {topic.name}")
            points, number = [], number + 1
        if not points:
            start_s = message.recorded_s if by_record else cloud.header.stamp_s
        points.append(cloud)
        last, last_s = point_id, message.recorded_s
    if points:
        yield _joined(points, start_s, f"{paths[-1]}: scan {number} of {topic.name}")


def _joined(points: list[CloudMessage], time_s: float, name: str) -> RawScan:
    def columns() -> Columns:
        rows = [point.columns() for point in points]
        return {field: np.concatenate([row[field] for row in rows]) for field in rows[0]}

    return RawScan(columns, time_s, name)
