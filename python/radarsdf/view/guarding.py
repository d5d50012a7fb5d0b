"""Refuse requests from other web pages in the same browser, which could reach this machine, even by DNS rebinding.

Browsers report the requested name as `Host`, and the requesting page as `Origin`.
"""

from __future__ import annotations

import contextlib
import importlib
import ipaddress
import socket
from collections.abc import Iterator, Sequence
from typing import Any
from urllib.parse import urlsplit


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
    if not started:
        msg = "this version of viser cannot be guarded against other web pages: install another"
        raise RuntimeError(msg)
