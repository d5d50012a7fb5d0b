"""Map a radar in a ROS 2 node of your own, with rclpy. Not run in our tests, which have no ROS.

    python examples/ros2_node.py --ros-args -r points:=/radar/points

Without an own node: `radarsdf live --ros2 /radar/points`.
"""

import numpy as np
import radarsdf
import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import PointCloud2
from sensor_msgs_py import point_cloud2


class Mapper(Node):
    """Tracks the radar, publishes its pose, and writes the map at the end."""

    def __init__(self) -> None:
        super().__init__("radarsdf")
        self.live = radarsdf.LiveMap()
        self.poses = self.create_publisher(PoseStamped, "radarsdf/pose", 10)
        self.create_subscription(PointCloud2, "points", self.on_scan, qos_profile_sensor_data)

    def on_scan(self, message: PointCloud2) -> None:
        """Integrate a scan without a pose; with one, of TF for example, pass it as the second argument."""
        rows = point_cloud2.read_points(message, ["x", "y", "z"], skip_nans=True)
        points = np.column_stack([rows[axis] for axis in "xyz"])
        stamp = message.header.stamp
        try:
            done = self.live.integrate(points, time_s=stamp.sec + 1e-9 * stamp.nanosec)
        except ValueError as error:  # lost, or a repeated scan
            self.get_logger().warning(str(error))
            return
        pose = PoseStamped()
        pose.header.stamp, pose.header.frame_id = stamp, "map"
        at, turned = pose.pose.position, pose.pose.orientation
        at.x, at.y, at.z = done.pose[:3, 3].tolist()
        turned.x, turned.y, turned.z, turned.w = Rotation.from_matrix(done.pose[:3, :3]).as_quat().tolist()
        self.poses.publish(pose)


def main() -> None:
    """Map until Ctrl-C."""
    rclpy.init()
    mapper = Mapper()
    try:
        rclpy.spin(mapper)
    except KeyboardInterrupt:
        mapper.live.finish().save("map.safetensors")


if __name__ == "__main__":
    main()
