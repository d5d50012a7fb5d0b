"""What a growing map shows, to viewers and files: Foxglove (WebSocket, MCAP) and rerun (web viewer, .rrd), both extras."""

import contextlib
import importlib
import os
import shutil
import subprocess
from abc import ABC, abstractmethod
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast
from urllib.parse import quote

import numpy as np
from scipy.spatial.transform import Rotation

from radarsdf.arrays import Array, Bytes, Floats
from radarsdf.checks import restating
from radarsdf.extras import require
from radarsdf.grids.grid import Grid
from radarsdf.io.files import checked_suffix, whole_file
from radarsdf.io.ros2 import Node, Subscription, encode, make_message
from radarsdf.map.colors import Scale
from radarsdf.scans import Scan
from radarsdf.view.serving import LOCALHOST, free_port

PATH_COLOR, FREE_COLOR = (0, 190, 255), (90, 160, 120)
# RGBA of free, occupied and unknown voxels.
_STATE_COLORS = np.array([[*FREE_COLOR, 40], [200, 60, 40, 255], [0, 0, 0, 0]], np.uint8)
_OCCUPANCY = np.array([0, 100, -1], np.int8)  # of the same, as in nav_msgs
_CELL = [(name, "u1") for name in ("red", "green", "blue", "alpha")]


class Sink(ABC):
    """A page, a viewer or a file. Positions are in the world frame, m. Methods may be called from several threads."""

    origin: Floats | None = None  # (3,) world, m: viewers compute in float32

    @abstractmethod
    def show_scan(self, scan: Scan, time_s: float) -> None:
        """Show the returns of a scan, and the pose of its radar."""

    @abstractmethod
    def show_surface(self, mesh: Any, path: Floats, time_s: float) -> None:
        """Replace the mesh, coloured by its uncertainty, and the sensor positions (F, 3)."""

    @abstractmethod
    def show_grid(self, grid: Grid, time_s: float) -> None:
        """Replace occupied and free space."""

    def _local(self, positions: Floats) -> Floats:
        """Return positions (N, 3) relative to :attr:`origin`, whole kilometres near the first one."""
        if self.origin is None:
            self.origin = np.round(positions[0], -3)
        return positions - self.origin


class FoxgloveSink(Sink):
    """Logs messages of Foxglove to the files and servers of a context. The world frame is ``map``, as in ROS."""

    def __init__(self, foxglove: Any, context: Any) -> None:
        self._foxglove, self._of, self._context = foxglove, foxglove.messages, context
        self._channels: dict[str, Any] = {}
        self._last: dict[str, tuple[bytes, int]] = {}  # message and its time, ns, by topic

    def show_again(self, _client: Any, channel: Any) -> None:
        """Log the last message of a channel again, for a client that subscribes later."""
        if channel.topic in self._last:
            encoded, time_ns = self._last[channel.topic]
            self._channels[channel.topic].log(encoded, log_time=time_ns)

    def show_scan(self, scan: Scan, time_s: float) -> None:
        of, frame, T = self._of, _frame_of(scan), scan.T_world_sensor
        position, rotation = self._placed(T[:3, 3], T[:3, :3])
        moved = {"child_frame_id": frame, "translation": position, "rotation": rotation}
        self._log("/tf", of.FrameTransform, time_s, parent_frame_id="map", **moved)
        pose = of.Pose(position=position, orientation=rotation)
        self._log(f"/pose/{frame}", of.PoseInFrame, time_s, frame_id="map", pose=pose)
        columns = dict(zip("xyz", scan.points.T, strict=True))
        if scan.intensities is not None:
            columns["intensity"] = scan.intensities
        rows = np.rec.fromarrays(list(columns.values()), [(name, "<f4") for name in columns])
        self._log_cells(f"/returns/{frame}", of.PointCloud, time_s, rows, frame_id=frame)

    def show_surface(self, mesh: Any, path: Floats, time_s: float) -> None:
        of, positions = self._of, self._local(path)
        line = {"pose": self._pose(self.origin), "thickness": 3.0, "scale_invariant": True}
        lines = of.LinePrimitive(**line).encode() + _points(5, positions)
        lines += _points(6, np.append(PATH_COLOR, 255)[None] / 255)
        # Encoded by NumPy: objects for each vertex take a quarter of a second for 50,000.
        colors = np.column_stack([uncertainty_colors(mesh)[0], np.full(len(mesh.vertices), 255)]) / 255
        triangles = of.TriangleListPrimitive(pose=line["pose"]).encode() + _points(4, colors)
        triangles += _points(2, self._local(mesh.vertices)) + _field(5, mesh.faces.astype("<u4").tobytes())
        entity = of.SceneEntity(timestamp=self._stamp(time_s), frame_id="map", id="surface").encode()
        entity = _field(2, entity + _field(11, lines) + _field(12, triangles))
        self._log("/surface", of.SceneUpdate, time_s, entity)

    def show_grid(self, grid: Grid, time_s: float) -> None:
        of, size_m, cells = self._of, grid.voxel_size, _cells(grid.state)
        place = {"frame_id": "map", "pose": self._pose(grid.origin), "column_count": cells.shape[2]}
        rows = {"row_count": cells.shape[1], "cell_size": of.Vector3(x=size_m, y=size_m, z=size_m)}
        self._log_cells("/free_space", of.VoxelGrid, time_s, cells, **place, **rows)
        with contextlib.suppress(ValueError):  # without ground
            size = of.Vector2(x=size_m, y=size_m)
            self._log_cells("/grid", of.Grid, time_s, _cells(grid.flat().state), **place, cell_size=size)

    def _log_cells(self, topic: str, schema: Any, time_s: float, cells: Array, **values: Any) -> None:
        """Log an array of records (N,), (Y, X) or (Z, Y, X)."""
        of, layout = self._of, cast(Any, cells.dtype.fields)
        kinds = {1: of.PackedElementFieldNumericType.Uint8, 4: of.PackedElementFieldNumericType.Float32}
        parts = ((name, at, kinds[kind.itemsize]) for name, (kind, at) in layout.items())
        fields = [of.PackedElementField(name=name, offset=at, type=kind) for name, at, kind in parts]
        names = ["slice_stride", "row_stride", "cell_stride"] if cells.ndim > 1 else ["point_stride"]
        values |= dict(zip(names[-cells.ndim :], cells.strides, strict=True))
        self._log(topic, schema, time_s, fields=fields, data=cells.tobytes(), **values)

    def _log(self, topic: str, schema: Any, time_s: float, encoded: bytes = b"", **values: Any) -> None:
        if topic not in self._channels:
            options = {"message_encoding": "protobuf", "context": self._context}
            self._channels[topic] = self._foxglove.Channel(topic, schema=schema.get_schema(), **options)
        encoded = encoded or schema(timestamp=self._stamp(time_s), **values).encode()
        self._last[topic] = encoded, round(1e9 * time_s)
        self._channels[topic].log(encoded, log_time=round(1e9 * time_s))

    def _stamp(self, time_s: float) -> Any:
        return self._of.Timestamp(sec=int(time_s // 1), nsec=int(time_s % 1 * 1e9))

    def _placed(self, position: Any, R: Any = None) -> tuple[Any, Any]:
        x, y, z, w = (0.0, 0.0, 0.0, 1.0) if R is None else Rotation.from_matrix(R).as_quat().tolist()
        vector = self._of.Vector3(**dict(zip("xyz", position.tolist(), strict=True)))
        return vector, self._of.Quaternion(x=x, y=y, z=z, w=w)

    def _pose(self, position: Any) -> Any:
        return self._of.Pose(**dict(zip(("position", "orientation"), self._placed(position), strict=True)))


class RerunSink(Sink):
    def __init__(self, rerun: Any, stream: Any) -> None:
        self._rerun, self._stream = rerun, stream
        stream.log("map", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)

    def show_scan(self, scan: Scan, time_s: float) -> None:
        T, name = scan.T_world_sensor, f"map/{_frame_of(scan)}"
        pose = self._rerun.Transform3D(translation=self._local(T[None, :3, 3])[0], mat3x3=T[:3, :3])
        self._log(time_s, {name: pose, f"{name}/returns": self._rerun.Points3D(scan.points, radii=0.05)})

    def show_surface(self, mesh: Any, path: Floats, time_s: float) -> None:
        style = {"vertex_normals": mesh.vertex_normals, "vertex_colors": uncertainty_colors(mesh)[0]}
        local = {"vertex_positions": self._local(mesh.vertices), "triangle_indices": mesh.faces}
        line = self._rerun.LineStrips3D([self._local(path)], colors=[PATH_COLOR])
        self._log(time_s, {"map/trajectory": line, "map/surface": self._rerun.Mesh3D(**local, **style)})

    def show_grid(self, grid: Grid, time_s: float) -> None:
        free, radius_m = self._local(grid.centres(grid.free)), 0.2 * grid.voxel_size
        points = self._rerun.Points3D(free, colors=[FREE_COLOR], radii=radius_m)
        self._log(time_s, {"map/free_space": points})

    def _log(self, time_s: float, entities: dict[str, Any]) -> None:
        self._stream.set_time("time", timestamp=time_s)  # of this thread
        for name, entity in entities.items():
            self._stream.log(name, entity)


class Ros2Sink(Sink):
    """Publishes under ``/radarsdf``: pose of the carrier of the radars, surface, grid; and its transform unless others do."""

    def __init__(self, node: Node, drive: Subscription) -> None:
        self._node, self._drive = node, drive

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


@contextlib.contextmanager
def foxglove_sink(path: Path | None) -> Iterator[tuple[Sink, str]]:
    """Yield a sink that writes an MCAP file whole or not at all; without a path, one that serves this machine only, and its address."""
    foxglove = require("foxglove", what="Foxglove and MCAP files need")
    context = foxglove.Context()
    checked_suffix(path, [".mcap"], "Foxglove")
    if path is not None:
        with whole_file(path) as file, foxglove.open_mcap(file, context=context) as written:
            yield FoxgloveSink(foxglove, context), ""
            with restating(f"{path} was not written", RuntimeError, kind=OSError):  # such as on a full disk
                written.close()
        return
    port = free_port(LOCALHOST, None, 8765)
    sink = FoxgloveSink(foxglove, context)
    listener = importlib.import_module("foxglove.websocket").ServerListener
    of_clients = type("Subscribed", (listener,), {"on_subscribe": sink.show_again})()
    options = {"context": context, "server_listener": of_clients}
    server = foxglove.start_server(name="radarsdf", host=LOCALHOST, port=port, **options)
    try:
        yield sink, f"ws://{LOCALHOST}:{port}"
    finally:
        server.stop()


@contextlib.contextmanager
def rerun_sink(path: Path | None) -> Iterator[tuple[Sink, str]]:
    """Yield a sink that writes an .rrd file whole or not at all; without a path, a web viewer for this machine only, and its address."""
    rerun = require("rerun", what="rerun needs")
    stream = rerun.RecordingStream("radarsdf")
    checked_suffix(path, [".rrd"], "rerun")
    if path is not None:
        with whole_file(path) as file:
            stream.save(file.name)
            yield RerunSink(rerun, stream), ""
            with restating(f"{path} was not written", RuntimeError, kind=OSError):
                stream.flush()
            stream.disconnect()
        return
    port = free_port(LOCALHOST, None, 9876)
    page = free_port(LOCALHOST, None, port + 1)
    words = ["--serve-web", "--bind", LOCALHOST, "--port", str(port), "--web-viewer-port", str(page)]
    # The SDK itself would serve to all machines, and `python -m rerun` is the parent of the viewer. Ctrl-C is not for it.
    package = Path(importlib.import_module("rerun_cli").__file__ or "").parent
    binary = shutil.which("rerun", path=f"{package}{os.pathsep}{package / 'Rerun.app/Contents/MacOS'}")
    quiet: dict[str, Any] = dict.fromkeys(("stdout", "stderr"), subprocess.DEVNULL)
    with subprocess.Popen([binary or "rerun", *words], start_new_session=True, **quiet) as server:
        try:
            stream.connect_grpc(url := f"rerun+http://{LOCALHOST}:{port}/proxy")
            yield RerunSink(rerun, stream), f"http://{LOCALHOST}:{page}?url={quote(url)}"
            stream.disconnect()
        finally:
            server.terminate()


def uncertainty_colors(mesh: Any) -> tuple[Bytes, Scale]:
    """Return the sRGB colours (V, 3) of the vertices of a mesh by their uncertainty, and their scale, m."""
    uncertainty_m = np.asarray(mesh.vertex_attributes["uncertainty_m"])
    scale = Scale.of(uncertainty_m)
    return scale(uncertainty_m), scale


def _frame_of(scan: Scan) -> str:
    # With a slash, one radar would be the parent of another.
    return "radar" if scan.sensor is None else f"radar_{scan.sensor}".replace("/", "_")


def _cells(state: Array) -> Array:
    """Return states (X, Y) or (X, Y, Z) as colours, (Y, X) or (Z, Y, X): x varies fastest."""
    return _STATE_COLORS[state.T].view(_CELL)[..., 0]


def _field(number: int, content: bytes) -> bytes:
    """Encode a field of Protocol Buffers: a message or packed numbers."""
    size, length = len(content), []
    while size > 127:
        length.append(size & 127 | 128)
        size >>= 7
    return bytes([number << 3 | 2, *length, size]) + content


def _points(number: int, values: Array) -> bytes:
    """Encode rows (N, K) as a repeated field of messages of K doubles, such as Point3 and Color."""
    count = values.shape[1]
    rows = np.zeros(len(values), [("head", "u1", 2), ("values", [("tag", "u1"), ("value", "<f8")], count)])
    rows["head"] = number << 3 | 2, 9 * count
    rows["values"]["tag"], rows["values"]["value"] = 8 * np.arange(1, count + 1) + 1, values
    return rows.tobytes()
