# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What is on the page while a new mesh is on its way. viser is not needed: the scene only remembers its nodes."""

from __future__ import annotations

import contextlib
from dataclasses import replace

import numpy as np
import pytest
from radarsdf.view import canvas as module
from radarsdf.view.canvas import SurfaceCanvas
from radarsdf.view.painter import Wish
from radarsdf.view.quantities import quantities_of
from radarsdf.view.surface import ShownSurface

SEES_ALL = Wish((0.0, 0.0, 1.5), max_uncertainty_m=9.0, min_confidence=0.0, quantity="intensity")
MOVING = replace(SEES_ALL, coarse=True, sensor=(3.0, 0.0, 1.5))


class Node:
    def __init__(self, scene, name, visible):
        self.scene, self.name, self.visible = scene, name, visible

    def remove(self):
        del self.scene.nodes[self.name]


class Scene:
    def __init__(self):
        self.nodes = {}
        self.scene = self

    def _add(self, name, *_, visible=True, **__):
        self.nodes[name] = Node(self, name, visible)
        return self.nodes[name]

    add_frame = add_point_cloud = add_glb = _add

    def atomic(self):
        return contextlib.nullcontext()

    def seen(self):
        return sorted(name.removeprefix("/surface/") for name, node in self.nodes.items() if node.visible)[1:]


@pytest.fixture
def page(sharp_map, monkeypatch):
    """A scene, its canvas, and what is seen each time that the canvas waits for the page."""
    scene, waits = Scene(), []
    monkeypatch.setattr(module, "wait_until_drawn", lambda *_: waits.append(scene.seen()))
    surface = ShownSurface.of(sharp_map, 0.4, max_vertices=100_000, progress=False)
    quantities = quantities_of(sharp_map, surface, None, SEES_ALL.sensor)
    shown = []
    return scene, SurfaceCanvas(scene, sharp_map, surface, quantities, None, shown.append), waits, shown


def never():
    return False


def test_something_is_seen_while_a_mesh_is_on_its_way(page):
    nodes, canvas, waits, shown = page
    canvas.show_mesh(SEES_ALL, never)
    assert nodes.seen() == ["mesh 1"]
    less = replace(SEES_ALL, max_uncertainty_m=8.0)
    canvas.show_mesh(less, never)  # by a slider: the old one stays until the new one is drawn
    assert waits.pop() == ["mesh 1", "mesh 2"]
    assert nodes.seen() == ["mesh 2"]
    canvas.show_cloud(MOVING)
    assert nodes.seen() == ["cloud"]
    canvas.show_mesh(MOVING, never)
    assert waits.pop() == ["cloud", "mesh 3"]
    assert nodes.seen() == ["mesh 3"]
    assert "/surface/mesh 2" not in nodes.nodes
    assert shown == [SEES_ALL, less, MOVING]


def test_what_is_superseded_is_not_taken_for_drawn(page):
    nodes, canvas, _, shown = page
    canvas.show_mesh(SEES_ALL, never)
    canvas.show_cloud(MOVING)
    answers = iter([False, True])  # a new position comes while the page is waited for
    canvas.show_mesh(MOVING, lambda: next(answers))
    assert nodes.seen() == ["cloud", "mesh 2"]
    assert shown == [SEES_ALL]
    canvas.show_cloud(MOVING)
    assert nodes.seen() == ["cloud"]
    canvas.show_mesh(MOVING, lambda: True)  # one comes even before it is sent
    assert canvas.sent == 2
    canvas.show_mesh(MOVING, never)
    assert nodes.seen() == ["mesh 3"]
    assert [name for name in nodes.nodes if "mesh" in name] == ["/surface/mesh 3"]


def test_nothing_is_left_to_see(page):
    nodes, canvas, _, _ = page
    canvas.show_mesh(SEES_ALL, never)
    canvas.show_mesh(replace(SEES_ALL, max_uncertainty_m=0.0), never)
    assert nodes.seen() == []
    assert len(canvas.faces) == 0


def test_the_cloud_hides_what_the_mesh_hides(page, sharp_map):
    _, canvas, _, _ = page
    limit = float(np.median(canvas._surface.uncertainty_m))
    canvas.show_cloud(replace(MOVING, max_uncertainty_m=limit))
    seen = canvas._cloud.points + sharp_map.origin
    assert 0 < len(seen) < len(canvas._spread)
    assert (sharp_map.uncertainty(seen) <= limit * 1.01).all()
    assert len(canvas._cloud.colors) == len(seen)


def test_what_does_not_change_is_not_sent_again(page):
    nodes, canvas, _, shown = page
    by_height = replace(SEES_ALL, quantity="height")
    canvas.show_mesh(by_height, never)
    moved = replace(by_height, sensor=MOVING.sensor, coarse=True)
    canvas.show_cloud(moved)  # the sensor moves, and the height is the same from everywhere
    canvas.show_mesh(moved, never)
    assert (nodes.seen(), canvas.sent, shown) == (["mesh 1"], 1, [by_height, moved])
    canvas.show_mesh(replace(moved, quantity="intensity"), never)
    canvas.show_cloud(MOVING)
    canvas.show_mesh(moved, never)  # of another quantity, while the cloud is seen
    assert (nodes.seen(), canvas.sent) == (["mesh 3"], 3)
