"""Scans, poses and inertial measurements from bags: choice of topics and clocks, and streaming in bounded memory."""

import heapq
import itertools
import re
from array import array
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import closing
from dataclasses import replace
from functools import partial
from os import PathLike
from pathlib import Path

import numpy as np

from radarsdf.arrays import Floats
from radarsdf.checks import check
from radarsdf.io import bag_messages
from radarsdf.io.bag_messages import Clock, Message, Topic, is_bag, read_messages, topics_with
from radarsdf.io.bag_poses import poses_in_bags, transforms_in
from radarsdf.io.poses import UNPOSED, NumberedPoses, Poses, poses_of
from radarsdf.io.recordings import FindPoses, RawScan, Request, posed, poses_on, scan_poses
from radarsdf.rig import Imu
from radarsdf.scans import Scans

# Topics of the radars in data sets, and of their poses. They take precedence over others.
KNOWN_TOPICS = {
    "/hugin_raf_1/radar_data": "/icp_odom",  # Viking Hill
    "/radar_enhanced_pcl": None,  # NTU4DRadLM and others with an Oculii Eagle
    "/radar_enhanced_pcl2": None,  # SNAIL-Radar
    "/ti_mmwave/radar_scan_pcl": None,
}
_RADAR = re.compile(r"radar|ars_?\d{3}|srr_?\d{3}|oculii|mmwave", re.IGNORECASE)
_PEEKED_SCANS = 10  # whose stamps and fields are inspected first


def read_bags(paths: list[Path], request: Request) -> Scans:
    """Read scans of one drive from one or several bags; see :func:`radarsdf.io.read`."""
    others = ", ".join(str(path) for path in paths if not is_bag(path)) or "an empty list"
    check(paths and all(map(is_bag, paths)), f"{others} is not a bag: only bags can be read together")
    request.refuse(f"{request.notes.about}: messages have names of columns", "columns")
    topics = bag_messages.topics_of(paths)
    scan_topics = _scan_topics(topics, request)
    peeked: dict[str, list[Message]] = {}
    for name in (topic.name for topic in scan_topics):
        with closing(read_messages(paths, {name}, request.notes)) as messages:
            peeked[name] = list(itertools.islice(messages, _PEEKED_SCANS))
        check(peeked[name], f"{paths[0]}: {name} has no messages that can be read{request.notes.ending()}")
    counted = Counter(cloud.frame for clouds in peeked.values() for cloud in clouds)
    frames = [frame for frame, _ in counted.most_common()]
    clocks = {}
    for name, clouds in peeked.items():
        times_s = np.array([(cloud.stamp_s, cloud.recorded_s) for cloud in clouds]).T
        clocks[name] = Clock.of(times_s, name, request.stamps, request.notes)

    poses = request.poses
    in_bag = poses is None or (isinstance(poses, (str, PathLike)) and is_bag(Path(poses)))
    radars = _Radars(paths, scan_topics, frames, request, partly=in_bag)

    def raw_scans() -> Iterator[RawScan]:
        streams = [_raw_scans(paths, topic, clocks[topic.name], request) for topic in scan_topics]
        return map(radars.labelled, heapq.merge(*streams, key=lambda raw: raw.time_s or 0.0))

    def find_given(known: Poses) -> FindPoses:
        """Poses passed by the user, of the body of several radars or else of the most frequent frame among the first scans."""
        mounted = {} if request.extrinsic is not None else radars.mounted
        if isinstance(known, (np.ndarray, NumberedPoses)):  # in the order of the scans
            count = scan_topics[0].num_messages if len(scan_topics) == 1 else sum(1 for _ in raw_scans())
            numbered_poses, _ = scan_poses(known, count, None, request.extrinsic, request)
            of_frames = {frame: poses_on(numbered_poses, T) for frame, T in mounted.items()}
            return of_frames.get if of_frames else lambda _: numbered_poses
        if known is UNPOSED:
            return lambda _: known
        return transforms_in(paths, request).attach(known, radars.body if mounted else frames[0], request)

    if in_bag:
        pose_paths = paths if poses is None else [Path(poses)]
        find = poses_in_bags(pose_paths, request, frames, KNOWN_TOPICS.get(scan_topics[0].name))
    else:
        request.refuse("poses are given", "pose_topic", "world_frame")
        find = find_given(poses_of(poses, request.notes))
    imu_topic, recorded = _imu_topic(topics, request), clocks[scan_topics[0].name].recorded
    imu = partial(_read_imu, paths, imu_topic, radars.body, recorded, request) if imu_topic else lambda: None
    source = partial(posed, raw_scans, find, request)
    return Scans.of_source(source, request.notes, imu=imu, mountings=partial(radars.mountings, find))


class _Radars:
    def __init__(
        self, paths: list[Path], topics: list[Topic], frames: list[str], request: Request, *, partly: bool
    ) -> None:
        """Find the mountings of several radars in TF; `partly`: even if others are unknown."""
        self.one_topic, self.several = len(topics) == 1, len(topics) > 1 or len(frames) > 1
        self.body = frames[0]  # frame to which all are attached, or else the most frequent one of the scans
        self.mounted: dict[str, Floats] = {}  # T_body_sensor (4, 4) by frame; empty if they are unknown
        self.frames: dict[str, str] = {}  # by label, of the scans read so far
        if not self.several:
            return
        body, mounted = transforms_in(paths, request).mountings(frames)
        # A frame that topics share does not tell where their radars are.
        if len(frames) >= len(topics) and (partly or len(mounted) == len(frames)):
            self.body, self.mounted = body, mounted
        listed = ", ".join(self.mounted or frames)
        found, of_radars = f"no mountings are known of {listed}", "each radar"
        if self.mounted:
            found, of_radars = f"mountings: TF, {body} -> {listed}", self.body
        request.notes.add(f"{found}: poses are those of {of_radars}")

    def labelled(self, raw: RawScan) -> RawScan:
        """Label a scan of several radars by its topic or, of one topic, by its frame."""
        if not self.several:
            return raw
        label = raw.frame if self.one_topic else raw.topic
        if self.frames.setdefault(label, raw.frame) != raw.frame:
            label = f"{raw.topic} {raw.frame}"
            self.frames[label] = raw.frame
        return replace(raw, sensor=label, number=raw.number if self.one_topic else None)

    def mountings(self, find: FindPoses) -> dict[str, Floats] | None:
        """T_body_sensor by label, of several radars whose scans have poses; None unless all are known."""
        frames = {label: frame for label, frame in self.frames.items() if find(frame) is not None}
        known = {label: self.mounted[frame] for label, frame in frames.items() if frame in self.mounted}
        return known if self.several and len(known) == len(frames) else None


def _scan_topics(topics: dict[str, Topic], request: Request) -> list[Topic]:
    about = request.notes.about
    fitting = topics_with(bag_messages.CLOUD_TYPES, topics)
    for name in request.topic:
        what = f"{name} has messages {topics[name].message_type}" if name in topics else f"no topic {name}"
        check(name in fitting, f"{about}: {what}: topics with points: {_listed(fitting.values()) or 'none'}")
    if request.topic:
        return [fitting[name] for name in dict.fromkeys(request.topic)]
    check(fitting, f"{about} has no topic with points: it has {_listed(topics.values()) or 'no topics'}")
    decoded = [t for t in fitting.values() if t.message_type != bag_messages.PACKETS] or [*fitting.values()]
    known = [topic for topic in decoded if topic.name in KNOWN_TOPICS]
    candidates = (decoded, known, [topic for topic in decoded if _is_radar(topic)])
    chosen = next((topics for topics in candidates if len(topics) == 1), [])
    listed = _listed(fitting.values())
    check(chosen, f"{about} has several topics with points: choose one or several with topic, of {listed}")
    unread = [t for t in topics.values() if t.name not in fitting and _RADAR.search(t.message_type)]
    what = f"messages of the radar cannot be read, {_listed(unread)}: give topic {chosen[0].name} to map that one"
    check(not unread or _is_radar(chosen[0]), f"{about}: {what}")
    if others := {*fitting.values(), *unread} - set(chosen):
        request.notes.add(f"scans: those of {_listed(chosen)}; not read: {_listed(others)}")
    return chosen


def _listed(topics: Iterable[Topic]) -> str:
    return ", ".join(f"{t.name} ({t.message_type})" for t in sorted(topics))


def _is_radar(topic: Topic) -> bool:
    return bool(_RADAR.search(f"{topic.name} {topic.message_type}"))


def _raw_scans(paths: list[Path], topic: Topic, clock: Clock, request: Request) -> Iterator[RawScan]:
    for message in read_messages(paths, {topic.name}, request.notes):
        time_s = float(clock.times(message.stamp_s, message.recorded_s))
        name = f"{message.bag}: message {message.number} of {topic.name}"
        yield RawScan(partial(dict, message.content), time_s, name, message.frame, topic.name, message.number)


def _imu_topic(topics: dict[str, Topic], request: Request) -> str | None:
    fitting = sorted(topics_with([bag_messages.IMU], topics))
    listed = ", ".join(fitting)
    wanted, about = request.imu_topic, request.notes.about
    check(wanted in (None, *fitting), f"{about} has no inertial measurements in {wanted}: there are {listed}")
    if wanted is None and len(fitting) > 1:
        request.notes.add(f"of several IMUs, none is used: choose one with imu_topic, of {listed}")
        return None
    return wanted or next(iter(fitting), None)


def _read_imu(bags: list[Path], topic: str, radar_frame: str, recorded: bool, request: Request) -> Imu | None:
    # Record times (`recorded`) are stamps plus their median delay, because IMU messages are recorded in batches.
    numbers, frame = array("d"), ""
    for message in read_messages(bags, {topic}, request.notes):
        rates, force = message.content
        if rates is None:
            request.notes.add(f"{topic} has no angular velocity: it is not used")
            return None
        frame = frame or message.frame
        numbers.extend((message.stamp_s, message.recorded_s, *rates, *(force or (np.nan,) * 3)))
    table = np.array(numbers).reshape(-1, 8)
    table = table[np.isfinite(table[:, :5]).all(axis=1)]
    if len(table) == 0:
        return None
    times_s = Clock.of(table[:, :2].T, topic, None, request.notes).times(*table[:, :2].T)
    if recorded:
        times_s = times_s + np.median(table[:, 1] - times_s)
    order = np.argsort(times_s, kind="stable")
    forces = table[order, 5:]
    has_force = np.isfinite(forces).all() and forces.any()
    R_sensor_imu = request.R_sensor_imu
    if R_sensor_imu is None and frame:
        tree = transforms_in(bags, request)
        (top, T_top_imu), (other, T_top_sensor) = tree.rigid_top(frame), tree.rigid_top(radar_frame)
        if top == other:  # both are attached to it
            R_sensor_imu = (np.linalg.inv(T_top_imu) @ T_top_sensor)[:3, :3].T
    return Imu(times_s[order], table[order, 2:5], forces if has_force else None, R_sensor_imu)
