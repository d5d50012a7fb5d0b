"""Address of the page, and when it has been drawn. viser is not needed."""

import socket
import sys

import pytest
from radarsdf.view import serving
from radarsdf.view.serving import refusal


def test_a_port_in_use_is_rejected(monkeypatch):
    with socket.create_server(("127.0.0.1", 0)) as listening:
        taken = listening.getsockname()[1]
        monkeypatch.setattr(serving, "_FIRST_PORT", taken)
        assert serving.free_port("127.0.0.1", None) > taken
        with pytest.raises(OSError, match=f"127.0.0.1, port {taken}: .*--port"):
            serving.free_port("127.0.0.1", taken)


@pytest.mark.parametrize("host", ["192.0.2.1", "no.such.host.invalid"])
def test_an_address_of_another_machine(host):
    with pytest.raises(OSError, match=f"cannot listen on {host}.*--host"):
        serving.free_port(host, None)


@pytest.mark.parametrize(
    ("host", "name"),
    [
        ("127.0.0.1", "localhost"),
        ("0.0.0.0", "localhost"),
        ("10.1.2.3", "10.1.2.3"),
        ("fe80::1", "[fe80::1]"),
    ],
)
def test_the_address_of_the_page(host, name):
    assert serving.url_of(host, 81) == f"http://{name}:81"


@pytest.mark.skipif(sys.platform != "linux", reason="others always have a screen")
def test_a_browser_opens_only_with_a_display(monkeypatch):
    for name in ("SSH_CONNECTION", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    assert not serving.has_display()
    monkeypatch.setenv("DISPLAY", ":0")
    assert serving.has_display()
    monkeypatch.setenv("SSH_CONNECTION", "10.0.0.1 22 10.0.0.2 22")
    assert not serving.has_display()


@pytest.mark.parametrize(
    ("listening", "host"),
    [
        ("127.0.0.1", "LOCALHOST:8080"),
        ("127.0.0.1", "127.0.0.1:8080"),
        ("127.0.0.1", "[::1]:8080"),
        ("127.0.0.1", "localhost:9000"),  # a tunnel with another port at its other end
        ("10.1.2.3", "10.1.2.3:8080"),
        ("Radar.example", "radar.example:8080"),
        ("0.0.0.0", "10.1.2.3:8080"),
        ("::", "[fe80::1]:8080"),
        ("0.0.0.0", f"{socket.gethostname()}:8080"),
    ],
)
def test_requests_of_the_own_page_are_accepted(listening, host):
    assert refusal([host], [], listening) is None
    assert refusal([host], [f"http://{host}"], listening) is None
    assert refusal([host], [f"http://{host}", f"http://{host}"], listening) is not None
    assert refusal([host, host], [], listening) is not None


@pytest.mark.parametrize("listening", ["127.0.0.1", "10.1.2.3", "0.0.0.0"])
@pytest.mark.parametrize(
    "host",
    ["evil.example:8080", "localhost.evil.example", "evil.example#localhost", "localhost@evil.example", "", "[", ":80",
     "127.0.0.1.evil.example:8080", "evil.example\tlocalhost"],
)  # fmt: skip
def test_another_host_is_rejected(listening, host):
    assert "Host" in str(refusal([host], [], listening))
    assert "Host" in str(refusal([], [], listening))


@pytest.mark.parametrize(
    "origin",
    ["http://evil.example", "null", "", "file://", "http://localhost:3000", "http://localhost:8080.evil.example",
     "http://127.0.0.1:8080"],
)  # fmt: skip
def test_another_origin_is_rejected(origin):
    assert "Origin" in str(refusal(["localhost:8080"], [origin], "127.0.0.1"))
