# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The few ROS messages that scans, poses and inertial measurements are in, read from their bytes.

Without a type system: it would build Python code from the definitions in a bag, makes an object of each point, and old
ROS 2 bags have no definitions. The definitions below have not changed for many years. Each message must be read to its
last byte; one with another layout is an error.
"""

from __future__ import annotations

import itertools
import struct
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from radarsdf.io.scans import Columns

_POINT_FIELD_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_RADAR_RETURN = [
    (n, "f4") for n in ("range", "azimuth_rad", "elevation_rad", "doppler_velocity", "amplitude")
]
_ARS548_RETURN = [
    *((n, "f4") for n in ("azimuth", "azimuth_std")), ("flags", "u1"),
    *((n, "f4") for n in ("elevation", "elevation_std", "range", "range_std", "range_rate", "range_rate_std")),
    ("rcs", "i1"), ("id", "u2"), ("existence", "u1"), ("class", "u1"), ("multi", "u1"), ("object", "u2"),
    ("ambiguity", "u1"), ("sort_index", "u2"),
]  # fmt: skip
"""As the radar sends it, and ars548_messages has it."""
_NEBULA_RETURN = [(n, "V8" if n == "flags" else kind) for n, kind in _ARS548_RETURN[:-1]]
_ARS548_LIST_BYTES, _ARS548_RETURNS_AT, _ARS548_COUNT_AT, _ARS548_MAX = 35336, 101, 35309, 800
_CDR_HEADER = 4
_MAX_CDR_PADDING = 7
_NOT_MEASURED = -1.0  # in place of a variance, by the definition of sensor_msgs/Imu


class Header(NamedTuple):
    """Stamp and frame of a message."""

    stamp_s: float
    frame: str


class CloudMessage(NamedTuple):
    """A message with points."""

    header: Header
    columns: Columns


class PoseMessage(NamedTuple):
    """A pose T_frame_child."""

    header: Header
    child: str
    """The frame that has the pose. Empty where the message does not name it."""
    values: tuple[float, ...]
    """x, y, z, m; qx, qy, qz, qw."""


class ImuMessage(NamedTuple):
    """Rates, rad/s, and specific force, m/s², of an IMU at one time, in its own axes. None: it does not measure it."""

    header: Header
    angular_velocity: tuple[float, ...] | None
    specific_force: tuple[float, ...] | None


class _Cursor:
    """Reads the fields of a message one after another: of ROS 1, or of ROS 2 (CDR), where they are aligned."""

    def __init__(self, raw: bytes | memoryview, cdr: bool) -> None:
        self.raw, self.cdr, self.at = memoryview(raw), cdr, 0
        if cdr:
            if len(self.raw) < _CDR_HEADER or self.raw[1] != 1:
                msg = "it is not little-endian CDR"
                raise ValueError(msg)
            self.raw = self.raw[_CDR_HEADER:]

    def values(self, kinds: str) -> tuple[Any, ...]:
        """Numbers of these types, as those of `struct`."""
        found: list[Any] = []
        for kind, run in itertools.groupby(kinds):
            layout = "<" + "".join(run)
            self._align(struct.calcsize(kind))
            found += struct.unpack_from(layout, self.raw, self.at)
            self.at += struct.calcsize(layout)
        return tuple(found)

    def count(self) -> int:
        found: int = self.values("I")[0]
        return found

    def data(self) -> memoryview:
        return self._bytes(self.count())

    def string(self) -> str:
        text = bytes(self.data())
        return (text[:-1] if self.cdr else text).decode("utf-8", "replace")

    def records(self, fields: list[tuple[str, str]], count: int) -> NDArray[Any]:
        """Structures whose first field is the widest, which CDR aligns as C does."""
        dtype = np.dtype([(name, "<" + kind) for name, kind in fields], align=self.cdr)
        if not count:
            return np.zeros(0, dtype)
        self._align(dtype.alignment)
        last = fields[-1][0]
        end = dtype.fields[last][1] + dtype[last].itemsize  # type: ignore[index] # the last is not padded
        data = bytes(self._bytes(dtype.itemsize * (count - 1) + end))
        return np.frombuffer(data.ljust(dtype.itemsize * count, b"\0"), dtype)

    def header(self) -> Header:
        if not self.cdr:
            self.values("I")  # the sequence number, which ROS 2 has not
        seconds, nanoseconds = self.values("iI" if self.cdr else "II")
        return Header(seconds + 1e-9 * nanoseconds, self.string().lstrip("/"))

    def end(self) -> None:
        left = len(self.raw) - self.at
        if not 0 <= left <= (_MAX_CDR_PADDING if self.cdr else 0):
            msg = f"{left} bytes are left over: its layout is another"
            raise ValueError(msg)

    def _align(self, size: int) -> None:
        if self.cdr and size > 1:
            self.at += -self.at % size

    def _bytes(self, size: int) -> memoryview:
        if self.at + size > len(self.raw):  # before anything is allocated
            msg = f"it needs {size} bytes, of which {max(0, len(self.raw) - self.at)} are there"
            raise ValueError(msg)
        self.at += size
        return self.raw[self.at - size : self.at]


def _point_cloud2(cursor: _Cursor) -> Columns:
    height, width = cursor.values("II")
    fields = [(cursor.string(), *cursor.values("IBI")) for _ in range(cursor.count())]
    big_endian, point_step, row_step = cursor.values("BII")
    data = cursor.data()
    cursor.values("B")  # is_dense; what is not finite is looked for anyway
    row_step = row_step if height > 1 else point_step * width  # of one row, some drivers leave it 0
    if point_step * width > row_step or row_step * height > len(data):
        msg = f"{height} x {width} points of {point_step} bytes do not fit into its {len(data)} bytes"
        raise ValueError(msg)
    columns: dict[str, tuple[int, str]] = {}
    for name, offset, datatype, count in fields:
        kind = _POINT_FIELD_TYPES.get(datatype)
        if kind is None or offset + int(kind[1]) > point_step:
            msg = f"its field {name} has an unknown type, or lies outside of a point"
            raise ValueError(msg)
        if count <= 1 and name:  # 0 is what some drivers write for 1
            columns.setdefault(name, (offset, (">" if big_endian else "<") + kind))

    if not height * width:
        return {name: np.zeros(0, kind) for name, (_, kind) in columns.items()}
    # Views of the message: no loop over points.
    shape, strides = (height, width), (row_step, point_step)
    return {
        name: np.ndarray(shape, kind, data, offset, strides).reshape(-1)
        for name, (offset, kind) in columns.items()
    }


def _point_cloud(cursor: _Cursor) -> Columns:
    xyz = cursor.records([(axis, "f4") for axis in "xyz"], cursor.count())
    columns: Columns = {axis: xyz[axis] for axis in "xyz"}
    for _ in range(cursor.count()):
        name, values = cursor.string(), cursor.records([("value", "f4")], cursor.count())["value"]
        if len(values) == len(xyz):
            columns.setdefault(name, values)
    return columns


def _radar_scan(cursor: _Cursor) -> Columns:
    returns = cursor.records(_RADAR_RETURN, cursor.count())
    return {name: returns[name] for name, _ in _RADAR_RETURN}


def _ti_radar_scan(cursor: _Cursor) -> Columns:
    """One point a message: its number, x, y, z, range, velocity, Doppler bin, bearing and intensity."""
    number, x, y, z, _, velocity, _, _, intensity = cursor.values("HfffffHff")
    point = {"x": x, "y": y, "z": z, "velocity": velocity, "intensity": intensity}
    return {POINT_ID: np.array([number])} | {name: np.array([v], np.float32) for name, v in point.items()}


def _nebula_list(cursor: _Cursor) -> Columns:
    """A ContinentalArs548DetectionList."""
    cursor.values("B" + "ddd" + "ffffffffB")  # among them, where the sensor is on the vehicle
    returns = cursor.records(_NEBULA_RETURN, cursor.count())
    invalid = np.frombuffer(returns["flags"].tobytes(), bool).reshape(-1, 8)
    return _ars548_columns(returns, invalid)


def _ars548_list(cursor: _Cursor) -> Columns:
    """A DetectionList of ars548_messages: as the radar sends it, always with space for 800 returns."""
    cursor.values("QIIIIIBIBH" + "f" * 12 + "B")
    returns = cursor.records(_ARS548_RETURN, _ARS548_MAX)
    _, _, count, *_ = cursor.values("ffIffB")
    return _ars548_columns(returns[:count])


def _nebula_packets(cursor: _Cursor) -> Columns:
    """What an ARS548 sent, among which lists of returns are found by their length."""
    lists = []
    for _ in range(cursor.count()):
        cursor.values("II")  # its time
        packet = cursor.data()
        if len(packet) == _ARS548_LIST_BYTES:
            count = min(int.from_bytes(packet[_ARS548_COUNT_AT : _ARS548_COUNT_AT + 4], "big"), _ARS548_MAX)
            record = np.dtype([(name, ">" + kind) for name, kind in _ARS548_RETURN])
            lists.append(np.frombuffer(packet, record, count, _ARS548_RETURNS_AT))
    returns = np.concatenate(lists) if lists else np.zeros(0, _ARS548_RETURN)
    return _ars548_columns(returns)


def _ars548_columns(returns: NDArray[Any], invalid: NDArray[np.bool_] | None = None) -> Columns:
    """Columns of returns of an ARS548, NaN where it calls a value invalid: distance, azimuth, elevation and range rate,
    each before its deviation. Azimuth is positive to the left, elevation upwards."""
    if invalid is None:
        invalid = np.unpackbits(returns["flags"][:, None], axis=1, bitorder="little").astype(bool)
    columns = {name: returns[name] for name in ("rcs", "range_std", "azimuth_std", "elevation_std")}
    for i, name in enumerate(("range", "azimuth", "elevation", "range_rate")):
        unit = "_rad" if name in ("azimuth", "elevation") else ""
        columns[name + unit] = np.where(invalid[:, 2 * i], np.nan, returns[name])
    return columns


def _pose(cursor: _Cursor, *, child: bool = False, behind: int = 0) -> list[PoseMessage]:
    """One pose; whether the message names the child frame, and how many numbers are behind the pose."""
    header = cursor.header()
    pose = PoseMessage(header, cursor.string().lstrip("/") if child else "", cursor.values("d" * 7))
    cursor.values("d" * behind)
    return [pose]


def _poses(cursor: _Cursor, *, child: bool) -> list[PoseMessage]:
    if not child:  # a Path has a header of its own
        cursor.header()
    return [_pose(cursor, child=child)[0] for _ in range(cursor.count())]


def _imu(cursor: _Cursor) -> ImuMessage:
    header = cursor.header()
    cursor.values("d" * (4 + 9))  # an orientation, by a filter that nobody knows, and its covariance
    measured = []
    for _ in range(2):
        values, covariance = cursor.values("ddd"), cursor.values("d" * 9)
        measured.append(None if covariance[0] == _NOT_MEASURED else values)
    return ImuMessage(header, *measured)


POINT_ID = "point_id"
POINT_A_MESSAGE = "ti_mmwave_rospkg/msg/RadarScan"
PACKETS = "nebula_msgs/msg/NebulaPackets"
PATH = "nav_msgs/msg/Path"
IMU = "sensor_msgs/msg/Imu"

_CLOUDS: dict[str, Callable[[_Cursor], Columns]] = {
    "sensor_msgs/msg/PointCloud2": _point_cloud2,
    "sensor_msgs/msg/PointCloud": _point_cloud,
    "radar_msgs/msg/RadarScan": _radar_scan,
    POINT_A_MESSAGE: _ti_radar_scan,
    "continental_msgs/msg/ContinentalArs548DetectionList": _nebula_list,
    "ars548_messages/msg/DetectionList": _ars548_list,
    PACKETS: _nebula_packets,
}
_POSES: dict[str, Callable[[_Cursor], Any]] = {
    "nav_msgs/msg/Odometry": partial(_pose, child=True, behind=36 + 6 + 36),  # covariance, twist, covariance
    "geometry_msgs/msg/PoseStamped": _pose,
    "geometry_msgs/msg/PoseWithCovarianceStamped": partial(_pose, behind=36),
    "geometry_msgs/msg/TransformStamped": partial(_pose, child=True),
    PATH: partial(_poses, child=False),
}
_TRANSFORMS = dict.fromkeys(("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"), partial(_poses, child=True))
_LAYOUTS: dict[str, Callable[[_Cursor], Any]] = {**_POSES, **_TRANSFORMS, IMU: _imu}
CLOUD_TYPES = tuple(_CLOUDS)
POSE_TYPES = tuple(_POSES)
TRANSFORM_TYPES = tuple(_TRANSFORMS)


def read_message(raw: bytes | memoryview, message_type: str, cdr: bool) -> Any:
    """The content of a message: a `CloudMessage`, a list of `PoseMessage` or an `ImuMessage`, by its type."""
    try:
        cursor = _Cursor(raw, cdr)
        if message_type in _CLOUDS:
            message: Any = CloudMessage(cursor.header(), _CLOUDS[message_type](cursor))
        else:
            message = _LAYOUTS[message_type](cursor)
        cursor.end()
    except KeyError as error:
        msg = "its topic has messages of other types, too"
        raise ValueError(msg) from error
    except struct.error as error:
        msg = "it is cut off"
        raise ValueError(msg) from error
    return message
