"""Write a ROS 2 bag with rosbags, then read and fit it. Requires the extra `ros`, but not ROS.

    python examples/ros_bag.py [FOLDER]

On the command line: radarsdf fit drive_bag -o map.safetensors.
"""

import sys
from pathlib import Path

import numpy as np
import radarsdf
from rosbags import rosbag2
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

STORE = get_typestore(Stores.ROS2_HUMBLE)


def make(name: str, *values: object) -> object:
    """Return a ROS message."""
    return STORE.types[name](*values)


def header(time_ns: int, frame: str) -> object:
    """Return a header with a stamp and a frame."""
    stamp = make("builtin_interfaces/msg/Time", time_ns // 10**9, time_ns % 10**9)
    return make("std_msgs/msg/Header", stamp, frame)


def cloud(time_ns: int, points: np.ndarray, power_db: np.ndarray) -> object:
    """Return a PointCloud2 with the fields x, y, z and power."""
    rows = np.column_stack([points, power_db]).astype("<f4")
    fields = [
        make("sensor_msgs/msg/PointField", n, 4 * i, 7, 1) for i, n in enumerate(("x", "y", "z", "power"))
    ]
    data, size = np.frombuffer(rows.tobytes(), np.uint8), (1, len(rows))
    head = header(time_ns, "radar")
    return make("sensor_msgs/msg/PointCloud2", head, *size, fields, False, 16, 16 * len(rows), data, True)


def transform(time_ns: int, T_world_sensor: np.ndarray) -> object:
    """Return a TF message for map -> radar."""
    position = make("geometry_msgs/msg/Vector3", *T_world_sensor[:3, 3].tolist())
    x_y_z_w = Rotation.from_matrix(T_world_sensor[:3, :3]).as_quat().tolist()
    moved = make("geometry_msgs/msg/Transform", position, make("geometry_msgs/msg/Quaternion", *x_y_z_w))
    stamped = make("geometry_msgs/msg/TransformStamped", header(time_ns, "map"), "radar", moved)
    return make("tf2_msgs/msg/TFMessage", [stamped])


def record(bag: Path) -> None:
    """Write a bag of scans at 10 Hz, with their poses."""
    drive = radarsdf.simulate.hugin(frames=12)
    with rosbag2.Writer(bag, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP) as writer:
        topics = {"/radar": "sensor_msgs/msg/PointCloud2", "/tf": "tf2_msgs/msg/TFMessage"}
        to = {topic: writer.add_connection(topic, kind, typestore=STORE) for topic, kind in topics.items()}
        for i in range(len(drive)):
            now = 1_700_000_000 * 10**9 + i * 10**8
            scan = cloud(now, drive.points[i], drive.intensities[i])
            for topic, message in (("/tf", transform(now, drive.poses[i])), ("/radar", scan)):
                writer.write(to[topic], now, STORE.serialize_cdr(message, topics[topic]))


def main(folder: Path) -> None:
    """Write a bag, read it and fit a map."""
    bag = folder / "drive_bag"
    if not bag.exists():  # rosbags does not overwrite bags
        record(bag)
    scans = radarsdf.io.read(bag)  # topic="/radar", pose_topic="/tf" if there are several
    print(f"{len(scans)} scans; {scans.notes[0]}")
    radar_map = radarsdf.fit(scans, config=radarsdf.FitConfig(effort=0.5))
    print(radar_map)
    radar_map.save(folder / "map.safetensors")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))
