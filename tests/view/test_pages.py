"""Pages of a growing surface and of changes, in coordinates representable in float32."""

import io
from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from radarsdf.changes.changes import (
    APPEARED,
    COLORS,
    GONE,
    NAMES,
    REFLECTANCE_CHANGED,
    SAME,
    ChangedSurface,
    Changes,
)
from radarsdf.scans import Scan
from radarsdf.view import pages, scene, serving

FAR = np.array([4e5, 5e6, 100.0])  # UTM: float32 would round it to half a metre


@pytest.fixture
def server(monkeypatch):
    shown, texts = {}, []
    scene = SimpleNamespace(
        add_glb=lambda name, data, **_: shown.update({name: data}),
        add_point_cloud=lambda name, points, *_, **__: shown.update({name: points}),
        add_line_segments=lambda name, points, *_, **__: shown.update({name: points}),
    )
    server = SimpleNamespace(
        scene=scene, initial_camera=SimpleNamespace(), atomic=nullcontext, shown=shown, texts=texts
    )
    server.gui = SimpleNamespace(add_html=lambda text: texts.append(text) or SimpleNamespace(content=text))
    monkeypatch.setattr(serving, "page_port", serving.free_port)
    monkeypatch.setattr(serving, "start_server", lambda *_: server)
    monkeypatch.setattr(serving, "stop_server", lambda _: None)
    return server


def test_a_growing_surface_is_replaced(server):
    path = FAR + np.array([[300.0, 0, 1.5], [301, 0, 1.5], [302, 0, 1.5]])
    origin = np.round(path[0], -3)
    with pages.GrowingView(port=0) as view:
        for size in (1.0, 2.0):
            mesh = trimesh.creation.box([size] * 3)
            mesh.apply_translation(FAR)
            mesh.vertex_attributes["uncertainty_m"] = np.linspace(0.01, 0.1, len(mesh.vertices))
            view.show_surface(mesh, path, 0.0)
        view.show_scan(Scan(np.ones((5, 3), np.float32), np.eye(4) + np.eye(4, k=3) * FAR[0]), 0.0)
    shown = trimesh.load_mesh(io.BytesIO(server.shown["/surface"]), "glb", process=False)
    corners = (np.sort(vertices, axis=0) for vertices in (shown.vertices, mesh.vertices - origin))
    np.testing.assert_allclose(*corners, atol=1e-4)
    assert b"COLOR_0" in server.shown["/surface"]
    assert all(text in view._legend.content for text in ("standard error", "0.0118", "0.0982"))
    np.testing.assert_allclose(server.shown["/path"], np.stack([path[:-1], path[1:]], 1) - origin)
    np.testing.assert_allclose(server.shown["/returns"][:, 0], 1 + FAR[0] - origin[0], atol=1e-4)
    assert np.abs(server.initial_camera.position).max() < 1000


def triangles(kinds, offset):
    vertices = np.concatenate([np.eye(3) + FAR + offset + [2.0 * i, 0, 0] for i in range(len(kinds))])
    kind = np.repeat(np.array(kinds, np.int8), 3)
    unknown = np.full(len(kind), np.nan, np.float32)
    change = np.where(kind == REFLECTANCE_CHANGED, -6.0, np.nan).astype(np.float32)
    faces = np.arange(len(kind), dtype=np.int32).reshape(-1, 3)
    return ChangedSurface(vertices, faces, kind, np.full(len(kind), 0.9, np.float32), unknown, change)


def test_changes_have_their_colours_and_a_legend(server, monkeypatch):
    meshes = []
    monkeypatch.setattr(scene, "glb", lambda *mesh: meshes.append(mesh) or b"glb")
    after = triangles([SAME, APPEARED, REFLECTANCE_CHANGED], [0, 0, 0])
    changes = Changes(triangles([GONE], [0, 3.0, 0]), after, np.eye(4), {"alignment": "As <given>."})
    with pages.ChangesView(changes, changes.regions(), 0.2, port=0):
        assert server.shown == {"/surface": b"glb"}
    ((vertices, faces, colors),) = meshes
    assert np.abs(vertices).max() < 10
    assert len(faces) == 4
    for rows, kind in ((slice(3, 6), APPEARED), (slice(6, 9), REFLECTANCE_CHANGED), (slice(9, 12), GONE)):
        shown, fixed = colors[rows].astype(float), np.array(COLORS[kind], float)
        assert np.abs(shown / shown.max(axis=1, keepdims=True) - fixed / fixed.max()).max() < 0.1
    legend, alignment, table = server.texts
    assert all("rgb({} {} {})".format(*COLORS[kind]) in legend and NAMES[kind] in legend for kind in NAMES)
    assert "As &lt;given&gt;." in alignment
    for region in changes.regions():
        x, y, z = region.box.mean(axis=0)
        row = f"<td>({x:.1f}, {y:.1f}, {z:.1f}) m</td><td>{region.words}, {region.area_m2:.1f} m²</td>"
        assert row in table
    nothing = ChangedSurface(*(values[:0] for values in vars(after).values()))
    with pytest.raises(ValueError, match="no surface"):
        pages.ChangesView(Changes(nothing, nothing, np.eye(4), changes.report), [], 0.2, port=0)
