"""A client of the viewer without a browser: it responds, drags the sensor and records messages."""

import json
import threading
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec
import numpy as np
import viser
import zstandard
from numpy.typing import NDArray
from radarsdf.view import surface as glb
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.typing import Subprotocol

if TYPE_CHECKING:
    from typing_extensions import Self

STEP_S = 0.05
"""The page sends so often where the sensor is."""


@dataclass(frozen=True)
class Received:
    at_s: float
    frame_bytes: int
    message: dict[str, Any]

    @property
    def kind(self) -> str:
        return str(self.message["type"])

    @property
    def name(self) -> str:
        return str(self.message.get("name", ""))

    def changes(self, name: str, what: str) -> bool:
        return self.name == name and what in self.message.get("updates", {})


def is_mesh(message: Received) -> bool:
    return message.kind == "GlbMessage"


class PlainClient:
    def __init__(self, host: str, port: int) -> None:
        protocol = Subprotocol(f"viser-v{viser.__version__}")
        # Meshes arrive in one frame; responses to pings must not wait for them.
        self._socket = connect(
            f"ws://{host}:{port}", subprotocols=[protocol], max_size=None, ping_interval=None
        )
        self._received: list[Received] = []
        self._news = threading.Condition()
        self._thread = threading.Thread(target=self._receive, daemon=True)
        self._thread.start()
        self.send(  # which notifies the server of a page
            "ViewerCameraMessage",
            wxyz=(1.0, 0.0, 0.0, 0.0),
            position=(0.0, 0.0, 0.0),
            fov=1.0,
            near=0.1,
            far=1000.0,
            image_height=700,
            image_width=1000,
            look_at=(0.0, 0.0, 1.0),
            up_direction=(0.0, 0.0, 1.0),
        )

    def __enter__(self) -> "Self":
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()
        self._thread.join()

    def received(self, since: int = 0) -> list[Received]:
        with self._news:
            return self._received[since:]

    def wait_for(self, wanted: Any, since: int = 0, timeout_s: float = 30.0) -> Received:

        def found() -> Received | None:
            return next((message for message in self._received[since:] if wanted(message)), None)

        with self._news:
            message = self._news.wait_for(found, timeout_s)
        if message is None:
            msg = f"the server sent no such message in {timeout_s} s"
            raise TimeoutError(msg)
        return message

    def send(self, kind: str, **fields: Any) -> None:
        self._socket.send(msgspec.msgpack.encode({"type": kind, **fields}))

    def move_sensor(self, position: tuple[float, float, float]) -> None:
        pose: dict[str, Any] = {"position": position, "wxyz": (1.0, 0.0, 0.0, 0.0)}
        self.send("TransformControlsUpdateMessage", name="/sensor", **pose, owner="")

    def drag(self, seconds: float) -> tuple[float, float]:
        began_s = time.perf_counter()
        self.send("TransformControlsDragStartMessage", name="/sensor", owner="")
        steps = round(seconds / STEP_S)
        for step in range(steps):
            self.move_sensor((0.1 * (step + 1), 0.0, 1.0))
            time.sleep(max(0.0, began_s + (step + 1) * STEP_S - time.perf_counter()))
        ended_s = time.perf_counter()
        self.send("TransformControlsDragEndMessage", name="/sensor", owner="")
        return began_s, ended_s

    def _receive(self) -> None:
        try:
            for frame in self._socket:
                assert isinstance(frame, bytes)
                at_s = time.perf_counter()
                size, packed = (int.from_bytes(frame[i : i + 8], "little") for i in (0, 8))
                inner = zstandard.ZstdDecompressor().decompress(frame[16 : 16 + packed], max_output_size=size)
                messages = msgspec.msgpack.decode(inner)["messages"]
                with self._news:
                    self._received += [Received(at_s, len(frame), message) for message in messages]
                    self._news.notify_all()
                for message in messages:
                    if message["type"] == "LocalStorageGetItemRequestMessage":
                        asked = message["request_uuid"]
                        self.send(
                            "LocalStorageGetItemResponseMessage", value=None, error=None, request_uuid=asked
                        )
        except ConnectionClosed:
            pass


class Glb(NamedTuple):
    vertices: NDArray[np.float32]
    faces: NDArray[np.uint32]
    light: NDArray[np.float32]

    @property
    def colors(self) -> NDArray[np.float64]:
        a, b, c, d, e = glb._FIT
        x = self.light.astype(np.float64) @ glb._IN.T / glb._EXPOSURE
        linear = np.clip((x * (x + a) - b) / (x * (c * x + d) + e) @ glb._OUT.T, 0, 1)
        shown: NDArray[np.float64] = 255 * np.where(
            linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055
        )
        return shown

    @classmethod
    def of(cls, data: bytes) -> "Glb":
        described = int.from_bytes(data[12:16], "little")
        tree = json.loads(data[20 : 20 + described])
        binary = data[28 + described :]

        def array(accessor: int, dtype: str, width: int) -> NDArray[Any]:
            found = tree["accessors"][accessor]
            start = tree["bufferViews"][found["bufferView"]]["byteOffset"] + found.get("byteOffset", 0)
            count = found["count"] * (width if found["type"] != "SCALAR" else 1)
            return np.frombuffer(binary, dtype, count, start).reshape(-1, width)

        (primitive,) = tree["meshes"][0]["primitives"]
        attributes = primitive["attributes"]
        return cls(
            array(attributes["POSITION"], "<f4", 3),
            array(primitive["indices"], "<u4", 3),
            array(attributes["COLOR_0"], "<f4", 3),
        )
