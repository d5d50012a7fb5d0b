"""The viewer from its clients' side: messages that they receive, and rejected requests."""

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
from radarsdf.map.colors import Scale
from radarsdf.view.pages import Viewer
from radarsdf.view.serving import start_server
from radarsdf.view.surface import shaded

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


def test_shares_of_explained_returns_color_the_path(sharp_map, scans):
    explained = np.linspace(0, 1, len(scans))
    with Viewer(sharp_map, scans, voxel_size=0.4, port=0, progress=False, explained=explained) as viewer:
        colors = np.asarray(viewer._clouds.nodes["trajectory"].colors)
    assert colors.shape == (len(scans) - 1, 2, 3)
    assert len(np.unique(colors, axis=0)) == len(scans) - 1


def mesh_of(message):
    return Glb.of(message.message["props"]["glb_data"])


def content(message):
    """HTML that a message assigns to a text of the panel."""
    return str(message.message.get("updates", {}).get("content", ""))


def slide(client, label, value):
    """Move a slider, or set a check box, as the page does."""
    found = client.wait_for(
        lambda m: m.kind.startswith("Gui") and m.message.get("props", {}).get("label") == label
    )
    props = found.message["props"]
    assert props["visible"]
    assert not props["disabled"]
    client.send("GuiUpdateMessage", uuid=found.message["uuid"], updates={"value": value})
    return props


def test_a_new_client_gets_the_scene(client, viewer):
    clouds = {m.name: m.message["props"] for m in client.received() if m.kind == "PointCloudMessage"}
    assert {CLOUD, "/scans/measured", "/scans/predicted"} == set(clouds)
    assert clouds["/scans/measured"]["point_shape"] != clouds["/scans/predicted"]["point_shape"]
    assert {"/sensor", "/scans/path"} <= {message.name for message in client.received()}
    assert len(mesh_of(client.wait_for(is_mesh)).faces) == len(viewer.surface.faces)
    themes = [m.message for m in client.received() if m.kind == "ThemeConfigurationMessage"]
    assert not themes[-1]["show_share_button"]  # it would make the page public
    assert viewer._server.request_share_url() is None


def test_a_drag_recolours_few_points_and_then_the_mesh(client, viewer, sharp_map):
    before = len(client.received())
    _, ended_s = client.drag(0.5)
    new_mesh = client.wait_for(is_mesh, before)
    assert new_mesh.at_s > ended_s
    moving = [m for m in client.received(before) if m.at_s < ended_s]
    updates = [m for m in moving if m.changes(CLOUD, "colors")]
    assert len(updates) >= 3  # of at most 10
    assert not any(m.changes(CLOUD, "points") for m in moving)  # only what changed is sent
    assert min(m.frame_bytes for m in updates) < 3 * len(viewer.surface.vertices) + 1000

    # The mesh has the colours for the last position of the drag, in the frame of the page.
    def difference(position):
        sensor = sharp_map.origin + position
        quantity, rows = viewer.quantities["intensity"], np.arange(len(viewer.surface.vertices))
        colors = quantity.scale(quantity.values(rows, sensor))
        return np.abs(shaded(colors, viewer.surface.lightness) - mesh_of(new_mesh).colors).mean()

    assert difference([1.0, 0.0, 1.0]) < 2
    assert difference([0.0, 0.0, 1.0]) > 4


def test_limits_hide_triangles(client, viewer):
    surface = viewer.surface
    limit = float(np.median(surface.uncertainty_m))
    before = len(client.received())
    slide(client, "uncertainty ≤ m", limit)
    mesh = mesh_of(client.wait_for(is_mesh, before))
    assert 0 < len(mesh.faces) < len(surface.faces)
    assert len(mesh.faces) == len(surface.part(surface.kept(limit, 0.0))[1])
    before = len(client.received())
    slide(client, "uncertainty ≤ m", 9.0)
    assert len(mesh_of(client.wait_for(is_mesh, before)).faces) == len(surface.faces)


def test_a_scan_is_shown_and_the_sensor_moves_there(client, viewer, scans, sharp_map):
    before = len(client.received())
    props = slide(client, "scan", 4)
    assert (props["min"], props["max"]) == (0, len(scans) - 1)
    moved = client.wait_for(lambda m: m.kind == "SetPositionMessage" and m.name == "/sensor", before)
    np.testing.assert_allclose(moved.message["position"], scans.poses[4, :3, 3] - sharp_map.origin, atol=1e-6)
    client.wait_for(is_mesh, before)  # coloured for that position
    text = client.wait_for(lambda m: "scan 4: " in str(m.message.get("updates", {}).get("_markdown")), before)
    view = sharp_map.render(scans.poses[4])
    described = f"{len(scans.points[4])} returns measured, {len(view)} predicted; median error"
    assert described in str(text.message)
    shown = viewer._clouds.nodes["predicted"].points
    np.testing.assert_allclose(shown, view.world_points - sharp_map.origin, atol=1e-4)
    before = len(client.received())
    slide(client, "predicted", value=False)
    client.wait_for(
        lambda m: m.changes("/scans/predicted", "visible") or m.name == "/scans/predicted", before
    )
    slide(client, "predicted", value=True)


def test_a_click_shows_the_values_of_the_map(client, viewer, sharp_map):
    eye = np.array([3.0, 0.5, 2.0])
    target = np.array([12.0, 1.0, 0.0]) - sharp_map.origin  # on the plane
    before = len(client.received())
    viewer._on_click(SimpleNamespace(ray_origin=eye, ray_direction=target - eye))
    answer = client.wait_for(lambda m: "signed distance" in content(m), before)
    rows = dict(re.findall("<tr><td>(.*?)</td><td>(.*?)</td></tr>", content(answer)))
    position = np.array([float(number) for number in rows["position"].removesuffix(" m").split(",")])
    assert position == pytest.approx([12, 1, 0], abs=0.3)
    sensor = np.array(viewer._painter.newest.sensor)
    for name, expected, tolerance in (
        ("signed distance", sharp_map.sdf(position[None]), 0.02),
        ("uncertainty", sharp_map.uncertainty(position[None]), 0.01),
        ("intensity", sharp_map.intensity(position[None], sensor), 0.5),
    ):
        assert float(rows[name].split()[0]) == pytest.approx(expected[0], abs=tolerance)
    mark = client.wait_for(lambda m: m.name == "/clicked" and m.kind == "IcosphereMessage", before)
    away_m = np.linalg.norm(position - sharp_map.origin - eye)
    assert mark.message["props"]["radius"] == pytest.approx(max(0.012 * away_m, 0.1), rel=0.05)
    before = len(client.received())
    viewer._on_click(SimpleNamespace(ray_origin=eye, ray_direction=[0.0, 0.0, 1.0]))  # into the sky
    assert not any(map(content, client.received(before)))


def test_the_surface_is_coloured_by_the_chosen_quantity(client, viewer):
    surface = viewer.surface
    for name, values, limits in (
        ("uncertainty", surface.uncertainty_m, np.percentile(surface.uncertainty_m, [2, 98])),
        ("confidence", surface.confidence, (0, 1)),
    ):
        before = len(client.received())
        slide(client, "colour by", name)
        legend = content(client.wait_for(lambda m, name=name: name in content(m), before))
        assert all(f">{limit:.3g}<" in legend for limit in limits)
        shown = mesh_of(client.wait_for(is_mesh, before)).colors
        expected = shaded(Scale(*limits)(values), surface.lightness)
        np.testing.assert_allclose(shown, expected, atol=1)
    before = len(client.received())
    slide(client, "colour by", "intensity")
    client.wait_for(lambda m: "intensity" in content(m), before)


def status_of(viewer, *headers):
    """HTTP status of a request."""
    with socket.create_connection((viewer.host, viewer.port), timeout=10) as connection:
        lines = "\r\n".join(["GET / HTTP/1.1", *headers, "Connection: close", "", ""])
        connection.sendall(lines.encode())
        return int(connection.makefile("rb").readline().split()[1])


def test_requests_of_other_pages_are_rejected(viewer):
    host = f"Host: localhost:{viewer.port}"
    assert status_of(viewer, host) == 200
    # A name that resolves to this machine.
    assert status_of(viewer, f"Host: evil.example:{viewer.port}") == 403
    assert status_of(viewer, host, "Origin: http://evil.example") == 403
    upgrade = ("Upgrade: websocket", "Connection: Upgrade", "Sec-WebSocket-Version: 13",
               "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==")  # fmt: skip
    assert status_of(viewer, host, *upgrade, f"Origin: http://localhost:{viewer.port}") == 101
    assert status_of(viewer, host, *upgrade, "Origin: http://evil.example") == 403
    assert status_of(viewer, f"Host: evil.example:{viewer.port}", *upgrade) == 403


def test_an_unguarded_server_is_not_started(monkeypatch):
    monkeypatch.setattr("viser.ViserServer", lambda *_, **__: None)  # as if it had another listener
    with pytest.raises(RuntimeError, match="cannot be guarded"):
        start_server("127.0.0.1", 0)


def test_a_publicly_reachable_host_is_a_warning(sharp_map):
    with (
        pytest.warns(RuntimeWarning, match=r"0\.0\.0\.0"),
        Viewer(sharp_map, None, voxel_size=0.4, host="0.0.0.0", port=0, progress=False),
    ):
        pass


def test_closed_connections_are_released(viewer):
    earlier = [thing for thing in gc.get_objects() if type(thing) is ClientHandle]

    def held():
        return sum(type(thing) is ClientHandle for thing in gc.get_objects()) - len(earlier)

    def connect():
        with PlainClient(viewer.host, viewer.port) as client:
            client.wait_for(lambda message: message.kind == "GlbMessage")

    gc.disable()  # the collector would free some by chance
    try:
        for _ in range(4):
            connect()
        until_s = time.monotonic() + 20
        while held() > 2 and time.monotonic() < until_s:
            time.sleep(0.1)
            connect()  # its end releases those before it that were still in use when they ended
        assert held() <= 2  # the last ones may still be in use while others are freed
    finally:
        gc.enable()


def test_a_map_far_away_without_intensities():
    scene = ground_and_wall(offset=(500_000.0, 5_400_000.0, 300.0))
    radar_map = radarsdf.fit(scene.points, scene.poses, config=radarsdf.FitConfig.quick(), progress=False)
    scans = Scans(scene.points, scene.poses, scene.intensities)
    with (
        Viewer(radar_map, scans, voxel_size=0.2, port=0, progress=False) as viewer,
        PlainClient(viewer.host, viewer.port) as client,
    ):
        mesh = mesh_of(client.wait_for(is_mesh))
        assert np.abs(mesh.vertices).max() < 50  # of the local frame, representable in float32
        assert not any(message.name in (CLOUD, "/sensor") for message in client.received())
        sensor = scene.poses[:, :3, 3].mean(axis=0) - radar_map.origin + [0, 0, 2]
        viewer._on_click(SimpleNamespace(ray_origin=sensor.tolist(), ray_direction=[8.0, 0.0, -3.0]))
        answer = client.wait_for(lambda m: "signed distance" in content(m))
        assert "<td>position</td><td>5000" in content(answer)
        assert "intensity" not in content(answer)
        with pytest.raises(OSError, match="in use"):
            Viewer(radar_map, port=viewer.port)
    assert viewer._painter._thread not in threading.enumerate()
    with Viewer(radar_map, voxel_size=0.3, port=viewer.port, progress=False):  # the port is free again
        pass
