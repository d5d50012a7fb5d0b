"""Foxglove: messages of a growing map by WebSocket, or in an MCAP file. An extra."""

import contextlib
import importlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np
from scipy.spatial.transform import Rotation

from radarsdf.arrays import Array, Floats
from radarsdf.checks import restating
from radarsdf.extras import require
from radarsdf.grids.grid import Grid
from radarsdf.io.files import checked_suffix, whole_file
from radarsdf.scans import Scan
from radarsdf.view.serving import LOCALHOST, free_port
from radarsdf.view.sinks import FREE_COLOR, PATH_COLOR, Sink, frame_of, uncertainty_colors

# RGBA of free, occupied and unknown voxels.
_STATE_COLORS = np.array([[*FREE_COLOR, 40], [200, 60, 40, 255], [0, 0, 0, 0]], np.uint8)
_CELL = [(name, "u1") for name in ("red", "green", "blue", "alpha")]


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
        of, frame, T = self._of, frame_of(scan), scan.T_world_sensor
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
        of, positions = self._of, self.local(path)
        line = {"pose": self._pose(self.origin), "thickness": 3.0, "scale_invariant": True}
        lines = of.LinePrimitive(**line).encode() + _points(5, positions)
        lines += _points(6, np.append(PATH_COLOR, 255)[None] / 255)
        # Encoded by NumPy: objects for each vertex take a quarter of a second for 50,000.
        colors = np.column_stack([uncertainty_colors(mesh)[0], np.full(len(mesh.vertices), 255)]) / 255
        triangles = of.TriangleListPrimitive(pose=line["pose"]).encode() + _points(4, colors)
        triangles += _points(2, self.local(mesh.vertices)) + _field(5, mesh.faces.astype("<u4").tobytes())
        entity = of.SceneEntity(timestamp=self._stamp(time_s), frame_id="map", id="surface").encode()
        entity = _field(2, entity + _field(11, lines) + _field(12, triangles))
        self._log("/surface", of.SceneUpdate, time_s, entity)

    def show_grid(self, grid: Grid, time_s: float) -> None:
        of, size_m, cells = self._of, grid.voxel_size, _cells(grid.state)
        place = {"frame_id": "map", "pose": self._pose(grid.origin), "column_count": cells.shape[2]}
        rows = {"row_count": cells.shape[1], "cell_size": of.Vector3(x=size_m, y=size_m, z=size_m)}
        self._log_cells("/free_space", of.VoxelGrid, time_s, cells, **place, **rows)
        with contextlib.suppress(ValueError):  # without ground
            flat, size = grid.flat(), of.Vector2(x=size_m, y=size_m)
            place["pose"] = self._pose(np.append(flat.origin, flat.ground_m))
            self._log_cells("/grid", of.Grid, time_s, _cells(flat.state), **place, cell_size=size)

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


@contextlib.contextmanager
def foxglove_sink(path: Path | None) -> Iterator[Sink]:
    """Yield a sink that writes an MCAP file whole or not at all; without a path, one that serves this machine only."""
    foxglove = require("foxglove", what="Foxglove and MCAP files need")
    context = foxglove.Context()
    checked_suffix(path, [".mcap"], "Foxglove")
    if path is not None:
        with whole_file(path) as file, foxglove.open_mcap(file, context=context) as written:
            yield FoxgloveSink(foxglove, context)
            with restating(f"{path} was not written", RuntimeError, kind=OSError):  # such as on a full disk
                written.close()
        return
    port = free_port(LOCALHOST, None, 8765)
    sink = FoxgloveSink(foxglove, context)
    listener = importlib.import_module("foxglove.websocket").ServerListener
    of_clients = type("Subscribed", (listener,), {"on_subscribe": sink.show_again})()
    options = {"context": context, "server_listener": of_clients}
    server = foxglove.start_server(name="radarsdf", host=LOCALHOST, port=port, **options)
    sink.url = f"ws://{LOCALHOST}:{port}"
    try:
        yield sink
    finally:
        server.stop()


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
