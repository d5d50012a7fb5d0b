"""Server of a page and its address. The only module that imports viser.

It refuses requests from other web pages in the same browser, which could reach this machine, even by DNS rebinding. Browsers report
the requested name as `Host`, and the requesting page as `Origin`.
"""

import contextlib
import errno
import gc
import importlib
import io
import ipaddress
import math
import os
import socket
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple
from urllib.parse import urlsplit

import numpy as np
from typing_extensions import Self

from radarsdf.arrays import Floats
from radarsdf.checks import check, whole_number
from radarsdf.extras import require

LOCALHOST = "127.0.0.1"
_FIRST_PORT, _PORTS_TRIED = 8080, 100
WAIT_STEP_S = 0.2  # step of waits in the main thread: on Windows, Ctrl-C does not interrupt an endless wait
FOV_RAD = 0.85  # vertical field of view: less than viser's, so that walls stay upright
ASPECT = 1.3  # width over height of a page's frame, until the page reports its own
_TO_EYE = np.array([-0.33, -0.57, 0.5])
_MARGIN = 1.08


def free_port(host: str, port: int | None, first: int | None = None) -> int:
    """Return `port`, or the first free one from `first`, 8080. Raise an OSError if there is none, for which viser would wait forever."""
    candidates = range(first := first or _FIRST_PORT, first + _PORTS_TRIED)
    if port is not None:
        candidates = range(whole_number(port, "--port", 0, 65535), port + 1)
    for candidate in candidates:
        try:
            family = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)[0][0]
            with socket.create_server((host, candidate), family=family) as listening:
                return int(listening.getsockname()[1])
        except OSError as error:  # raised also for an unknown host name
            reason = error.strerror or str(error)
            if error.errno not in (errno.EADDRINUSE, errno.EACCES):
                break
    msg = f"cannot listen on {host}, port {candidate}: {reason}; --host takes an address of this machine, --port a free port"
    raise OSError(msg)


def page_port(host: str, port: int | None) -> int:
    """Return the :func:`free_port` of a page. Raises an ImportError without viser."""
    require("viser", what="the viewer needs")
    return free_port(host, port)


def refusal(hosts: Sequence[str], origins: Sequence[str], listening: str) -> str | None:
    """Reason to refuse a request with these ``Host`` and ``Origin`` headers by a server on `listening`; None to accept it."""
    if len(hosts) != 1 or not _is_this_machine(hosts[0], listening.lower()):
        return "the Host of the request is not this server"
    own = {f"{scheme}://{hosts[0]}".lower() for scheme in ("http", "https")}
    if len(origins) > 1 or not own.issuperset(origin.lower() for origin in origins):
        return "the Origin of the request is another page"
    return None


def _is_this_machine(host: str, listening: str) -> bool:
    with contextlib.suppress(ValueError):
        name = urlsplit(f"//{host}").hostname
        if name in ("localhost", "127.0.0.1", "::1", listening):
            return True
        if listening in ("0.0.0.0", "::", ""):  # any address or the machine's name: neither can be rebound
            machine = socket.gethostname().lower()
            return name in (machine, f"{machine}.local") or bool(ipaddress.ip_address(name or ""))
    return False


@contextlib.contextmanager
def guarded(listening: str) -> Iterator[None]:
    """Make the server that viser starts in this block, by a function of websockets, call :func:`refusal` first."""
    library: Any = importlib.import_module("websockets.asyncio.server")
    serve, started = library.serve, []

    def guarded_serve(*given: Any, process_request: Any, **options: Any) -> Any:
        def process(connection: Any, request: Any) -> Any:
            why = refusal(request.headers.get_all("Host"), request.headers.get_all("Origin"), listening)
            return connection.respond(403, f"{why}\n") if why else process_request(connection, request)

        started.append(given)
        return serve(*given, process_request=process, **options)

    library.serve = guarded_serve
    try:
        yield
    finally:
        library.serve = serve
    check(started, "this viser cannot be guarded against other pages: install another version", RuntimeError)


def start_server(host: str, port: int) -> Any:
    """Start a `viser.ViserServer` that answers only its own pages. Warns if other machines can reach it."""
    import viser  # noqa: PLC0415

    addresses = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)
    if not all(ipaddress.ip_address(address[4][0]).is_loopback for address in addresses):
        msg = f"--host {host}: anyone who can reach this address can see and operate the page"
        warnings.warn(msg, RuntimeWarning, stacklevel=2)
    with contextlib.redirect_stdout(io.StringIO()), guarded(host):  # viser prints
        server: Any = viser.ViserServer(host, port, "radarsdf", verbose=False)
    # viser's objects for a connection form cycles that hold all sent data, 1 MB each with a mesh of 1 MB.
    server.on_client_disconnect(lambda _: gc.collect())
    # A message from the page would open a public tunnel through a third party.
    server.request_share_url = lambda *_, **__: None
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    if server.get_port() != port:
        stop_server(server)
        msg = f"port {port} of {host} was taken in the meantime"
        raise OSError(msg)
    return server


def stop_server(server: Any) -> None:
    with contextlib.redirect_stdout(io.StringIO()):  # viser prints
        server.stop()


def aim(camera: Any, pose: "CameraPose") -> None:
    camera.fov = FOV_RAD
    camera.position, camera.look_at = map(tuple, pose)


def wait_until_drawn(server: Any, superseded: Callable[[], bool], patience_s: float = 20.0) -> None:
    """Wait until each page has drawn what was sent so far, or `superseded` returns True.

    viser does not report that, but a page answers a request after the messages before it. The first answer shows that the last
    messages are under way, the second that they have arrived, the third that another frame was drawn.
    """
    time.sleep(0.05)  # viser collects messages for a sixtieth of a second
    for client in server.get_clients().values():
        until_s = time.monotonic() + patience_s
        answers = 0
        while answers < 3 and time.monotonic() < until_s and not superseded():
            try:
                client.local_storage.get_item("drawn", timeout=0.5)
            except TimeoutError:
                continue
            except RuntimeError as error:  # a page without storage, which is an answer too, or a closed page
                if "disconnected" in str(error):
                    break
            answers += 1


def wait() -> None:
    while True:
        time.sleep(WAIT_STEP_S)


class Page:
    """A page served until it is stopped. Raises an OSError for a taken port before any work."""

    def __init__(self, host: str = LOCALHOST, port: int | None = None) -> None:
        self.host, self.port = host, page_port(host, port)
        self.url = url_of(host, self.port)

    def _start(self) -> None:
        self._server: Any = start_server(self.host, self.port)

    def stop(self) -> None:
        stop_server(self._server)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()


def has_display() -> bool:
    """Whether a browser started here would be visible to the user."""
    if "SSH_CONNECTION" in os.environ:
        return False
    return sys.platform != "linux" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def url_of(host: str, port: int) -> str:
    if host in ("127.0.0.1", "::1", "0.0.0.0", "::"):
        return f"http://localhost:{port}"
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"


class CameraPose(NamedTuple):
    position: Floats  # (3,) m
    look_at: Floats  # (3,) m, centre of the orbit of the user's rotations


def framing_pose(points: Floats, to_eye: Floats = _TO_EYE, aspect: float = ASPECT) -> CameraPose:
    """Nearest camera, with z up, that sees all points (N, 3), m, in the direction `to_eye` (3,), which must not be vertical."""
    back = to_eye / np.linalg.norm(to_eye)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    up = np.cross(back, right)
    tangent = math.tan(FOV_RAD / 2) / _MARGIN
    depth_m = points @ back
    # A camera at a along an axis and t back sees a point x if |x - a| <= slope * (t - depth).
    sides = [(axis, points @ axis, slope) for axis, slope in ((right, tangent * aspect), (up, tangent))]
    ends = [((depth_m + x / slope).max(), (depth_m - x / slope).max(), slope) for _, x, slope in sides]
    far_m = max(float(one + other) / 2 for one, other, _ in ends)
    middle = np.zeros(3)
    for (axis, x, _), (one, other, slope) in zip(sides, ends, strict=True):
        a = slope * (one - other) / 2
        for _ in range(4):  # if the frame is wider than needed, the middle shifts
            at = (x - a) / (far_m - depth_m)
            a += (at.max() + at.min()) / 2 * float(far_m - depth_m.mean())
        middle = middle + a * axis
    center_m = float(depth_m.min() + depth_m.max()) / 2
    return CameraPose(middle + far_m * back, middle + center_m * back)
