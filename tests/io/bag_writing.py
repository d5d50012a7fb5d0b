"""Writes bags of ROS 1 and ROS 2 Messages are serialised by rosbags, not by our own code."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation
from typing_extensions import Self

KINDS = ("ros1", "sqlite3", "mcap")
"""What :class:`BagWriter` writes."""

_DEFINITIONS = {
    "radar_msgs/msg/RadarReturn": "float32 range\nfloat32 azimuth\nfloat32 elevation\nfloat32 doppler_velocity\n"
    "float32 amplitude\n",
    "radar_msgs/msg/RadarScan": "std_msgs/Header header\nradar_msgs/RadarReturn[] returns\n",
    "ti_mmwave_rospkg/msg/RadarScan": "std_msgs/Header header\nuint16 point_id\nfloat32 x\nfloat32 y\nfloat32 z\n"
    "float32 range\nfloat32 velocity\nuint16 doppler_bin\nfloat32 bearing\nfloat32 intensity\n",
    "tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms\n",
    "tf/msg/tfMessage": "geometry_msgs/TransformStamped[] transforms\n",
}
_POINT_FIELD_TYPES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
_NANOSECONDS = 10**9


class BagWriter:
    """A bag of a kind of `KINDS` that is written message by message: a file for ROS 1, a folder for ROS 2."""

    def __init__(self, path: Path, kind: str) -> None:
        self.ros1 = kind == "ros1"
        self.store = get_typestore(Stores.ROS1_NOETIC if self.ros1 else Stores.ROS2_HUMBLE)
        types = {}
        for name, text in _DEFINITIONS.items():
            if name in self.store.types:  # that of ROS 2 has tf2_msgs
                continue
            types.update(get_types_from_msg(text, name))
        self.store.register(types)
        plugins = {"sqlite3": rosbag2.StoragePlugin.SQLITE3, "mcap": rosbag2.StoragePlugin.MCAP}
        self.writer: Any = (
            rosbag1.Writer(path)
            if self.ros1
            else rosbag2.Writer(path, version=9, storage_plugin=plugins[kind])
        )
        self.connections: dict[str, Any] = {}

    def __enter__(self) -> Self:
        """Opens the bag."""
        self.writer.open()
        return self

    def __exit__(self, *_: object) -> None:
        """Closes the bag."""
        self.writer.close()

    def make(self, message_type: str, *values: Any) -> Any:
        """A message, or a part of one."""
        return self.store.types[message_type](*values)

    def write(self, topic: str, message: Any, recorded_s: float) -> None:
        """Writes a message, as recorded at a time, s."""
        name = message.__msgtype__
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, name, typestore=self.store)
        serialise = self.store.serialize_ros1 if self.ros1 else self.store.serialize_cdr
        self.writer.write(self.connections[topic], round(recorded_s * _NANOSECONDS), serialise(message, name))

    def header(self, stamp_s: float, frame: str) -> Any:
        """A header."""
        whole = int(stamp_s)
        stamp = self.make("builtin_interfaces/msg/Time", whole, round((stamp_s - whole) * _NANOSECONDS))
        return self.make("std_msgs/msg/Header", *([0] if self.ros1 else []), stamp, frame)

    def cloud2(
        self,
        stamp_s: float,
        columns: Mapping[str, ArrayLike],
        frame: str = "radar",
        *,
        padding: int = 0,
        height: int = 1,
        big_endian: bool = False,
    ) -> Any:
        """A PointCloud2 of these columns, each in its own type, with `padding` bytes before each point's end."""
        arrays = {name: np.asarray(column) for name, column in columns.items()}
        order: Literal[">", "<"] = ">" if big_endian else "<"
        record = np.dtype(
            [(n, a.dtype.newbyteorder(order)) for n, a in arrays.items()]
            + [("", f"V{padding}")] * bool(padding)
        )
        cloud = np.zeros(len(next(iter(arrays.values()))), record)
        for name, array in arrays.items():
            cloud[name] = array
        offsets = {name: offset for name, (_, offset, *_) in (record.fields or {}).items()}
        fields = [
            self.make("sensor_msgs/msg/PointField", n, offsets[n], _POINT_FIELD_TYPES[a.dtype.str[1:]], 1)
            for n, a in arrays.items()
        ]
        step, width = record.itemsize, len(cloud) // height
        data = np.frombuffer(cloud.tobytes(), np.uint8)
        return self.make(
            "sensor_msgs/msg/PointCloud2", self.header(stamp_s, frame), height, width, fields, big_endian, step,
            step * width, data, True,
        )  # fmt: skip

    def cloud(self, stamp_s: float, columns: Mapping[str, ArrayLike], frame: str = "radar") -> Any:
        """A PointCloud: x, y and z, and the others as channels."""
        arrays = {name: np.ascontiguousarray(column, np.float32) for name, column in columns.items()}
        points = [
            self.make("geometry_msgs/msg/Point32", *map(float, row))
            for row in zip(*(arrays.pop(axis) for axis in "xyz"), strict=True)
        ]
        channels = [
            self.make("sensor_msgs/msg/ChannelFloat32", name, array) for name, array in arrays.items()
        ]
        return self.make("sensor_msgs/msg/PointCloud", self.header(stamp_s, frame), points, channels)

    def radar_scan(self, stamp_s: float, rows: ArrayLike, frame: str = "radar") -> Any:
        """A radar_msgs/RadarScan of rows of range, azimuth, elevation, Doppler and amplitude."""
        returns = [self.make("radar_msgs/msg/RadarReturn", *map(float, row)) for row in np.asarray(rows)]
        return self.make("radar_msgs/msg/RadarScan", self.header(stamp_s, frame), returns)

    def odometry(
        self, stamp_s: float, T_world_base: ArrayLike, frame: str = "odom", child: str = "base_link"
    ) -> Any:
        """An Odometry."""
        zero = self.make("geometry_msgs/msg/Vector3", 0.0, 0.0, 0.0)
        twist = self.make("geometry_msgs/msg/Twist", zero, zero)
        return self.make(
            "nav_msgs/msg/Odometry", self.header(stamp_s, frame), child,
            self.make("geometry_msgs/msg/PoseWithCovariance", self._pose(T_world_base), np.zeros(36)),
            self.make("geometry_msgs/msg/TwistWithCovariance", twist, np.zeros(36)),
        )  # fmt: skip

    def pose_stamped(self, stamp_s: float, T_world_base: ArrayLike, frame: str = "map") -> Any:
        """A PoseStamped."""
        return self.make(
            "geometry_msgs/msg/PoseStamped", self.header(stamp_s, frame), self._pose(T_world_base)
        )

    def imu(self, stamp_s: float, rates: ArrayLike, force: ArrayLike | None, frame: str = "imu") -> Any:
        """An Imu, in rad/s and m/s². Without a force, it says that it has none."""
        no_force = np.zeros(9)
        no_force[0] = -1
        vectors = [
            self.make("geometry_msgs/msg/Vector3", *map(float, np.asarray(values)))
            for values in (rates, np.zeros(3) if force is None else force)
        ]
        return self.make(
            "sensor_msgs/msg/Imu", self.header(stamp_s, frame),
            self.make("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0), no_force,
            vectors[0], np.zeros(9), vectors[1], no_force if force is None else np.zeros(9),
        )  # fmt: skip

    def path(self, poses: Mapping[float, ArrayLike], frame: str = "map") -> Any:
        """A Path of poses by time, s."""
        stamped = [self.pose_stamped(stamp_s, pose, frame) for stamp_s, pose in poses.items()]
        return self.make("nav_msgs/msg/Path", self.header(max(poses), frame), stamped)

    def transforms(self, stamp_s: float, edges: Mapping[tuple[str, str], ArrayLike]) -> Any:
        """A TFMessage: T_parent_child by (parent, child)."""
        stamped = []
        for (parent, child), matrix in edges.items():
            translation, rotation = _parts(matrix)
            transform = self.make(
                "geometry_msgs/msg/Transform",
                self.make("geometry_msgs/msg/Vector3", *translation),
                self.make("geometry_msgs/msg/Quaternion", *rotation),
            )
            header = self.header(stamp_s, parent)
            stamped.append(self.make("geometry_msgs/msg/TransformStamped", header, child, transform))
        return self.make("tf2_msgs/msg/TFMessage", stamped)

    def _pose(self, matrix: ArrayLike) -> Any:
        translation, rotation = _parts(matrix)
        return self.make(
            "geometry_msgs/msg/Pose",
            self.make("geometry_msgs/msg/Point", *translation),
            self.make("geometry_msgs/msg/Quaternion", *rotation),
        )


def _parts(matrix: ArrayLike) -> tuple[list[float], list[float]]:
    pose: NDArray[np.float64] = np.asarray(matrix, np.float64)
    return pose[:3, 3].tolist(), Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()
