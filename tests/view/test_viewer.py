# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The viewer, as a client sees it that counts what it receives, and its handlers."""

from __future__ import annotations

import gc
import re
import socket
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
import radarsdf
from radarsdf.io import Scans
from radarsdf.map.colors import intensity_colors
from radarsdf.view.framing import look_at_all
from radarsdf.view.light import shaded
from radarsdf.view.serving import start_server
from radarsdf.view.viewer import Viewer
from scipy.spatial import cKDTree

from ..conftest import ground_and_wall

pytest.importorskip("viser", reason="the extra view is not installed")

from viser import ClientHandle

from .client import Glb, PlainClient, is_mesh

CLOUD = "/surface/cloud"


@pytest.fixture(scope="module")
def scans(scene):
    return Scans(scene.points, scene.poses, scene.intensities)


@pytest.fixture(scope="module")
def viewer(sharp_map, scans):
    with Viewer(sharp_map, scans, voxel_size=0.2, port=0, progress=False) as viewer:
        yield viewer


@pytest.fixture
def client(viewer):
    with PlainClient(viewer.host, viewer.port) as client:
        client.wait_for(lambda message: message.kind == "ReplayDoneMessage")
        client.wait_for(lambda message: message.kind == "GlbMessage")
        client.wait_for(lambda m: m.kind == "SetCameraLookAtMessage" and not m.message["initial"])
        yield client


def test_connections_that_ended_leave_nothing(viewer):
    def held():
        return sum(type(thing) is ClientHandle for thing in gc.get_objects())

    gc.disable()  # which would free some by chance
    try:
        for _ in range(6):
            with PlainClient(viewer.host, viewer.port) as client:
                client.wait_for(lambda message: message.kind == "GlbMessage")
        until_s = time.monotonic() + 20
        while held() > 2 and time.monotonic() < until_s:
            time.sleep(0.1)
        assert held() <= 2, held()  # the last ones may still be in use while others are freed
    finally:
        gc.enable()


def test_a_host_that_others_reach_is_said(sharp_map):
    with (
        pytest.warns(RuntimeWarning, match=r"0\.0\.0\.0"),
        Viewer(sharp_map, None, voxel_size=0.4, host="0.0.0.0", port=0, progress=False),
    ):
        pass


def mesh_of(message):
    return Glb.of(message.message["props"]["glb_data"])


def slide(client, label, value):
    """Move a slider, or set a check box, as the page does."""
    found = client.wait_for(
        lambda m: m.kind.startswith("Gui") and m.message.get("props", {}).get("label") == label
    )
    client.send("GuiUpdateMessage", uuid=found.message["uuid"], updates={"value": value})


def test_a_new_client_gets_the_scene(client, viewer):
    nodes = {message.name for message in client.received()}
    assert {CLOUD, "/sensor", "/scans/path", "/scans/measured", "/scans/predicted"} <= nodes
    mesh = mesh_of(client.wait_for(is_mesh))
    assert len(mesh.faces) == len(viewer.surface.faces)
    themes = [m.message for m in client.received() if m.kind == "ThemeConfigurationMessage"]
    assert themes
    assert not themes[-1]["show_share_button"]  # it would make the page public


def test_a_drag_recolours_few_points_and_then_the_mesh(client, viewer, sharp_map):
    before = len(client.received())
    _, ended_s = client.drag(1.0)
    new_mesh = client.wait_for(is_mesh, before)
    assert new_mesh.at_s > ended_s
    updates = [m for m in client.received(before) if m.changes(CLOUD, "colors") and m.at_s < ended_s]
    assert len(updates) >= 5  # of at most 20; twice as many on an idle machine
    moving = [m for m in client.received(before) if m.at_s < ended_s]
    assert {m.kind for m in moving} <= {
        "SceneNodeUpdateMessage", "SetSceneNodeVisibilityMessage", "LocalStorageGetItemRequestMessage",
    }  # fmt: skip
    assert not any(m.changes(CLOUD, "points") for m in moving)  # only what changed is sent
    points = len(viewer.surface.vertices)
    assert min(m.frame_bytes for m in updates) < 3 * points + 1000

    # The mesh is coloured for the last position of the drag, in the frame of the page.
    def difference(position):
        sensor = sharp_map.origin + position
        colors = viewer.quantities["intensity"].colors(np.arange(len(viewer.surface.vertices)), sensor)
        return np.abs(shaded(colors, viewer.surface.lightness) - mesh_of(new_mesh).colors).mean()

    assert difference([2.0, 0.0, 1.0]) < 2
    assert difference([1.0, 0.0, 1.0]) > 4


def test_limits_hide_triangles(client, viewer):
    surface = viewer.surface
    limit = float(np.median(surface.uncertainty_m))
    before = len(client.received())
    slide(client, "uncertainty ≤ m", limit)
    mesh = mesh_of(client.wait_for(is_mesh, before))
    assert 0 < len(mesh.faces) < len(surface.faces)
    assert len(mesh.faces) == len(surface.part(surface.kept(limit, 0.0))[1])
    before = len(client.received())
    slide(client, "uncertainty ≤ m", 0.0)
    client.wait_for(lambda m: m.kind == "RemoveSceneNodeMessage", before)  # nothing is left
    slide(client, "uncertainty ≤ m", 9.0)
    mesh = mesh_of(client.wait_for(is_mesh, before))
    assert len(mesh.faces) == len(surface.faces)


def test_the_walk_shows_a_scan_and_moves_the_sensor(client, viewer, scans, sharp_map):
    before = len(client.received())
    slide(client, "scan", 4)
    client.wait_for(lambda m: m.changes("/scans/measured", "colors"), before)
    client.wait_for(lambda m: m.changes("/scans/predicted", "points"), before)
    moved = client.wait_for(lambda m: m.kind == "SetPositionMessage" and m.name == "/sensor", before)
    np.testing.assert_allclose(moved.message["position"], scans.poses[4, :3, 3] - sharp_map.origin, atol=1e-6)
    client.wait_for(is_mesh, before)  # coloured for that position
    said = client.wait_for(lambda m: "scan 4: " in str(m.message.get("updates", {}).get("_markdown")), before)
    view = sharp_map.render(scans.poses[4])
    assert len(view) > 20
    assert f"{len(scans.points[4])} returns measured, {len(view)} predicted; median error" in str(
        said.message
    )
    shown = viewer._walk._clouds["predicted"].points
    np.testing.assert_allclose(shown, view.world_points - sharp_map.origin, atol=1e-4)
    assert not any(m.name == "/scans/all" for m in client.received())
    slide(client, "all scans", value=True)
    client.wait_for(lambda m: m.name == "/scans/all" and m.kind == "PointCloudMessage", before)


def test_a_click_tells_what_the_map_knows(client, viewer, sharp_map):
    before = len(client.received())
    eye = np.array([3.0, 0.5, 2.0])
    target = np.array([12.0, 1.0, 0.0]) - sharp_map.origin  # on the plane
    viewer._on_click(SimpleNamespace(ray_origin=eye, ray_direction=target - eye))
    said = client.wait_for(lambda m: "signed distance" in _content(m), before)
    rows = dict(re.findall("<tr><td>(.*?)</td><td>(.*?)</td></tr>", _content(said)))
    position = np.array([float(number) for number in rows["position"].removesuffix(" m").split(",")])
    assert position == pytest.approx([12, 1, 0], abs=0.3)
    assert float(rows["signed distance"].removesuffix(" m")) == pytest.approx(
        sharp_map.sdf(position[None])[0], abs=0.02
    )
    assert float(rows["uncertainty"].removesuffix(" m")) == pytest.approx(
        sharp_map.uncertainty(position[None])[0], abs=0.01
    )
    sensor = np.array(viewer._painter.newest.sensor)
    assert float(rows["intensity"].split()[0]) == pytest.approx(
        sharp_map.intensity(position[None], sensor)[0], abs=0.5
    )
    # A click into the sky says nothing, and leaves what was said.
    before = len(client.received())
    viewer._on_click(SimpleNamespace(ray_origin=eye, ray_direction=[0.0, 0.0, 1.0]))
    assert not any(map(_content, client.received(before)))


def _content(message):
    """The HTML that a message gives to a text of the panel."""
    return str(message.message.get("updates", {}).get("content", ""))


def test_the_mark_of_a_click_is_as_large_on_the_screen_from_near_and_far(client, viewer, sharp_map):
    target = np.array([12.0, 1.0, 0.0]) - sharp_map.origin
    for away_m in (10.0, 100.0):
        before = len(client.received())
        eye = target + away_m * np.array([-0.6, 0.0, 0.8])
        viewer._on_click(SimpleNamespace(ray_origin=eye, ray_direction=target - eye))
        mark = client.wait_for(lambda m: m.name == "/clicked" and m.kind == "IcosphereMessage", before)
        assert mark.message["props"]["radius"] == pytest.approx(0.012 * away_m, rel=0.05)


def test_the_surface_is_coloured_by_what_is_chosen(client, viewer, scans, sharp_map):
    surface = viewer.surface
    for name, values, words in (
        ("uncertainty", surface.uncertainty_m, "uncertainty (standard error), m"),
        ("confidence", surface.confidence, "confidence (probability)"),
        ("height", surface.vertices[:, 2], "height, m"),
    ):
        before = len(client.received())
        slide(client, "colour by", name)
        low, high = (0, 1) if name == "confidence" else np.percentile(values, [2, 98])
        said = client.wait_for(lambda m, words=words: words in _content(m), before)
        assert f">{low:.3g}<" in _content(said)
        assert f">{high:.3g}<" in _content(said)
        shown = mesh_of(client.wait_for(is_mesh, before)).colors
        expected = shaded(intensity_colors(values, low, high)[:, :3], surface.lightness)
        np.testing.assert_allclose(shown, expected, atol=1)
    before = len(client.received())
    slide(client, "colour by", "observed")
    shown = mesh_of(client.wait_for(is_mesh, before)).colors
    returns = np.concatenate([scan.world_points for scan in scans])
    edge_m = sharp_map.config.leaf_size_m
    seen = cKDTree(returns).query(surface.vertices)[0] <= edge_m
    assert 0.5 < seen.mean() < 1
    np.testing.assert_array_equal(shown[:, 0] > 1.05 * shown[:, 2], ~seen)  # orange, not grey
    assert f"bridged: no return within {edge_m:g} m" in _content(
        client.wait_for(lambda m: "bridged" in _content(m), before)
    )
    slide(client, "colour by", "intensity")
    client.wait_for(lambda m: "intensity" in _content(m), before)


def test_predicted_returns_do_not_look_like_measured_ones(client):
    clouds = {m.name: m.message["props"] for m in client.received() if m.kind == "PointCloudMessage"}
    measured, predicted = clouds["/scans/measured"], clouds["/scans/predicted"]
    assert measured["point_shape"] != predicted["point_shape"]
    assert measured["point_size"] > 1.2 * predicted["point_size"]
    legend = [m.message["props"]["content"] for m in client.received() if m.kind == "GuiHtmlMessage"]
    assert any("measured" in text and "predicted" in text and "path of the sensor" in text for text in legend)


def test_the_view_is_reset_for_who_asks(client, viewer):
    before = len(client.received())
    client.send(
        "ViewerCameraMessage", wxyz=(1.0, 0.0, 0.0, 0.0), position=(5.0, 6.0, 7.0), fov=1.0, near=0.1, far=1e3,
        image_height=800, image_width=400, look_at=(0.0, 0.0, 1.0), up_direction=(0.0, 0.0, 1.0),
    )  # fmt: skip
    slide(client, "Reset view", value=True)
    look = look_at_all(viewer._extent, aspect=0.5)
    moved = client.wait_for(lambda m: m.kind == "SetCameraPositionMessage", before)
    np.testing.assert_allclose(moved.message["position"], look.position)
    turned = client.wait_for(
        lambda m: m.kind == "SetCameraLookAtMessage" and np.allclose(m.message["look_at"], look.look_at),
        before,
    )
    assert turned


def test_the_page_cannot_be_made_public(viewer):
    assert viewer._server.request_share_url() is None


def answer_to(viewer, *headers):
    """The status that a request of the page gets."""
    with socket.create_connection((viewer.host, viewer.port), timeout=10) as connection:
        lines = "\r\n".join(["GET / HTTP/1.1", *headers, "Connection: close", "", ""])
        connection.sendall(lines.encode())
        return int(connection.makefile("rb").readline().split()[1])


def test_other_pages_are_refused(viewer):
    port = viewer.port
    assert answer_to(viewer, f"Host: localhost:{port}") == 200
    assert answer_to(viewer, f"Host: 127.0.0.1:{port}", f"Origin: http://127.0.0.1:{port}") == 200
    assert answer_to(viewer, f"Host: evil.example:{port}") == 403  # whose name suddenly means this machine
    assert answer_to(viewer, f"Host: localhost:{port}", "Origin: http://evil.example") == 403
    assert answer_to(viewer, f"Host: localhost:{port}", f"Host: evil.example:{port}") != 200
    upgrade = ("Upgrade: websocket", "Connection: Upgrade", "Sec-WebSocket-Version: 13",
               "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==")  # fmt: skip
    host = f"Host: localhost:{port}"
    assert answer_to(viewer, host, *upgrade, f"Origin: http://localhost:{port}") == 101
    assert answer_to(viewer, host, *upgrade, "Origin: http://evil.example") == 403
    assert answer_to(viewer, host, *upgrade, "Origin: null") == 403
    assert answer_to(viewer, f"Host: evil.example:{port}", *upgrade) == 403


def test_wild_messages_leave_the_viewer_to_others(viewer, client, caplog):
    controls = {m.message["props"]["label"]: m.message["uuid"] for m in client.received()
                if "label" in m.message.get("props", {})}  # fmt: skip
    handle = viewer._controls._scan
    before = len(client.received())
    with PlainClient(viewer.host, viewer.port) as wild:
        for uuid in controls.values():
            for value in (
                1e30,
                -1e300,
                float("nan"),
                float("inf"),
                "x",
                None,
                [],
                {},
                True,
                10**18,
                "x" * 50_000,
            ):
                wild.send("GuiUpdateMessage", uuid=uuid, updates={"value": value})
            wild.send("GuiUpdateMessage", uuid=uuid, updates={"update_cb": 1, "removed": True})
        for place in ([1e30] * 3, [float("nan")] * 3, "abc", [1.0], None, [[1.0]]):
            wild.send("TransformControlsUpdateMessage", name="/sensor", wxyz=[1, 0, 0, 0], position=place)
            wild.send("TransformControlsUpdateMessage", name="/sensor", wxyz=place, position=[0, 0, 0])
            wild.send("ScenePointerMessage", event_type="click", ray_origin=place, ray_direction=place,
                      screen_pos=[[0.5, 0.5]], modifier=None)  # fmt: skip
        wild.send("NoMessage")
        for data in (b"", b"\xc1", b"\x91" * 60_000, "text"):
            wild._socket.send(data)
        slide(wild, "scan", 2)  # which is taken after them
        client.wait_for(lambda m: "scan 2: " in str(m.message.get("updates", {}).get("_markdown")), before)
        slide(client, "scan", 3)
        client.wait_for(lambda m: "scan 3: " in str(m.message.get("updates", {}).get("_markdown")), before)
    assert viewer._painter._thread.is_alive()
    assert handle.value == 3
    assert not handle._impl.removed
    assert np.abs(viewer._painter.newest.sensor).max() < 1e3
    assert not caplog.records  # viser would log what its handlers cannot do with a message
    # One that is too long ends the connection of who sent it, and no other.
    with PlainClient(viewer.host, viewer.port) as wild:
        wild._socket.send(bytes(100_000))
        wild._thread.join(10)
        assert not wild._thread.is_alive()
    before = len(client.received())
    slide(client, "scan", 4)
    client.wait_for(lambda m: "scan 4: " in str(m.message.get("updates", {}).get("_markdown")), before)


def test_a_server_that_cannot_be_guarded_is_not_started(monkeypatch):
    monkeypatch.setattr("viser.ViserServer", lambda *_, **__: None)  # as if it listened in another way
    with pytest.raises(RuntimeError, match="cannot be guarded"):
        start_server("127.0.0.1", 0)


def test_a_map_far_away_without_intensities():
    scene = ground_and_wall(offset=(500_000.0, 5_400_000.0, 300.0))
    radar_map = radarsdf.fit(scene.points, scene.poses, config=radarsdf.FitConfig.quick(), progress=False)
    scans = Scans(scene.points, scene.poses, scene.intensities)
    threads = set(threading.enumerate())
    with (
        Viewer(radar_map, scans, voxel_size=0.2, port=0, progress=False) as viewer,
        PlainClient(viewer.host, viewer.port) as client,
    ):
        mesh = mesh_of(client.wait_for(is_mesh))
        assert np.abs(mesh.vertices).max() < 50  # of the local frame, which float32 can hold
        assert not any(message.name in (CLOUD, "/sensor") for message in client.received())
        sensor = scene.poses[:, :3, 3].mean(axis=0) - radar_map.origin + [0, 0, 2]
        viewer._on_click(SimpleNamespace(ray_origin=sensor.tolist(), ray_direction=[8.0, 0.0, -3.0]))
        said = client.wait_for(lambda m: "signed distance" in str(m.message))
        assert "<td>position</td><td>5000" in str(said.message)
        assert "intensity" not in str(said.message)
        nodes = {message.name for message in client.received()}
        assert {"/scans/measured", "/scans/predicted"} <= nodes
    left = [thread for thread in set(threading.enumerate()) - threads if thread.name == "radarsdf view"]
    assert left == []
    with Viewer(radar_map, voxel_size=0.3, port=viewer.port, progress=False):  # the port is free again
        pass


def test_a_port_that_is_taken_is_said_before_the_work(viewer, sharp_map, monkeypatch):
    monkeypatch.setattr(
        "radarsdf.view.surface.ShownSurface.of", lambda *_, **__: pytest.fail("work was done")
    )
    with pytest.raises(OSError, match="in use"):
        Viewer(sharp_map, port=viewer.port)
