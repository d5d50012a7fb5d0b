# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Whom the page's server answers, and what it takes of a message. viser is not needed."""

from __future__ import annotations

import socket
from types import SimpleNamespace

import pytest
from radarsdf.view.guarding import bounded, others_reach, why_refused

NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize(
    ("listening", "host"),
    [
        ("127.0.0.1", "localhost:8080"),
        ("127.0.0.1", "LOCALHOST:8080"),
        ("127.0.0.1", "127.0.0.1:8080"),
        ("127.0.0.1", "[::1]:8080"),
        ("127.0.0.1", "localhost:9000"),  # a tunnel with another port at its other end
        ("10.1.2.3", "10.1.2.3:8080"),
        ("fe80:0::1", "[fe80::1]:8080"),
        ("Radar.example", "radar.example:8080"),
        ("0.0.0.0", "10.1.2.3:8080"),
        ("::", "[fe80::1]:8080"),
        ("0.0.0.0", f"{socket.gethostname()}:8080"),
    ],
)
def test_a_page_of_its_own_is_answered(listening, host):
    assert why_refused([host], [], listening) is None
    assert why_refused([host], [f"http://{host}"], listening) is None
    assert why_refused([host], [f"http://{host}", f"http://{host}"], listening) is not None
    assert why_refused([host, host], [], listening) is not None


@pytest.mark.parametrize("listening", ["127.0.0.1", "10.1.2.3", "0.0.0.0", "::"])
@pytest.mark.parametrize(
    "host",
    ["evil.example:8080", "localhost.evil.example", "evil.example#localhost", "localhost@evil.example", "", "[", ":80",
     "127.0.0.1.evil.example:8080", "localhost:8080/..", "localhost:x", "evil.example\tlocalhost"],
)  # fmt: skip
def test_a_foreign_host_is_refused(listening, host):
    assert "Host" in str(why_refused([host], [], listening))
    assert "Host" in str(why_refused([], [], listening))


@pytest.mark.parametrize(
    "origin",
    ["http://evil.example", "null", "", "file://", "http://localhost:3000", "http://localhost:8080.evil.example",
     "http://127.0.0.1:8080"],
)  # fmt: skip
def test_a_foreign_origin_is_refused(origin):
    assert "Origin" in str(why_refused(["localhost:8080"], [origin], "127.0.0.1"))


CONTROLS = {
    "slider": SimpleNamespace(value=0.5, min=0.0, max=1.0),
    "scan": SimpleNamespace(value=0, min=0, max=4),
    "off": SimpleNamespace(value=0, min=0, max=1, disabled=True),
    "box": SimpleNamespace(value=True),
    "text": SimpleNamespace(value="a"),
    "list": SimpleNamespace(value="a", options=("a", "b")),
    "vector": SimpleNamespace(value=(0.0, 1.0), min=None, max=None),
}


def updated(control, value, **more):
    message = {"type": "GuiUpdateMessage", "uuid": control, "updates": {"value": value, **more}}
    found = bounded(message, CONTROLS)
    return None if found is None else found["updates"]["value"]


@pytest.mark.parametrize(
    ("control", "value", "taken"),
    [
        ("slider", 0.25, 0.25),
        ("slider", 1, 1.0),
        ("slider", 1e30, 1.0),
        ("slider", -(10**300), 0.0),
        ("scan", 1e30, 4),
        ("scan", 2.0, 2),
        ("box", False, False),
        ("text", "other", "other"),
        ("list", "b", "b"),
        ("vector", [3, 4], (3.0, 4.0)),
        ("vector", [1e300, 4], (1e9, 4.0)),
    ],
)
def test_a_value_of_a_control_is_moved_into_its_range(control, value, taken):
    found = updated(control, value)
    assert found == taken
    assert type(found) is type(CONTROLS[control].value)


@pytest.mark.parametrize("control", [*CONTROLS, "none", "x" * 5000])
@pytest.mark.parametrize("value", [NAN, INF, -INF, None, [], {}, b"1", [1.0, NAN], [[1.0], 2.0], "x" * 5000])
def test_a_value_of_another_type_is_left_out(control, value):
    assert updated(control, value) is None


@pytest.mark.parametrize(
    ("control", "value"),
    [
        ("slider", "1"),
        ("slider", True),
        ("box", 1),
        ("text", 1),
        ("list", "c"),
        ("vector", [1.0]),
        ("off", 1),
    ],
)
def test_a_value_that_nearly_fits_is_left_out(control, value):
    assert updated(control, value) is None


def test_only_the_value_of_a_control_can_be_set():
    for more in ({"update_cb": 3}, {"removed": True}, {"__class__": 1}):
        assert updated("slider", 0.25, **more) is None
    message = {"type": "GuiUpdateMessage", "uuid": "slider", "updates": {"removed": True}}
    assert bounded(message, CONTROLS) is None


MOVED = {
    "type": "TransformControlsUpdateMessage",
    "name": "/sensor",
    "wxyz": [1, 0, 0, 0],
    "position": [1, 2.5, 3],
    "owner": "",
}
CLICKED = {
    "type": "ScenePointerMessage",
    "event_type": "click",
    "ray_origin": [0, 0, 1],
    "ray_direction": [0, 0, -1.0],
    "screen_pos": [[0.5, 0.5]],
    "modifier": None,
}
CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": [1, 0, 0, 0],
    "position": [0, 0, 0],
    "fov": 1,
    "near": 0.1,
    "far": 1000,
    "image_height": 700,
    "image_width": 1000,
    "look_at": [0, 0, 1],
    "up_direction": [0, 0, 1],
}


@pytest.mark.parametrize("message", [MOVED, CLICKED, CAMERA])
def test_what_the_page_sends_is_taken_as_it_is(message):
    taken = bounded(message, {})
    as_tuples = {name: tuple(v) if isinstance(v, list) else v for name, v in message.items()}
    as_tuples |= {"screen_pos": ((0.5, 0.5),)} if "screen_pos" in message else {}
    assert taken == as_tuples


@pytest.mark.parametrize("message", [MOVED, CLICKED, CAMERA])
def test_wild_values_are_left_out(message):
    for name in message:
        for wild in (NAN, INF, 1e30, 10**300, {}, [], "x" * 5000, [NAN] * 3, [1e30] * 4, b"", [[[[0]]]]):
            assert bounded(message | {name: wild}, {}) is None
        if name not in ("owner", "modifier"):  # which viser has a default for, or checks itself
            assert bounded({n: v for n, v in message.items() if n != name}, {}) is None
    for name in ("wxyz", "ray_direction", "up_direction"):
        if name in message:
            assert bounded(message | {name: [0] * len(message[name])}, {}) is None


@pytest.mark.parametrize(
    "message",
    [
        None, [], 1, "x", {}, {"type": None}, {"type": []}, {"type": {}}, {"type": "Message"},
        {"type": "ShareUrlRequest"}, {"type": "FileTransferStartUpload", "size_bytes": 1 << 40},
    ],
)  # fmt: skip
def test_messages_that_the_page_does_not_send_are_left_out(message):
    assert bounded(message, CONTROLS) is None


@pytest.mark.parametrize("host", ["0.0.0.0", "0", "::", "10.1.2.3"])
def test_others_reach_what_is_no_loopback(host):
    assert others_reach(host)
    assert not any(map(others_reach, ("127.0.0.1", "127.0.0.2", "localhost", "::1")))
