"""Server of a page and its address. The only module that imports viser."""

from __future__ import annotations

import contextlib
import errno
import gc
import io
import ipaddress
import os
import socket
import sys
import time
import warnings
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from radarsdf.checks import whole_number
from radarsdf.extras import require
from radarsdf.view.framing import FOV_RAD, CameraPose
from radarsdf.view.guarding import guarded

if TYPE_CHECKING:
    from typing_extensions import Self

LOCALHOST = "127.0.0.1"
_FIRST_PORT, _PORTS_TRIED = 8080, 100
WAIT_STEP_S = 0.2  # step of waits in the main thread: on Windows, Ctrl-C does not interrupt an endless wait


def require_viser() -> None:
    """Raise an ImportError with the install command if viser is missing."""
    require("viser", what="the viewer needs")


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
    """Close all connections and end the threads of a server."""
    with contextlib.redirect_stdout(io.StringIO()):  # viser prints
        server.stop()


def set_initial_camera(server: Any, pose: CameraPose) -> None:
    """Set the initial camera of new pages."""
    camera = server.initial_camera
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
    """Wait until Ctrl-C."""
    while True:
        time.sleep(WAIT_STEP_S)


class Page:
    """A page served until it is stopped. Raises an OSError for a taken port before any work."""

    def __init__(self, host: str = LOCALHOST, port: int | None = None) -> None:
        require_viser()
        self.host = host
        self.port = free_port(host, port)

    def _start(self) -> None:
        self._server: Any = start_server(self.host, self.port)

    def stop(self) -> None:
        """Close the page and end all threads."""
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
    """The page's address for a browser on this machine."""
    if host in ("127.0.0.1", "::1", "0.0.0.0", "::"):
        return f"http://localhost:{port}"
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"
