# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The page of a growing map shows the newest surface, near its own origin."""

from __future__ import annotations

from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from radarsdf.view import growing
from radarsdf.view import page as served


class Scene:
    def __init__(self):
        self.shown = {}

    def add_mesh_simple(self, name, vertices, faces, **_):
        self.shown[name] = vertices, faces

    def add_line_segments(self, name, points, **_):
        self.shown[name] = points


@pytest.fixture
def page(monkeypatch):
    server = SimpleNamespace(scene=Scene(), initial_camera=SimpleNamespace(), atomic=nullcontext)
    monkeypatch.setattr(served, "require_viser", lambda: None)
    monkeypatch.setattr(served, "start_server", lambda *_: server)
    monkeypatch.setattr(served, "stop_server", lambda server: server.scene.shown.clear())
    return server


def test_the_newest_surface_is_shown_near_the_origin(page):
    far = np.array([4e5, 5e6, 100.0])  # UTM: float32 would round it to half a metre
    path = far + np.array([[0, 0, 1.5], [1, 0, 1.5], [2, 0, 1.5]])
    with growing.GrowingView(port=0) as view:
        view.show(trimesh.Trimesh(), path)
        assert page.scene.shown == {}
        for size in (1.0, 2.0):
            mesh = trimesh.creation.box([size] * 3)
            mesh.apply_translation(far)
            view.show(mesh, path)
        vertices, faces = page.scene.shown["/surface"]
        assert vertices.dtype == np.float32
        assert np.allclose(np.ptp(vertices, axis=0), 2.0, atol=1e-6)
        assert len(faces) == 12
        assert page.scene.shown["/path"].shape == (2, 2, 3)
        assert np.abs(page.initial_camera.position).max() < 100
    assert page.scene.shown == {}
