# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The server of the page: where it listens, and when a page has drawn what was sent. The one module that imports viser."""

from __future__ import annotations

import contextlib
import errno
import gc
import io
import os
import socket
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from http import HTTPStatus
from typing import Any

from radarsdf.checks import whole_number
from radarsdf.extras import require
from radarsdf.view.guarding import MAX_MESSAGE_BYTES, bounded, others_reach, why_refused

_PORTS_TRIED = 100
_TITLE = "radarsdf"
_WINDOW_S = 0.05  # viser collects messages for a sixtieth of a second
_ROUND_TRIPS = 3
_PATIENCE_S = 20.0
_STARTING = threading.Lock()
WAIT_STEP_S = 0.2
"""The main thread waits in such steps: where the system hands Ctrl-C to another thread, an endless wait does not see it."""


def require_viser() -> None:
    """Raise an ImportError that says what to install, if viser is missing."""
    require("viser", what="the viewer needs")


def free_port(host: str, port: int, *, exactly: bool) -> int:
    """The port to listen on: `port`, or unless it must be `exactly` that one, the next that is free.

    Raises
    ------
    ValueError
        If `port` is no port.
    OSError
        If there is none, or the host is not an address of this machine.
    """
    whole_number(port, "--port", 0, 65535)
    # Before viser tries: of an address that it cannot listen on it would wait for ever.
    for candidate in [port] if exactly else range(port, min(port + _PORTS_TRIED, 65536)):
        try:
            with socket.create_server((host, candidate), family=_family(host)) as listening:
                found: int = listening.getsockname()[1]
                return found
        except OSError as error:  # also of a name that is none
            reason = (error.strerror or str(error)).partition(" (while")[0]
            if error.errno not in (errno.EADDRINUSE, errno.EACCES):
                msg = f"cannot listen on {host}, port {candidate}: {reason}; --host takes an address of this machine"
                raise OSError(msg) from error
    msg = f"cannot listen on {host}, port {port}: {reason}; --port takes another"
    raise OSError(msg)


def _family(host: str) -> socket.AddressFamily:
    """IPv4 or IPv6."""
    return socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)[0][0]


def start_server(host: str, port: int) -> Any:
    """A `viser.ViserServer` that listens on host and port, without the button that would make the page public.

    It refuses requests of other pages, and takes of messages only what :func:`bounded` leaves.

    Raises
    ------
    ImportError
        If viser is missing.
    OSError
        If the port was taken meanwhile.
    """
    require_viser()
    import viser  # noqa: PLC0415

    if others_reach(host):
        msg = f"--host {host}: whoever can reach this address of the machine can see and operate the page"
        warnings.warn(msg, RuntimeWarning, stacklevel=2)
    controls: dict[str, Mapping[str, Any]] = {}
    with _silence(), _guarded(host, port, controls):
        server: Any = viser.ViserServer(host, port, _TITLE, verbose=False)
    controls["all"] = server.gui._gui_input_handle_from_uuid
    # viser's objects of a connection refer to each other, and to all that was sent. Python's collector would leave them
    # until there are many: 1 MB a connection, with a mesh of 1 MB.
    server.on_client_disconnect(lambda _: gc.collect())
    # A page asks for it by a message, which others can send too: a tunnel through a third party.
    server.request_share_url = lambda *_, **__: None
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    if server.get_port() != port:
        stop_server(server)
        msg = f"port {port} of {host} was taken meanwhile"
        raise OSError(msg)
    return server


@contextlib.contextmanager
def _guarded(host: str, port: int, controls: Mapping[str, Mapping[str, Any]]) -> Iterator[None]:
    """Let the server that viser starts meanwhile on this host ask `why_refused` and `bounded`.

    viser has no door for that, but the function of websockets that it calls has two: a function that is asked before
    each request is answered, and the class of a connection.

    Raises
    ------
    RuntimeError
        If viser did not start its server by that function: it would be open to all pages.
    """
    import msgspec  # noqa: PLC0415 - viser needs it and websockets
    import websockets.asyncio.server  # noqa: PLC0415
    from websockets.asyncio.server import ServerConnection  # noqa: PLC0415

    library: Any = websockets.asyncio.server

    class Connection(ServerConnection):
        async def recv(self, decode: bool | None = None) -> Any:
            while True:
                data: Any = await super().recv(decode)
                try:
                    message = bounded(msgspec.msgpack.decode(data), controls.get("all", {}))
                except (msgspec.MsgspecError, RecursionError, TypeError, ValueError):  # also of text
                    continue
                if message is not None:
                    return msgspec.msgpack.encode(message)

    guarded = []
    serve = library.serve

    def guarded_serve(
        handler: Any, own_host: Any, own_port: Any, *, process_request: Any, **given: Any
    ) -> Any:
        # If the port is taken meanwhile, viser tries the next ones.
        if own_host != host or own_port < port or not handler.__module__.startswith("viser."):
            return serve(handler, own_host, own_port, process_request=process_request, **given)

        def process(connection: Any, request: Any) -> Any:
            headers = request.headers
            why = why_refused(headers.get_all("Host"), headers.get_all("Origin"), host)
            if why is not None:
                return connection.respond(HTTPStatus.FORBIDDEN, f"{why}\n")
            return process_request(connection, request)

        guarded.append(own_port)
        given |= {"create_connection": Connection, "max_size": MAX_MESSAGE_BYTES}
        return serve(handler, own_host, own_port, process_request=process, **given)

    with _STARTING:
        library.serve = guarded_serve
        try:
            yield
        finally:
            library.serve = serve
    if not guarded:
        msg = "this version of viser cannot be guarded against other pages of the browser: install another"
        raise RuntimeError(msg)


def stop_server(server: Any) -> None:
    """Close all connections and end the threads of a server."""
    with _silence():
        server.stop()


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    """Keep what viser prints from standard output, where each command prints its own lines."""
    with contextlib.redirect_stdout(io.StringIO()):
        yield


def wait_until_drawn(server: Any, superseded: Callable[[], bool]) -> None:
    """Wait until each page has drawn what was sent so far, or something newer is to be drawn.

    viser does not tell. A question to the page is answered after what came before it: the first answer says that the
    messages before were received and the last ones are on their way, the second that these were received, the third
    that the page has been through another frame.
    """
    time.sleep(_WINDOW_S)
    for client in server.get_clients().values():
        until_s = time.monotonic() + _PATIENCE_S
        answers = 0
        while answers < _ROUND_TRIPS and time.monotonic() < until_s and not superseded():
            try:
                client.local_storage.get_item("drawn", timeout=0.5)
            except TimeoutError:
                continue
            except RuntimeError as error:  # the page has no storage, which is an answer too, or is gone
                if "disconnected" in str(error):
                    break
            answers += 1


def has_display() -> bool:
    """Whether a browser that is started here would be seen by who sits here."""
    if "SSH_CONNECTION" in os.environ:
        return False
    return sys.platform != "linux" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def url_of(host: str, port: int) -> str:
    """Where a browser on this machine finds the page."""
    return f"http://{_reached(host)}:{port}"


def ssh_line(host: str, port: int) -> str:
    """The command that brings the page of this machine to another one."""
    return f"ssh -L {port}:{_reached(host)}:{port} {socket.gethostname()}"


def _reached(host: str) -> str:
    """The name under which this machine reaches a server that listens on the address `host`."""
    if host in ("127.0.0.1", "::1", "0.0.0.0", "::"):
        return "localhost"
    return f"[{host}]" if ":" in host else host
