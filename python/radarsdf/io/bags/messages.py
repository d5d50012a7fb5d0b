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
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from radarsdf.io.ply import Columns

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
_TI_POINT = [("point_id", "H"), *((n, "f") for n in ("x", "y", "z", "range", "velocity")), ("doppler_bin", "H"),
             ("bearing", "f"), ("intensity", "f")]  # fmt: skip
_CDR_HEADER = 4
_MAX_CDR_PADDING = 7
_NOT_MEASURED = -1.0  # in place of a variance, by the definition of sensor_msgs/Imu


@dataclass(frozen=True)
class Header:
    """Stamp and frame of a message."""

    stamp_s: float
    frame: str


@dataclass(frozen=True, eq=False)
class CloudMessage:
    """A message with points, whose columns (N,) by field are read when they are asked for."""

    header: Header
    columns: Callable[[], Columns]
    point_id: int | None = None
    """Number of the point, of messages of one point each."""


@dataclass(frozen=True)
class PoseMessage:
    """A pose T_frame_child."""

    header: Header
    child: str
    """The frame that has the pose. Empty where the message does not say."""
    values: tuple[float, ...]
    """x, y, z, m; qx, qy, qz, qw."""


@dataclass(frozen=True, eq=False)
class ImuMessage:
    """What an IMU measured at one time, in its own axes. None: it does not measure it."""

    header: Header
    angular_velocity: tuple[float, ...] | None
    """rad/s."""
    specific_force: tuple[float, ...] | None
    """m/s²: acceleration less that of gravity."""


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

    def value(self, kind: str) -> Any:
        return self.values(kind)[0]

    def count(self) -> int:
        found: int = self.value("I")
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
            self.value("I")  # the sequence number, which ROS 2 has not
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


def _point_cloud2(cursor: _Cursor) -> CloudMessage:
    header = cursor.header()
    height, width = cursor.values("II")
    fields = [(cursor.string(), *cursor.values("IBI")) for _ in range(cursor.count())]
    big_endian, point_step, row_step = cursor.values("BII")
    data = cursor.data()
    cursor.value("B")  # is_dense; what is not finite is looked for anyway
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

    record = np.dtype(
        {
            "names": list(columns),
            "formats": [kind for _, kind in columns.values()],
            "offsets": [offset for offset, _ in columns.values()],
            "itemsize": point_step,
        }
    )

    def read() -> Columns:
        if not height * width:
            return {name: np.zeros(0, kind) for name, (_, kind) in columns.items()}
        # One view of the message: no loop over points, and no copy.
        cloud: NDArray[Any] = np.ndarray((height, width), record, data, strides=(row_step, point_step))
        return {name: cloud[name].reshape(-1) for name in columns}

    return CloudMessage(header, read)


def _point_cloud(cursor: _Cursor) -> CloudMessage:
    header = cursor.header()
    xyz = cursor.records([(axis, "f4") for axis in "xyz"], cursor.count())
    columns: Columns = {axis: xyz[axis] for axis in "xyz"}
    for _ in range(cursor.count()):
        name, values = cursor.string(), cursor.records([("value", "f4")], cursor.count())["value"]
        if len(values) == len(xyz):
            columns.setdefault(name, values)
    return CloudMessage(header, lambda: columns)


def _radar_scan(cursor: _Cursor) -> CloudMessage:
    header = cursor.header()
    returns = cursor.records(_RADAR_RETURN, cursor.count())
    return CloudMessage(header, lambda: {name: returns[name] for name, _ in _RADAR_RETURN})


def _ti_radar_scan(cursor: _Cursor) -> CloudMessage:
    """One point a message."""
    header = cursor.header()
    fields = {name: cursor.value(kind) for name, kind in _TI_POINT}
    used = ("x", "y", "z", "velocity", "intensity")
    return CloudMessage(
        header, lambda: {name: np.array([fields[name]], np.float32) for name in used}, fields["point_id"]
    )


def _nebula_list(cursor: _Cursor) -> CloudMessage:
    """A ContinentalArs548DetectionList."""
    header = cursor.header()
    cursor.values("B" + "ddd" + "ffffffffB")  # among them, where the sensor is on the vehicle
    returns = cursor.records(_NEBULA_RETURN, cursor.count())
    invalid = np.frombuffer(returns["flags"].tobytes(), bool).reshape(-1, 8)
    return CloudMessage(header, lambda: _ars548_columns(returns, invalid))


def _ars548_list(cursor: _Cursor) -> CloudMessage:
    """A DetectionList of ars548_messages: as the radar sends it, always with space for 800 returns."""
    header = cursor.header()
    cursor.values("QIIIIIBIBH" + "f" * 12 + "B")
    returns = cursor.records(_ARS548_RETURN, _ARS548_MAX)
    _, _, count, *_ = cursor.values("ffIffB")
    returns = returns[:count]
    return CloudMessage(header, lambda: _ars548_columns(returns))


def _nebula_packets(cursor: _Cursor) -> CloudMessage:
    """What an ARS548 sent, among which lists of returns are found by their length."""
    header, lists = cursor.header(), []
    for _ in range(cursor.count()):
        cursor.values("II")  # its time
        packet = cursor.data()
        if len(packet) == _ARS548_LIST_BYTES:
            count = min(int.from_bytes(packet[_ARS548_COUNT_AT : _ARS548_COUNT_AT + 4], "big"), _ARS548_MAX)
            record = np.dtype([(name, ">" + kind) for name, kind in _ARS548_RETURN])
            lists.append(np.frombuffer(packet, record, count, _ARS548_RETURNS_AT))
    returns = np.concatenate(lists) if lists else np.zeros(0, _ARS548_RETURN)
    return CloudMessage(header, lambda: _ars548_columns(returns))


def _ars548_columns(returns: NDArray[Any], invalid: NDArray[np.bool_] | None = None) -> Columns:
    """Columns of returns of an ARS548, NaN where it calls a value invalid: distance, azimuth, elevation and range rate,
    each before its deviation. Azimuth is positive to the left, elevation upwards."""
    if invalid is None:
        invalid = np.unpackbits(returns["flags"][:, None], axis=1, bitorder="little").astype(bool)
    values = {
        "range": "range",
        "azimuth_rad": "azimuth",
        "elevation_rad": "elevation",
        "range_rate": "range_rate",
    }
    columns = {
        name: np.where(invalid[:, 2 * i], np.nan, returns[field])
        for i, (name, field) in enumerate(values.items())
    }
    return columns | {n: returns[n] for n in ("rcs", "range_std", "azimuth_std", "elevation_std")}


def _pose(cursor: _Cursor, *, child: bool = False, behind: int = 0) -> list[PoseMessage]:
    """One pose; whether the message names the child frame, and how many numbers are behind the pose."""
    header = cursor.header()
    pose = PoseMessage(header, cursor.string().lstrip("/") if child else "", cursor.values("d" * 7))
    cursor.values("d" * behind)
    return [pose]


def _path(cursor: _Cursor) -> list[PoseMessage]:
    cursor.header()
    return [_pose(cursor)[0] for _ in range(cursor.count())]


def _transforms(cursor: _Cursor) -> list[PoseMessage]:
    return [_pose(cursor, child=True)[0] for _ in range(cursor.count())]


def _imu(cursor: _Cursor) -> ImuMessage:
    header = cursor.header()
    cursor.values("d" * (4 + 9))  # an orientation, by a filter that nobody knows, and its covariance
    measured = []
    for _ in range(2):
        values, covariance = cursor.values("ddd"), cursor.values("d" * 9)
        measured.append(None if covariance[0] == _NOT_MEASURED else values)
    return ImuMessage(header, *measured)


POINT_A_MESSAGE = "ti_mmwave_rospkg/msg/RadarScan"
PACKETS = "nebula_msgs/msg/NebulaPackets"
PATH = "nav_msgs/msg/Path"
IMU = "sensor_msgs/msg/Imu"

_CLOUDS = {
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
    PATH: _path,
}
_TRANSFORMS = {"tf2_msgs/msg/TFMessage": _transforms, "tf/msg/tfMessage": _transforms}
_LAYOUTS: dict[str, Callable[[_Cursor], Any]] = {**_CLOUDS, **_POSES, **_TRANSFORMS, IMU: _imu}
CLOUD_TYPES = tuple(_CLOUDS)
POSE_TYPES = tuple(_POSES)
TRANSFORM_TYPES = tuple(_TRANSFORMS)


def read_message(raw: bytes | memoryview, message_type: str, cdr: bool) -> Any:
    """The content of a message: a `CloudMessage`, a list of `PoseMessage` or an `ImuMessage`, by its type."""
    try:
        cursor = _Cursor(raw, cdr)
        message = _LAYOUTS[message_type](cursor)
        cursor.end()
    except KeyError as error:
        msg = "its topic has messages of other types, too"
        raise ValueError(msg) from error
    except struct.error as error:
        msg = "it is cut off"
        raise ValueError(msg) from error
    return message
