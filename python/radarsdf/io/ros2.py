"""Topics of running ROS 2 nodes by DDS, without ROS: scans, poses of TF or odometry, and publishing."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from radarsdf.arrays import Floats
from radarsdf.checks import check
from radarsdf.extras import require
from radarsdf.io import bag_messages
from radarsdf.io.bag_messages import Clock, Message, decode, message_types
from radarsdf.io.bag_poses import Track, Tracks, topic_poses, tree_poses
from radarsdf.io.poses import UNPOSED, NoPoses
from radarsdf.io.recordings import RawScan, Request, posed
from radarsdf.rig import Label
from radarsdf.scans import Notes, Scan

LOOPBACK = "127.0.0.1"
# Peers on this machine by unicast, as rmw_cyclonedds with ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST.
_THIS_MACHINE = (
    "<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>"
    "<MaxAutoParticipantIndex>99</MaxAutoParticipantIndex>"
    '<Peers><Peer address="localhost"/></Peers></Discovery>'
)
_QUEUED = 100  # scans: 5 s of a radar at 20 Hz
_KEPT_POSES = 1000  # of each frame: tf2 keeps those of 10 s
_PATIENCE_S = 3.0  # for poses of the first scan, and until it is reported what is missing
_STEP_S = 0.01
_STATIC = "/tf_static"
_BASIC, _MESSAGE, _ARRAY = 1, 2, 3  # kinds of fields of rosbags; else a sequence


class Node:
    """A participant in a DDS domain, at the interface of address `host`. It exchanges encoded messages."""

    def __init__(self, domain: int, host: str = LOOPBACK) -> None:
        require("rosbags", "cyclonedds", what="topics of ROS 2 need")
        from cyclonedds import builtin, core  # noqa: PLC0415 - an extra
        from cyclonedds.domain import Domain, DomainParticipant  # noqa: PLC0415

        self.domain = domain
        chosen = 'autodetermine="true"' if host == "0.0.0.0" else f'address="{host}"'
        general = f"<General><Interfaces><NetworkInterface {chosen}/></Interfaces>"
        rest = _THIS_MACHINE if host == LOOPBACK else "</General>"
        try:
            # A configuration, in place of that of the environment.
            self._domain = Domain(domain, f"<CycloneDDS><Domain>{general}{rest}</Domain></CycloneDDS>")
            self._participant = DomainParticipant(domain)
        except core.DDSException as error:
            msg = f"DDS domain {domain} cannot be joined at {host}: {error.msg}; --host takes the address of an interface"
            raise OSError(msg) from error
        self._found = builtin.BuiltinDataReader(self._participant, builtin.BuiltinTopicDcpsPublication)
        self._writers: dict[str, Any] = {}

    def close(self) -> None:
        self._domain._delete(self._domain._ref)

    def published(self) -> dict[str, dict[str, bool]]:
        """By topic, the types of messages, and whether all who publish them are reliable."""
        from cyclonedds.qos import Policy  # noqa: PLC0415 - an extra

        topics: dict[str, dict[str, bool]] = {}
        for endpoint in self._found.read(10_000):
            # Those that left have no name.
            package, _, name = (endpoint.type_name or "").partition("::msg::dds_::")
            if name and endpoint.topic_name.startswith("rt/"):
                types = topics.setdefault(endpoint.topic_name[2:], {})
                kind, policy = f"{package}/msg/{name[:-1]}", endpoint.qos[Policy.Reliability]
                types[kind] = types.get(kind, True) and isinstance(policy, Policy.Reliability.Reliable)
        return topics

    def reader(self, topic: str, message_type: str, *, reliable: bool, latched: bool = False) -> Any:
        """Return a reader, `reliable` if all publishers are: else it matches none of the others. `latched`: they keep their last message."""
        from cyclonedds.sub import DataReader  # noqa: PLC0415 - an extra

        qos = _qos(_QUEUED, reliable=reliable, latched=latched)
        return DataReader(self._participant, self._topic(topic, message_type), qos=qos)

    def publish(self, topic: str, message: Any, *, encoded: bytes = b"", latched: bool = False) -> None:
        """Publish a message of rosbags; `latched`: later subscribers get the last one, too."""
        from cyclonedds.pub import DataWriter  # noqa: PLC0415 - an extra

        if topic not in self._writers:
            at = self._topic(topic, message.__msgtype__)
            qos = _qos(1 if latched else _QUEUED, reliable=True, latched=latched)
            self._writers[topic] = DataWriter(self._participant, at, qos=qos)
        writer = self._writers[topic]
        writer.write(writer.data_type(encoded or encode(message)))

    def _topic(self, name: str, message_type: str) -> Any:
        from cyclonedds.topic import Topic  # noqa: PLC0415 - an extra

        return Topic(self._participant, f"rt{name}", _dds_type(message_type))


def _qos(depth: int, *, reliable: bool, latched: bool) -> Any:
    from cyclonedds.qos import Policy, Qos  # noqa: PLC0415 - an extra

    return Qos(
        Policy.Reliability.Reliable(10**8) if reliable else Policy.Reliability.BestEffort,
        Policy.Durability.TransientLocal if latched else Policy.Durability.Volatile,
        Policy.History.KeepLast(depth),
        Policy.DataRepresentation(use_cdrv0_representation=True),
        Policy.IgnoreLocal.Participant,
    )


class _Encoded:
    """A message that rosbags encodes and decodes, as those in bags: cyclonedds passes its bytes."""

    def __init__(self, data: bytes) -> None:
        self.data = data

    def serialize(self, **_: Any) -> bytes:
        return self.data

    @classmethod
    def deserialize(cls, data: bytes, **_: Any) -> _Encoded:
        return cls(data)

    deserialize_key = deserialize


@cache
def _dds_type(message_type: str) -> Any:
    """Type for cyclonedds of messages of rosbags, with fields and names as those of ROS 2, by which peers match."""
    from cyclonedds import idl  # noqa: PLC0415 - an extra

    types: Any = idl.types

    def hint(kind: int, of: Any) -> Any:
        if kind == _BASIC:
            known = {"string": str, "bool": bool, "byte": types.uint8, "char": types.uint8}
            return known.get(of[0]) or getattr(types, of[0])
        if kind == _MESSAGE:
            return _dds_type(of)
        part = hint(*of[0])
        return types.array[part, of[1]] if kind == _ARRAY else types.sequence[part]

    package, _, name = message_type.split("/")
    fields = {field: hint(*of) for field, of in message_types(cdr=True).fielddefs[message_type][1]}
    made = idl.make_idl_struct(f"{name}_", f"{package}::msg::dds_::{name}_", fields, dataclassify=False)
    # A base class would be part of the type.
    for method in ("__init__", "serialize", "deserialize", "deserialize_key"):
        setattr(made, method, vars(_Encoded)[method])
    return made


def encode(message: Any) -> bytes:
    return bytes(message_types(cdr=True).serialize_cdr(message, message.__msgtype__))


def make_message(message_type: str, **values: Any) -> Any:
    """Make a message of rosbags. Fields without values are zero or empty."""

    def zero(kind: int, of: Any) -> Any:
        if kind == _BASIC:
            return "" if of[0] == "string" else 0
        if kind == _MESSAGE:
            return make_message(of)
        part, name = of[0]
        return np.zeros(of[1], name[0]) if part == _BASIC else []

    types = message_types(cdr=True)
    fields = types.fielddefs[message_type][1]
    return types.types[message_type](**{f: values[f] if f in values else zero(*of) for f, of in fields})


class _RecentTrack(Track):
    """The last poses of a frame. One that stands still may move again: only static transforms are constant."""

    def add(self, numbers: tuple[float, ...]) -> None:
        super().add(numbers)
        if len(self.numbers) > 2 * 9 * _KEPT_POSES:
            del self.numbers[: -9 * _KEPT_POSES]
        for cached in ("table", "matrix"):
            vars(self).pop(cached, None)

    @property
    def constant(self) -> bool:
        return self.static


class _Unlogged(Notes):
    def add(self, line: str) -> None:
        self.lines.append(line)


class Subscription:
    """Scans of running topics, with poses of a topic or of TF; with `find`, or if TF has none, `unposed`. Iteration ends when `stopped`."""

    def __init__(
        self,
        node: Node,
        topics: Sequence[str],
        request: Request,
        find: bool,
        stopped: Callable[[], bool],
        report: Callable[[str], None],
    ) -> None:
        self._node, self._topics, self._request = node, list(dict.fromkeys(topics)), request
        self._stopped, self._report = stopped, report
        self._lock = threading.Lock()  # guards the queue and the poses
        self._queue: deque[tuple[float, RawScan]] = deque()
        self._tracks = Tracks(_RecentTrack)
        self._readers: dict[str, tuple[str, Any]] = {}
        self._clocks: dict[str, Clock] = {}
        self._frames: dict[str, str] = {}  # by topic of scans
        self._found: dict[str, Any] = {}  # latest poses by frame
        self._error: Exception | None = None
        self.unposed, self.dropped, self._why = find, 0, ""
        threading.Thread(target=self._listen, daemon=True).start()
        self._await(lambda: len(self._frames) == len(self._topics))
        until_s = time.monotonic() + _PATIENCE_S
        self._await(lambda: self._are_posed(late=time.monotonic() > until_s))
        self._mount()

    def __iter__(self) -> Iterator[Scan]:
        """Yield scans, with poses of the body if there are mountings, and note at the end what was left out."""
        mounted = self.T_body_sensor
        for scan in posed(self._raw_scans, self._latest, self._request)():
            if mounted is None:
                yield replace(scan, sensor=None)
            else:
                T = scan.T_world_sensor @ np.linalg.inv(mounted[scan.sensor])
                yield replace(scan, T_world_sensor=T)
        self._request.notes.end_pass()

    def _raw_scans(self) -> Iterator[RawScan]:
        longest_s = self._request.max_gap_s
        while self._queue or not self._stopped():
            if self._error is not None:
                raise self._error
            if not self._queue:
                time.sleep(_STEP_S)
                continue
            with self._lock:
                arrived_s, raw = self._queue.popleft()
            while time.monotonic() < arrived_s + longest_s and not self._stopped():
                poses = self._latest(raw.frame)
                if poses is None or poses.pose_at(raw.time_s or 0.0, longest_s) is not None:
                    break
                time.sleep(_STEP_S)  # the pose after the scan is yet to come
            yield raw

    def _latest(self, frame: str) -> Any:
        found = self._found  # another dict once a pose arrives
        if frame not in found:
            found[frame] = self._find(frame, _Unlogged())
        return found[frame]

    def _find(self, frame: str, notes: Notes) -> Any:
        """Poses of a frame so far, or None. Raise a ValueError if there are none."""
        if self.unposed:
            return UNPOSED
        request, frames = replace(self._request, notes=notes), [*self._frames.values()]
        name = request.pose_topic
        with self._lock:
            tree = self._tracks.tree(request)
            sensor = next((known for known in frames if known in tree.tracks), frames[0])
            if name is None:
                return tree_poses(tree, sensor, request)(frame)
            check(name in self._tracks.by_topic, f"{name} has no messages yet")
            return topic_poses(name, self._tracks.by_topic, tree, sensor, request)(frame)

    def _are_posed(self, *, late: bool) -> bool:
        """Whether the poses of the scans are known, or are not in TF, which is certain only if they are `late`."""
        notes, of_topic = _Unlogged(), self._request.pose_topic is not None
        self._why = "static transforms of the radars"
        try:
            for frame in self._frames.values():
                self._find(frame, notes)
        except ValueError as error:
            self._why = str(error)
            if late and not of_topic:
                if not isinstance(error, NoPoses):
                    raise
                self.unposed = True
                self._request.notes.add("TF has no poses of the radar: they are estimated from its returns")
            return self.unposed
        with self._lock:  # static transforms may arrive after odometry
            known = self._tracks.tree(self._request).tracks
        if not late and not all(frame in known for frame in self._frames.values()):
            return False
        for line in notes.lines:
            self._request.notes.add(line)
        return True

    def _mount(self) -> None:
        request, frames = self._request, dict(self._frames)
        with self._lock:
            tree = self._tracks.tree(request)
        _, mounted = tree.mountings([*frames.values()] or [""])
        several = len(self._topics) > 1
        self.T_body_sensor: dict[Label, Floats] | None = None  # by topic, of several radars
        if several and len(mounted) == len(frames):
            self.T_body_sensor = {topic: mounted[frame] for topic, frame in frames.items()}
        mountable = not several or self.T_body_sensor or not self.unposed
        check(
            mountable, f"TF has no mountings of {frames}: to track the scans of several radars, publish them"
        )
        # By label of a scan: the highest frame that TF attaches rigidly to its radar, and T_carrier_sensor.
        self.carriers: dict[Label | None, tuple[str, Floats]] = {
            topic if several else None: tree.rigid_top(frame) for topic, frame in frames.items()
        }
        self.world = request.world_frame or "map"
        if not self.unposed and frames:
            tops = [tree.chain(frame)[-1] for frame in frames.values()]
            track = self._tracks.by_topic.get(request.pose_topic or "")
            self.world = track.parent if track else request.world_frame or tops[0]
        # A frame has one parent: that of others, if there is one.
        self.broadcasts = self.unposed and not any(top in tree.tracks for top, _ in self.carriers.values())

    def _await(self, ready: Callable[[], bool]) -> None:
        """Wait; after a while, report for what."""
        report_s = time.monotonic() + 1.5 * _PATIENCE_S
        while not (self._stopped() or ready()):
            if self._error is not None:
                raise self._error
            if time.monotonic() > report_s:
                report_s = np.inf
                missing = [topic for topic in self._topics if topic not in self._frames]
                found = self._node.published()
                listed = ", ".join(f"{name} ({', '.join(types)})" for name, types in sorted(found.items()))
                what = f"messages of {', '.join(missing)}" if missing else self._why
                self._report(
                    f"waiting for {what}; DDS domain {self._node.domain} has {listed or 'no topics'}"
                )
            time.sleep(_STEP_S)

    def _listen(self) -> None:
        """Subscribe to topics once they are there, and receive their messages."""
        next_s = 0.0
        try:
            while not self._stopped():
                if time.monotonic() > next_s:
                    self._subscribe()
                    next_s = time.monotonic() + 0.2
                for topic, (message_type, reader) in self._readers.items():
                    for sample in reader.take(_QUEUED):
                        if sample.sample_info.valid_data:
                            self._receive(topic, message_type, sample)
                time.sleep(_STEP_S)
        except Exception as error:  # noqa: BLE001 - raised in the thread that iterates
            self._error = error

    def _subscribe(self) -> None:
        wanted: dict[str, tuple[str, ...]] = dict.fromkeys(("/tf", _STATIC), bag_messages.TRANSFORM_TYPES)
        wanted |= dict.fromkeys(self._topics, bag_messages.CLOUD_TYPES)
        if self._request.pose_topic is not None:
            wanted[self._request.pose_topic] = bag_messages.POSE_TYPES
        found = self._node.published()
        for topic in (wanted.keys() & found.keys()) - self._readers.keys():
            fitting = sorted(found[topic].keys() & set(wanted[topic]))
            listed = ", ".join(sorted(found[topic]))
            check(fitting, f"{topic} has messages {listed}; it must have one of {', '.join(wanted[topic])}")
            kind = fitting[0]
            reader = self._node.reader(topic, kind, reliable=found[topic][kind], latched=topic == _STATIC)
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
            with self._lock:
                self._tracks.add(Message(Path(), topic, message_type, recorded_s, 0, stamp_s, frame, content))
                self._found = {}
            return
        if topic not in self._clocks:
            both = np.array([[stamp_s], [recorded_s]])
            self._clocks[topic] = Clock.of(both, topic, self._request.stamps, self._request.notes)
        time_s = float(self._clocks[topic].times(stamp_s, recorded_s))
        label = topic if len(self._topics) > 1 else None
        name = f"{topic} at {time_s:.3f} s"
        raw = RawScan(partial(dict, content), time_s, name, frame, topic, sensor=label)
        with self._lock:
            self._frames.setdefault(topic, frame)
            self._queue.append((time.monotonic(), raw))
            if len(self._queue) > _QUEUED:
                self._queue.popleft()
                self.dropped += 1
