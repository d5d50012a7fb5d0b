"""Message streams of ROS 1 and ROS 2 bags, without ROS: scans, poses and inertial measurements.

Message types are those of rosbags and the definitions below, never those in a bag: rosbags generates Python code from
definitions, and old ROS 2 bags have none.
"""

import heapq
from collections import Counter
from collections.abc import Callable, Collection, Generator, Iterable, Iterator
from contextlib import ExitStack, closing, contextmanager
from functools import cache, partial
from operator import attrgetter, itemgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from radarsdf.arrays import Bools, Floats
from radarsdf.checks import check
from radarsdf.extras import require
from radarsdf.io.files import check_regular_file
from radarsdf.scans import Columns, Notes

BAG_SUFFIXES = (".bag", ".mcap", ".db3")
_METADATA = "metadata.yaml"
TRANSFORM_TYPES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
_ARS548_DEFINITION = (
    "float32 azimuth; float32 azimuth_std; {} invalid; float32 elevation; float32 elevation_std; float32 range; "
    "float32 range_std; float32 range_rate; float32 range_rate_std; int8 rcs; uint16 id; uint8 existence; uint8 class_; "
    "uint8 multi_target; uint16 object; uint8 ambiguity"
)
_DEFINITIONS = {
    **dict.fromkeys(TRANSFORM_TYPES, "geometry_msgs/TransformStamped[] transforms"),
    "radar_msgs/msg/RadarReturn": (
        "float32 range; float32 azimuth; float32 elevation; float32 doppler_velocity; float32 amplitude"
    ),
    "radar_msgs/msg/RadarScan": "std_msgs/Header header; radar_msgs/RadarReturn[] returns",
    "nebula_msgs/msg/NebulaPacket": "builtin_interfaces/Time stamp; uint8[] data",
    "nebula_msgs/msg/NebulaPackets": "std_msgs/Header header; nebula_msgs/NebulaPacket[] packets",
    "continental_msgs/msg/ContinentalArs548Detection": _ARS548_DEFINITION.format("bool[8]"),
    "continental_msgs/msg/ContinentalArs548DetectionList": (
        "std_msgs/Header header; uint8 sync_status; geometry_msgs/Point origin; float32[8] origin_and_alignment; "
        "uint8 alignment_status; continental_msgs/ContinentalArs548Detection[] detections"
    ),
    "ars548_messages/msg/Detection": _ARS548_DEFINITION.format("uint8") + "; uint16 sort_index",
    "ars548_messages/msg/DetectionList": (
        "std_msgs/Header header; uint64 crc; uint32[5] counters; uint8 sync_status; uint32 event; uint8 qualifier; "
        "uint16 origin_invalid; float32[12] origin; uint8 invalid; ars548_messages/Detection[800] detections; "
        "float32[2] velocities; uint32 num_detections; float32[2] alignment; uint8 alignment_status"
    ),
}
_POINT_FIELD_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}

# A list of returns as sent by an ARS548: big-endian, always with space for 800 returns. Azimuth is positive to the left.
_ARS548_RETURN = np.dtype(
    [("azimuth_rad", ">f4"), ("azimuth_std", ">f4"), ("invalid", "u1"), ("elevation_rad", ">f4"), ("elevation_std", ">f4"),
     ("range", ">f4"), ("range_std", ">f4"), ("range_rate", ">f4"), ("range_rate_std", ">f4"), ("rcs", "i1"),
     ("others", "V10")]
)  # fmt: skip
_ARS548_VALUES = [name for name in _ARS548_RETURN.names or () if name not in ("invalid", "others")]
_RADAR_SCAN = ("range", "azimuth_rad", "elevation_rad", "doppler_velocity", "amplitude")
_PACKET_BYTES, _RETURNS_AT, _COUNT_AT, _MAX_RETURNS = 35336, 101, 35309, 800
_NOT_MEASURED = -1.0  # a variance of sensor_msgs/Imu that marks a missing measurement


class Topic(NamedTuple):
    name: str
    message_type: str
    num_messages: int  # in all bags


class Pose(NamedTuple):
    """A pose T_parent_child."""

    stamp_s: float
    parent: str
    child: str  # empty if the message does not name it
    values: tuple[float, ...]  # x, y, z, m; qx, qy, qz, qw


class Message(NamedTuple):
    bag: Path
    topic: str
    message_type: str
    recorded_s: float
    number: int  # index within its topic
    stamp_s: float
    frame: str
    content: Any  # columns of a cloud, a list of poses, or rates, rad/s, and forces, m/s², of an IMU


@cache
def message_types(cdr: bool) -> Any:
    """Return the types of rosbags, of ROS 2 or else of ROS 1."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore  # noqa: PLC0415 - an extra

    store = get_typestore(Stores.ROS2_HUMBLE if cdr else Stores.ROS1_NOETIC)
    for name, text in _DEFINITIONS.items():
        if name not in store.types:
            store.register(get_types_from_msg(text.replace("; ", "\n"), name))
    return store


def _stamp(message: Any) -> tuple[float, str]:
    if not hasattr(message, "header"):
        return 0.0, ""
    stamp = message.header.stamp
    return stamp.sec + 1e-9 * stamp.nanosec, message.header.frame_id.lstrip("/")


def _point_cloud2(message: Any) -> Columns:
    height, width, step, data = message.height, message.width, message.point_step, message.data
    row_step = message.row_step if height > 1 else step * width  # some drivers leave that of a single row 0
    fits = step * width <= row_step and row_step * height <= len(data)
    check(fits, f"{height} x {width} points of {step} bytes do not fit into its {len(data)} bytes")
    columns: Columns = {}
    for field in message.fields:
        kind = _POINT_FIELD_TYPES.get(field.datatype, "f999")  # a type that no role can have
        known = field.offset + int(kind[1:]) <= step and field.count <= 1  # some drivers write 0 for 1
        if not known or not field.name or field.name in columns:
            continue
        dtype = np.dtype((">" if message.is_bigendian else "<") + kind)
        column = np.zeros(0, dtype)
        if height * width:
            column = np.ndarray((height, width), dtype, data, field.offset, (row_step, step)).reshape(-1)
        columns[field.name] = column
    return columns


def _point_cloud(message: Any) -> Columns:
    channels = {c.name: c.values for c in message.channels[::-1] if len(c.values) == len(message.points)}
    return channels | _columns("xyz", message.points)


def _columns(names: Iterable[str], rows: list[Any]) -> Columns:
    """Columns of the attributes of rows. The name of an angle ends in its unit, which that of its attribute lacks."""
    attributes = {name: attrgetter(name.removesuffix("_rad")) for name in names}
    return {name: np.array([*map(of, rows)], np.float32) for name, of in attributes.items()}


def _ars548_packets(message: Any) -> Columns:
    """Decode ARS548 packets, among which lists of returns are recognised by their length. Invalid values become NaN."""
    lists = [np.zeros(0, _ARS548_RETURN)]
    for packet in message.packets:
        data = packet.data.tobytes()
        if len(data) == _PACKET_BYTES:
            count = min(int.from_bytes(data[_COUNT_AT : _COUNT_AT + 4], "big"), _MAX_RETURNS)
            lists.append(np.frombuffer(data, _ARS548_RETURN, count, _RETURNS_AT))
    returns = np.concatenate(lists)
    flags = np.unpackbits(returns["invalid"][None], axis=0, bitorder="little")
    return _ars548({name: returns[name] for name in _ARS548_VALUES}, flags != 0)


def _ars548_list(message: Any) -> Columns:
    """Returns of an ARS548 as its drivers publish them: Autoware's with one flag per value, ars548_messages with bits."""
    returns = message.detections[: getattr(message, "num_detections", None)]
    flags = np.array([row.invalid for row in returns], np.uint8)
    if flags.ndim == 1:
        flags = np.unpackbits(flags[:, None], axis=1, bitorder="little")
    return _ars548(_columns(_ARS548_VALUES, returns), flags.T != 0)


def _ars548(returns: Columns, invalid: Bools) -> Columns:
    """Columns with NaN where `invalid` (8, N) is set: flags of range, azimuth, elevation and rate, each before its deviation."""
    columns = {name: returns[name] for name in ("rcs", "range_std", "azimuth_std", "elevation_std")}
    for i, name in enumerate(("range", "azimuth_rad", "elevation_rad", "range_rate")):
        columns[name] = np.where(invalid[2 * i], np.nan, returns[name])
    return columns


def _pose(message: Any) -> Pose:
    if hasattr(message, "transform"):
        position, rotation = message.transform.translation, message.transform.rotation
    else:
        pose = getattr(message.pose, "pose", message.pose)
        position, rotation = pose.position, pose.orientation
    values = (position.x, position.y, position.z, rotation.x, rotation.y, rotation.z, rotation.w)
    return Pose(*_stamp(message), getattr(message, "child_frame_id", "").lstrip("/"), values)


def _imu(message: Any) -> list[tuple[float, ...] | None]:
    measured: list[tuple[float, ...] | None] = []
    for name in ("angular_velocity", "linear_acceleration"):
        vector, covariance = getattr(message, name), getattr(message, f"{name}_covariance")
        measured.append(None if covariance[0] == _NOT_MEASURED else (vector.x, vector.y, vector.z))
    return measured


PACKETS = "nebula_msgs/msg/NebulaPackets"
PATH = "nav_msgs/msg/Path"
IMU = "sensor_msgs/msg/Imu"

_CLOUDS: dict[str, Callable[[Any], Columns]] = {
    "sensor_msgs/msg/PointCloud2": _point_cloud2,
    "sensor_msgs/msg/PointCloud": _point_cloud,
    "radar_msgs/msg/RadarScan": lambda message: _columns(_RADAR_SCAN, message.returns),
    "continental_msgs/msg/ContinentalArs548DetectionList": _ars548_list,
    "ars548_messages/msg/DetectionList": _ars548_list,
    PACKETS: _ars548_packets,
}
_GEOMETRY = ("PoseStamped", "PoseWithCovarianceStamped", "TransformStamped")
_POSES = ("nav_msgs/msg/Odometry", *(f"geometry_msgs/msg/{name}" for name in _GEOMETRY))
CLOUD_TYPES, POSE_TYPES = tuple(_CLOUDS), (*_POSES, PATH)
_READERS: dict[str, Callable[[Any], Any]] = {
    **_CLOUDS,
    **dict.fromkeys(_POSES, lambda message: [_pose(message)]),
    PATH: lambda message: [_pose(stamped) for stamped in message.poses],
    **dict.fromkeys(TRANSFORM_TYPES, lambda message: [_pose(stamped) for stamped in message.transforms]),
    IMU: _imu,
}


def is_bag(path: Path) -> bool:
    """Whether a path is a bag by its suffix, or a folder with the metadata of a ROS 2 bag whose files were not renamed."""
    named = path.suffix.lower() in BAG_SUFFIXES
    if named or not (path / _METADATA).is_file():
        return named
    listed = (path / _METADATA).read_text(encoding="utf-8", errors="replace")
    files = [file.name for file in path.iterdir() if file.suffix.lower() in BAG_SUFFIXES]
    return not files or any(name in listed for name in files)


def topics_of(paths: list[Path]) -> dict[str, Topic]:
    topics: dict[str, Topic] = {}
    for path in paths:
        with _opened(path) as reader:
            for connection in reader.connections:
                name, kind = connection.topic, connection.msgtype
                named = isinstance(name, str) and isinstance(kind, str)
                check(named, "a topic has no name or no type")
                count = connection.msgcount + (topics[name].num_messages if name in topics else 0)
                topics[name] = Topic(name, kind, count)
    return topics


def topics_with(types: Collection[str], topics: dict[str, Topic]) -> dict[str, Topic]:
    return {n: topic for n, topic in topics.items() if topic.message_type in types and topic.num_messages}


def decode(raw: Any, message_type: str, *, cdr: bool = True) -> tuple[float, str, Any]:
    """Return time, s, frame and content of the bytes of a message of ROS 2, or else of ROS 1."""
    types = message_types(cdr)
    message = (types.deserialize_cdr if cdr else types.deserialize_ros1)(raw, message_type)
    return *_stamp(message), _READERS[message_type](message)


def read_messages(paths: list[Path], names: set[str], notes: Notes) -> Generator[Message, None, None]:
    """Yield the messages of some topics in the order of recording; damaged ones are left out, and noted at the end."""
    numbers: Counter[str] = Counter()
    damaged: dict[str, list[str]] = {}
    with ExitStack() as stack:
        streams = [stack.enter_context(closing(_stream(path, names))) for path in paths]
        for recorded_s, path, connection, raw in heapq.merge(*streams, key=itemgetter(0)):
            topic, message_type = connection.topic, connection.msgtype
            number, numbers[topic] = numbers[topic], numbers[topic] + 1
            try:
                decoded = decode(raw, message_type, cdr=hasattr(connection.ext, "serialization_format"))
            except Exception as error:  # noqa: BLE001 - damaged messages raise exceptions of many kinds
                at = f"message {number} of {topic}, at {recorded_s:.3f} s"
                damaged.setdefault(topic, []).append(f"{path}: {at}, no complete {message_type}: {error}")
                continue
            yield Message(path, topic, message_type, recorded_s, number, *decoded)
    for topic, texts in damaged.items():
        notes.add(f"messages left out: {len(texts)} of {numbers[topic]}; the first: {texts[0]}")


class Clock(NamedTuple):
    """Times of the messages of a topic."""

    recorded: bool  # by record time, not by header stamp
    delay_s: float  # from a stamp to its record
    zeros: Callable[[], None]  # called for stamps of zero

    @classmethod
    def of(cls, times_s: Floats, what: str, wanted: str | None, notes: Notes) -> "Clock":
        """Clock of messages, of which `times_s` (2, N) are stamps and records: by default the stamps, unless zero or constant."""
        stamps_s, known = times_s[0], times_s[:, times_s[0] != 0]
        if wanted is None and (not known.size or (len(stamps_s) > 1 and np.ptp(stamps_s) == 0)):
            why = "are constant" if known.size else "are zero"
            notes.add(f"the header stamps of {what} {why}: the record time is used instead")
            wanted = "record"
        delay_s = float(np.median(known[1] - known[0])) if known.size else np.nan
        zero = f"header stamps of {what} are zero: record times less the usual delay, {delay_s:.3f} s, replace them"
        return cls(wanted == "record", delay_s, partial(notes.add, zero))

    def times(self, stamps_s: Any, recorded_s: Any) -> Any:
        if self.recorded:
            return recorded_s
        zero = np.equal(stamps_s, 0) & np.isfinite(self.delay_s)
        if zero.any():
            self.zeros()
        return np.where(zero, recorded_s - self.delay_s, stamps_s)


def _stream(path: Path, names: set[str]) -> Generator[tuple[float, Path, Any, Any], None, None]:
    """Yield record time, s, bag, connection of rosbags, and bytes of each message."""
    with _opened(path) as reader:
        connections = [c for c in reader.connections if c.topic in names]
        if not connections:  # rosbags would return all messages
            return
        for connection, recorded_ns, raw in reader.messages(connections=connections):
            # An SQLite database may hold values of any type.
            known = isinstance(recorded_ns, int) and isinstance(raw, (bytes, memoryview))
            check(known, "a message has no time or no bytes")
            yield 1e-9 * recorded_ns, path, connection, raw


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Open a bag by rosbags. Whatever is raised in the block becomes a ValueError that the bag is not complete."""
    check_regular_file(path if path.is_file() or not (path / _METADATA).is_file() else path / _METADATA)
    require("rosbags", what=f"{path}: bags are read by")
    from rosbags import rosbag1, rosbag2  # noqa: PLC0415 - an extra

    try:
        reader: Any = (rosbag1 if path.suffix.lower() == ".bag" else rosbag2).Reader(path)
        reader.open()
        with closing(reader):
            yield reader
    except PermissionError:
        raise
    except Exception as error:  # damaged bags raise exceptions of many kinds, including OSError
        remedy = "if its recording was cut off, mcap recover or rosbag reindex may repair it"
        why = (str(error) or type(error).__name__).rstrip(".")
        msg = f"{path} is not a complete bag: {why}; {remedy}"
        raise ValueError(msg) from error
