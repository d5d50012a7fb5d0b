# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Which requests the server of a page answers. viser is not needed."""

import socket

import pytest
from radarsdf.view.guarding import refusal


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
def test_its_own_page_is_answered(listening, host):
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
def test_another_host_is_refused(listening, host):
    assert "Host" in str(refusal([host], [], listening))
    assert "Host" in str(refusal([], [], listening))


@pytest.mark.parametrize(
    "origin",
    ["http://evil.example", "null", "", "file://", "http://localhost:3000", "http://localhost:8080.evil.example",
     "http://127.0.0.1:8080"],
)  # fmt: skip
def test_another_origin_is_refused(origin):
    assert "Origin" in str(refusal(["localhost:8080"], [origin], "127.0.0.1"))
