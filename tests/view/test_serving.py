# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Where the page is served, and when it has been drawn. viser is not needed."""

from __future__ import annotations

import socket
import sys
from types import SimpleNamespace

import pytest
from radarsdf.view import serving


@pytest.fixture
def taken():
    """A port that something listens on."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        yield listening.getsockname()[1]


def test_the_next_port_that_is_free(taken):
    assert serving.free_port("127.0.0.1", taken, exactly=False) > taken
    assert serving.free_port("127.0.0.1", 0, exactly=True) > 0


def test_a_port_that_must_be_free(taken):
    with pytest.raises(
        OSError, match=f"cannot listen on 127.0.0.1, port {taken}: .*in use; --port takes another"
    ):
        serving.free_port("127.0.0.1", taken, exactly=True)


@pytest.mark.parametrize("host", ["192.0.2.1", "no.such.host.invalid"])
def test_an_address_of_another_machine(host):
    with pytest.raises(OSError, match=f"cannot listen on {host}.*--host takes an address of this machine"):
        serving.free_port(host, 8080, exactly=False)


@pytest.mark.parametrize("port", [-1, 65536])
def test_no_port_at_all(port):
    with pytest.raises(ValueError, match="--port must be at least 0 and at most 65535"):
        serving.free_port("127.0.0.1", port, exactly=True)


@pytest.mark.parametrize(
    ("host", "url", "tunnel"),
    [
        ("127.0.0.1", "http://localhost:81", "ssh -L 81:localhost:81 "),
        ("0.0.0.0", "http://localhost:81", "ssh -L 81:localhost:81 "),
        ("10.1.2.3", "http://10.1.2.3:81", "ssh -L 81:10.1.2.3:81 "),
        ("fe80::1", "http://[fe80::1]:81", "ssh -L 81:[fe80::1]:81 "),
    ],
)
def test_where_it_is_found(host, url, tunnel):
    assert serving.url_of(host, 81) == url
    assert serving.ssh_line(host, 81) == tunnel + socket.gethostname()


@pytest.mark.skipif(sys.platform != "linux", reason="others always have a screen")
def test_a_browser_is_for_a_screen(monkeypatch):
    for name in ("SSH_CONNECTION", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    assert not serving.has_display()
    monkeypatch.setenv("DISPLAY", ":0")
    assert serving.has_display()
    monkeypatch.setenv("SSH_CONNECTION", "10.0.0.1 22 10.0.0.2 22")
    assert not serving.has_display()


class Storage:
    """Answers, or fails, as each entry says."""

    def __init__(self, *answers):
        self.answers, self.asked = list(answers), 0

    def get_item(self, _, timeout):
        assert timeout < 2  # so that it is noticed soon if something newer is to be drawn
        self.asked += 1
        answer = self.answers.pop(0) if self.answers else None
        if answer is not None:
            raise answer


def asked(*storages, superseded=lambda: False):
    clients = {i: SimpleNamespace(local_storage=storage) for i, storage in enumerate(storages)}
    serving.wait_until_drawn(SimpleNamespace(get_clients=lambda: clients), superseded)
    return [storage.asked for storage in storages]


def test_every_page_is_asked_until_it_has_drawn():
    assert asked() == []
    assert asked(Storage(), Storage(TimeoutError())) == [3, 4]


def test_a_page_that_is_gone_is_not_waited_for():
    assert asked(Storage(RuntimeError("the client disconnected before")), Storage()) == [1, 3]
    assert asked(Storage(RuntimeError("Failed to read localStorage"))) == [3]  # an answer all the same


def test_nothing_is_waited_for_that_is_superseded():
    assert asked(Storage(), superseded=lambda: True) == [0]
