# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The page of what changed has fixed colours, which a legend explains."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from radarsdf.changes.changes import APPEARED, COLORS, GONE, NAMES, REPAINTED, SAME, ChangedSurface, Changes
from radarsdf.view import changed
from radarsdf.view import page as served


def surface(kinds, far):
    """A triangle of a metre for each kind, side by side."""
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    vertices = np.concatenate([corners + far + [2.0 * number, 0, 0] for number in range(len(kinds))])
    kind = np.repeat(np.array(kinds, np.int8), 3)
    faces = np.arange(len(vertices), dtype=np.int32).reshape(-1, 3)
    known = np.full(len(vertices), 0.9, np.float32)
    change = np.where(kind == REPAINTED, -6.0, np.nan).astype(np.float32)
    return ChangedSurface(vertices, faces, kind, known, np.full(len(vertices), np.nan, np.float32), change)


@pytest.fixture
def changes():
    far = np.array([4e5, 5e6, 100.0])  # UTM: float32 would round it to half a metre
    report = {
        "alignment": "As <given>.",
        "areas_m2": {"appeared": 0.5, "gone": 0.5, "moved": 0.0, "repainted": 0.5},
        "compared_m2": 2.0,
        "reflectance": "As <given>.",
    }
    after = surface([SAME, APPEARED, REPAINTED], far)
    return Changes(surface([GONE], far + [0, 3.0, 0]), after, np.eye(4), report)


def test_colours_and_legend(changes, monkeypatch):
    sent, texts = {}, []
    server = SimpleNamespace(
        scene=SimpleNamespace(add_glb=lambda name, data, **_: sent.update({name: data})),
        gui=SimpleNamespace(add_html=texts.append),
        initial_camera=SimpleNamespace(),
    )
    meshes = []
    monkeypatch.setattr(served, "require_viser", lambda: None)
    monkeypatch.setattr(served, "start_server", lambda *_: server)
    monkeypatch.setattr(served, "stop_server", lambda _: None)
    monkeypatch.setattr(changed, "glb", lambda *parts: meshes.append(parts) or b"glb")
    with changed.ChangesView(changes, changes.regions(), 0.2, port=0):
        pass
    assert sent == {"/surface": b"glb"}
    (vertices, faces, colors) = meshes[0]
    assert np.abs(vertices).max() < 10
    assert len(faces) == 4
    # Flat triangles are all as light, so each is a multiple of its colour.
    for rows, kind in ((slice(3, 6), APPEARED), (slice(6, 9), REPAINTED), (slice(9, 12), GONE)):
        shown, fixed = colors[rows].astype(float), np.array(COLORS[kind], float)
        assert np.abs(shown / shown.max(axis=1, keepdims=True) - fixed / fixed.max()).max() < 0.1
    legend = texts[0]
    for kind, name in NAMES.items():
        assert name in legend
        assert "rgb({},{},{})".format(*COLORS[kind]) in legend
    assert "As &lt;given&gt;." in texts[1]
    assert "repainted, 6.0 weaker, 0.5 m²" in texts[2]


def test_nothing_to_show_is_said(changes, monkeypatch):
    monkeypatch.setattr(served, "require_viser", lambda: None)
    nothing = ChangedSurface(*(values[:0] for values in vars(changes.after).values()))
    with pytest.raises(ValueError, match="there is no surface here"):
        changed.ChangesView(Changes(nothing, nothing, np.eye(4), changes.report), [], 0.2, port=0)
