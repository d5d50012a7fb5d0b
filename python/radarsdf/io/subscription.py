"""Scans of running ROS 2 topics, with poses of TF or odometry."""

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from radarsdf.arrays import Floats
from radarsdf.checks import check
from radarsdf.io import bag_messages
from radarsdf.io.bag_messages import Clock, Message, decode
from radarsdf.io.bag_poses import Track, Tracks, TransformTree, topic_poses, tree_poses
from radarsdf.io.dds import QUEUED, Node
from radarsdf.io.poses import UNPOSED, NoPoses
from radarsdf.io.recordings import FindPoses, RawScan, Request, posed
from radarsdf.rig import Label
from radarsdf.scans import Notes, Scan

_KEPT_POSES = 1000  # of each frame: tf2 keeps those of 10 s
_SET_BACK_S = 1.0  # more than poses of several nodes are out of order
_PATIENCE_S = 3.0  # for poses of the first scan, and until it is reported what is missing
_STEP_S = 0.01
_STATIC = "/tf_static"


class _RecentTrack(Track):
    """The last poses of a frame. One that stands still may move again: only static transforms are constant."""

    def add(self, numbers: tuple[float, ...]) -> None:
        if self.numbers and numbers[0] < self.numbers[-9] - _SET_BACK_S:
            del self.numbers[:]  # the clock was set back: as tf2, forget the poses before
        super().add(numbers)
        if len(self.numbers) > 2 * 9 * _KEPT_POSES:
            del self.numbers[: -9 * _KEPT_POSES]
        for cached in ("table", "matrix"):
            vars(self).pop(cached, None)

    @property
    def constant(self) -> bool:
        return self.static


class _Known(NamedTuple):
    tree: TransformTree
    topic: Track | None  # of the poses, if they are those of a topic
    find: FindPoses
    error: ValueError | None  # why no frame has poses
    notes: list[str]


class Subscription:
    """Scans of running topics, with poses of a topic or of TF; with `find`, or if TF has none, `unposed`. Iteration ends when `stopped`.

    A thread receives scans and poses, and keeps the last scans until they are taken.
    """

    def __init__(
        self,
        node: Node,
        topics: Sequence[str],
        request: Request,
        find: bool,
        stopped: Callable[[], bool],
        report: Callable[[str], None],
    ) -> None:
        self.node, self._topics, self._request = node, list(dict.fromkeys(topics)), request
        self._stopped, self._report, self.unposed = stopped, report, find
        self._tracks = Tracks(_RecentTrack)
        self._frames: dict[str, str] = {}  # by topic of scans
        self._latest: _Known | None = None  # None since a pose or a first scan arrived
        self._readers: dict[str, tuple[str, Any]] = {}
        self._clocks: dict[str, Clock] = {}
        self._error: Exception | None = None
        self._queue: deque[tuple[float, RawScan]] = deque(maxlen=QUEUED * len(self._topics))
        self.dropped = 0  # scans that arrived faster than they were taken, or before the mountings
        self.unplaced = 0  # scans without a pose
        self._lock = threading.RLock()
        threading.Thread(target=self._listen, daemon=True).start()
        self._await_poses()
        self._assumed = self._is_assumed()
        known = self._known()
        for line in () if self.unposed else known.notes:
            request.notes.add(line)
        self.T_body_sensor = self._mounted() or None
        self.world = request.world_frame or "map"
        if not self.unposed and self._frames:
            root = known.tree.chain(next(iter(self._frames.values())))[-1]
            self.world = known.topic.parent if known.topic else request.world_frame or root

    def carrier(self, label: Label | None) -> tuple[str, Floats, bool]:
        """Return the highest frame that TF attaches rigidly to a radar, T_carrier_sensor (4, 4), and whether others publish its pose."""
        tree = self._known().tree
        top, T_top_sensor = tree.rigid_top(self._frames[self._topics[0] if label is None else str(label)])
        return top, T_top_sensor, top in tree.tracks

    def remounted(self) -> bool:
        """Whether static transforms arrived only now, and the poses of a topic were taken as those of the radar meanwhile."""
        before, self._assumed = self._assumed, self._is_assumed()
        return before and not self._assumed

    def _is_assumed(self) -> bool:
        tree, topic, *_ = self._known()
        if topic is None or self._request.extrinsic is not None or not self._frames:
            return False
        sensor = next(iter(self._frames.values()))
        top = tree.mounted_on(sensor)
        return tree.mounted_on(topic.child) != top if topic.child else top == sensor

    def __iter__(self) -> Iterator[Scan]:
        """Yield scans, with poses of the body if there are mountings, and note at the end what was left out."""
        mounted = self.T_body_sensor
        for scan in posed(self._raw_scans, self._find, self._request):
            self.unplaced -= 1
            if mounted is None:
                yield replace(scan, sensor=None)
            else:
                T = scan.T_world_sensor @ np.linalg.inv(mounted[scan.sensor])
                yield replace(scan, T_world_sensor=T)
        self._request.notes.end_pass()

    def _raw_scans(self) -> Iterator[RawScan]:
        longest_s = self._request.max_gap_s
        while self._queue or not self._stopped():
            if not self._queue:
                self._wait()
                continue
            with self._lock:
                arrived_s, raw = self._queue.popleft()
            while time.monotonic() < arrived_s + longest_s and not self._stopped():
                poses = self._find(raw.frame)
                if poses is None or poses.pose_at(raw.time_s or 0.0, longest_s) is not None:
                    break
                self._wait()  # the pose after the scan is yet to come
            self.unplaced += 1  # until it is
            yield raw

    def _wait(self) -> None:
        """Wait for more messages. Raise the error of the thread, if there is one."""
        if self._error is not None:
            raise self._error
        time.sleep(_STEP_S)

    def _known(self) -> _Known:
        with self._lock:
            self._latest = self._latest or self._derive()
            return self._latest

    def _derive(self) -> _Known:
        request, name = replace(self._request, notes=Notes(logged=False)), self._request.pose_topic
        tree, topics = self._tracks.tree(request), self._tracks.by_topic
        frames = [*self._frames.values(), ""]
        sensor = next((frame for frame in frames if frame in tree.tracks), frames[0])
        find: FindPoses = dict[str, Any]().get  # none of any frame
        error = None
        try:
            if name is None:
                find = tree_poses(tree, sensor, request)
            else:
                check(name in topics, f"{name} has no messages yet")
                find = topic_poses(name, topics[name], tree, sensor, request)
        except ValueError as why:
            error = why
        return _Known(tree, topics.get(name or ""), find, error, request.notes.lines)

    def _find(self, frame: str) -> Any:
        with self._lock:  # it reads poses that arrive meanwhile
            return UNPOSED if self.unposed else self._known().find(frame)

    def _mounted(self) -> dict[Label, Floats]:
        """T_body_sensor by topic, of several radars; empty if TF does not mount all of them on one body."""
        frames = dict(self._frames)
        _, mounted = self._known().tree.mountings([*frames.values()] or [""])
        complete = len(self._topics) > 1 and len(mounted) == len(set(frames.values()))
        return {topic: mounted[frame] for topic, frame in frames.items()} if complete else {}

    def _await_poses(self) -> None:
        """Wait until poses of the scans are known, or that there are none; after a while, report for what."""
        late_s, report_s = np.inf, time.monotonic() + 1.5 * _PATIENCE_S
        while not self._stopped():
            missing = [topic for topic in self._topics if topic not in self._frames]
            why = f"messages of {', '.join(missing)}"
            if not missing:
                late_s = min(late_s, time.monotonic() + _PATIENCE_S)
                why = self._missing(late=time.monotonic() > late_s)
                if not why:
                    return
            if time.monotonic() > report_s:
                report_s = np.inf
                found = self.node.published()
                listed = ", ".join(f"{name} ({', '.join(types)})" for name, types in sorted(found.items()))
                self._report(f"waiting for {why}; DDS domain {self.node.domain} has {listed or 'no topics'}")
            self._wait()

    def _missing(self, *, late: bool) -> str:
        """Return what is missing for the poses of the scans. Only `late`, it is certain that TF has none."""
        known = self._known()
        without = self._request.pose_topic is None and isinstance(known.error, NoPoses)
        if late and without and not self.unposed:
            self.unposed = True
            self._request.notes.add("TF has no poses of the radar: they are estimated from its returns")
        if len(self._topics) > 1 and (self.unposed or known.topic) and not self._mounted():
            return f"static transforms that mount {', '.join(self._frames.values())} on one body"
        if self.unposed:
            return ""
        if known.error is not None:
            return str(known.error)
        unposed = [frame for frame in self._frames.values() if known.find(frame) is None]
        if unposed:
            return f"transforms from the poses to {', '.join(unposed)}"
        # Static transforms may arrive after odometry.
        attached = known.tree.tracks.keys() >= set(self._frames.values())
        return "" if late or attached else "static transforms of the radars"

    def _listen(self) -> None:
        next_s = 0.0
        try:
            while not self._stopped():
                if time.monotonic() > next_s:
                    self._subscribe()
                    next_s = time.monotonic() + 0.2
                for topic, (message_type, reader) in self._readers.items():
                    for sample in reader.take(QUEUED):
                        if sample.sample_info.valid_data:
                            self._receive(topic, message_type, sample)
                time.sleep(_STEP_S)
        except Exception as error:  # noqa: BLE001 - raised in the thread that waits
            self._error = error

    def _subscribe(self) -> None:
        wanted: dict[str, tuple[str, ...]] = dict.fromkeys(("/tf", _STATIC), bag_messages.TRANSFORM_TYPES)
        wanted |= dict.fromkeys(self._topics, bag_messages.CLOUD_TYPES)
        if self._request.pose_topic is not None:
            wanted[self._request.pose_topic] = bag_messages.POSE_TYPES
        found = self.node.published()
        for topic in (wanted.keys() & found.keys()) - self._readers.keys():
            fitting = sorted(found[topic].keys() & set(wanted[topic]))
            listed = ", ".join(sorted(found[topic]))
            check(fitting, f"{topic} has messages {listed}; it must have one of {', '.join(wanted[topic])}")
            kind = fitting[0]
            reader = self.node.reader(topic, kind, reliable=found[topic][kind], latched=topic == _STATIC)
            self._readers[topic] = kind, reader

    def _receive(self, topic: str, message_type: str, sample: Any) -> None:
        recorded_s = 1e-9 * sample.sample_info.source_timestamp
        try:
            stamp_s, frame, content = decode(sample.data, message_type)
        except Exception as error:  # noqa: BLE001 - damaged messages raise exceptions of many kinds
            what = f"{topic} at {recorded_s:.3f} s, no complete {message_type}: {error}"
            self._request.notes.count("messages left out: they cannot be decoded", example=what)
            return
        if topic not in self._topics:
            self._add(Message(Path(), topic, message_type, recorded_s, 0, stamp_s, frame, content))
            return
        if topic not in self._clocks:
            both = np.array([[stamp_s], [recorded_s]])
            self._clocks[topic] = Clock.of(both, topic, self._request.stamps, self._request.notes)
        time_s = float(self._clocks[topic].times(stamp_s, recorded_s))
        label = topic if len(self._topics) > 1 else None
        name = f"{topic} at {time_s:.3f} s"
        raw = RawScan(partial(dict, content), time_s, name, frame, topic, sensor=label)
        with self._lock:
            if topic not in self._frames:
                self._frames[topic], self._latest = frame, None
            self.dropped += len(self._queue) == self._queue.maxlen
            self._queue.append((time.monotonic(), raw))

    def _add(self, poses: Message) -> None:
        with self._lock:
            self._latest = None
            self._tracks.add(poses)
