"""ROS 2: publishes a growing map under ``/radarsdf``."""

import contextlib
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from radarsdf.arrays import Floats
from radarsdf.grids.grid import Grid
from radarsdf.io.dds import encode, make_message
from radarsdf.io.subscription import Subscription
from radarsdf.scans import Scan
from radarsdf.view.sinks import Sink

_OCCUPANCY = np.array([0, 100, -1], np.int8)  # of free, occupied and unknown columns, as in nav_msgs


class Ros2Sink(Sink):
    """Publishes the pose of the carrier of the radars, surface, grid; and its transform unless others do."""

    def __init__(self, drive: Subscription) -> None:
        self._node, self._drive = drive.node, drive

    def show_scan(self, scan: Scan, time_s: float) -> None:
        frame, T_frame_sensor, published = self._drive.carrier(scan.sensor)
        pose = self._pose(scan.T_world_sensor @ np.linalg.inv(T_frame_sensor))
        self._publish("/pose", "geometry_msgs/msg/PoseStamped", time_s, pose=pose)
        if self._drive.unposed and not published:  # a frame has one parent
            parts = {"translation": pose.position, "rotation": pose.orientation}
            moved = make_message("geometry_msgs/msg/Transform", **parts)
            one = {"header": self._header(time_s), "child_frame_id": frame, "transform": moved}
            transforms = [make_message("geometry_msgs/msg/TransformStamped", **one)]
            self._node.publish("/tf", make_message("tf2_msgs/msg/TFMessage", transforms=transforms))

    def show_surface(self, mesh: Any, path: Floats, time_s: float) -> None:  # noqa: ARG002 - poses are published
        scale, message_type = _geometry("Vector3", np.ones(3)), "visualization_msgs/msg/Marker"
        color = make_message("std_msgs/msg/ColorRGBA", r=0.7, g=0.7, b=0.7, a=1.0)
        # Points are encoded by NumPy, as objects would take a second for 50,000 triangles: one of them marks their place.
        mark = np.full(3, 1e300)
        values = {"ns": "radarsdf", "type": 11, "pose": self._pose(np.eye(4)), "scale": scale, "color": color}
        points = [_geometry("Point", mark)]
        marker = make_message(message_type, header=self._header(time_s), points=points, **values)
        before, after = encode(marker).split(mark.tobytes())
        vertices, one = mesh.triangles.reshape(-1, 3), np.array(1, "<u4").tobytes()
        at = before.rindex(one)  # the number of points; up to 4 bytes of padding follow
        count = np.array(len(vertices), "<u4").tobytes()
        encoded = before[:at] + count + before[at + 4 :] + vertices.astype("<f8").tobytes() + after
        self._node.publish("/radarsdf/surface", marker, encoded=encoded, latched=True)

    def show_grid(self, grid: Grid, time_s: float) -> None:
        with contextlib.suppress(ValueError):  # without ground
            flat = grid.flat()
            origin = np.eye(4)
            origin[:2, 3] = flat.origin
            width, height = flat.state.shape
            size = {"width": width, "height": height, "resolution": flat.cell_size}
            info = make_message("nav_msgs/msg/MapMetaData", origin=self._pose(origin), **size)
            cells = _OCCUPANCY[flat.state.T].ravel()
            self._publish("/grid", "nav_msgs/msg/OccupancyGrid", time_s, latched=True, info=info, data=cells)

    def _publish(
        self, name: str, message_type: str, time_s: float, latched: bool = False, **values: Any
    ) -> None:
        message = make_message(message_type, header=self._header(time_s), **values)
        self._node.publish(f"/radarsdf{name}", message, latched=latched)

    def _header(self, time_s: float) -> Any:
        parts = {"sec": int(time_s // 1), "nanosec": int(time_s % 1 * 1e9)}
        stamp = make_message("builtin_interfaces/msg/Time", **parts)
        return make_message("std_msgs/msg/Header", stamp=stamp, frame_id=self._drive.world)

    def _pose(self, T: Floats) -> Any:
        quaternion = _geometry("Quaternion", Rotation.from_matrix(T[:3, :3]).as_quat())
        position = _geometry("Point", T[:3, 3])
        return make_message("geometry_msgs/msg/Pose", position=position, orientation=quaternion)


def _geometry(name: str, values: Floats) -> Any:
    return make_message(f"geometry_msgs/msg/{name}", **dict(zip("xyzw", values, strict=False)))
