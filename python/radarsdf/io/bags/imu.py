# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Inertial measurements in bags, by the clock of the scans."""

from __future__ import annotations

from array import array
from pathlib import Path

import numpy as np

from radarsdf.io.bags.files import Topic, by_record, read_messages, topics_with
from radarsdf.io.bags.messages import IMU, Header, ImuMessage
from radarsdf.io.bags.tf import transforms_in
from radarsdf.io.imu import Imu
from radarsdf.io.recordings import Request

__all__ = ["imu_in_bags", "imu_topic"]


def imu_topic(topics: dict[str, Topic], request: Request) -> Topic | None:
    """The topic of the IMU: the wanted one, or the only one. None: there is none, or none is named of several."""
    fitting = topics_with([IMU], topics)
    listed = ", ".join(sorted(fitting))
    if request.imu_topic is not None:
        if request.imu_topic not in fitting:
            msg = f"{request.notes.about} has no inertial measurements in {request.imu_topic}: topics that have some are {listed or 'none'}"
            raise ValueError(msg)
        return fitting[request.imu_topic]
    if len(fitting) > 1:
        request.notes.add(
            f"there are several topics of IMUs, of which none is used: say by imu_topic which, of {listed}"
        )
    return next(iter(fitting.values())) if len(fitting) == 1 else None


def imu_in_bags(
    paths: list[Path],
    topic: Topic,
    sensor_frame: str,
    recorded_scans: bool,
    request: Request,
) -> Imu | None:
    """What the topic holds; None if it has no gyroscope.

    `recorded_scans`: scans have the times when they were recorded. Then each measurement has its stamp plus the median time
    from stamp to record, because messages of an IMU are recorded several at a time.
    """
    stamps_s, recorded_s, rates, forces = (array("d") for _ in range(4))
    first: Header | None = None
    for message in read_messages(paths, {topic.name}, request.notes):
        measured: ImuMessage = message.content
        if measured.angular_velocity is None:
            request.notes.add(f"{topic.name} has no angular velocity: it is not used")
            return None
        first = measured.header if first is None else first
        stamps_s.append(measured.header.stamp_s)
        recorded_s.append(message.recorded_s)
        rates.extend(measured.angular_velocity)
        forces.extend(measured.specific_force or (np.nan,) * 3)
    stamps, recorded = np.array(stamps_s), np.array(recorded_s)
    times_s = recorded
    if not by_record(stamps, topic.name, None, None if recorded_scans else request.notes):
        times_s = stamps + np.median(recorded - stamps) if recorded_scans else stamps
    table = np.column_stack([np.array(rates).reshape(-1, 3), np.array(forces).reshape(-1, 3)])
    order = np.argsort(times_s, kind="stable")
    finite = order[np.isfinite(table[order, :3]).all(axis=1)]
    if len(finite) == 0:
        return None
    table = table[finite]
    has_force = np.isfinite(table).all() and table[:, 3:].any()
    R_sensor_imu = request.R_sensor_imu
    if R_sensor_imu is None and first is not None and first.frame:
        T_imu_sensor = transforms_in(paths, request).fixed(first.frame, sensor_frame)
        R_sensor_imu = None if T_imu_sensor is None else T_imu_sensor[:3, :3].T
    return Imu(times_s[finite], table[:, :3], table[:, 3:] if has_force else None, R_sensor_imu)
