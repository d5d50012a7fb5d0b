# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What the page shows meanwhile and in the end. viser is not needed: the scene only records its nodes."""

from __future__ import annotations

import contextlib
import threading
import time
from dataclasses import replace

import pytest
from radarsdf.view import scene as module
from radarsdf.view.quantities import quantities_of
from radarsdf.view.scene import Canvas, Painter, State
from radarsdf.view.surface import ShownSurface

ALL = State((0.0, 0.0, 1.5), max_uncertainty_m=9.0, min_confidence=0.0, quantity="intensity")
MOVING = replace(ALL, sensor=(3.0, 0.0, 1.5))


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
    """A scene, its canvas, what is visible while a mesh is on its way to the page, and the states that are shown."""
    scene, waits, shown = Scene(), [], []
    monkeypatch.setattr(module.time, "sleep", lambda _: waits.append(scene.seen()))
    surface = ShownSurface.of(sharp_map, 0.4, progress=False)
    quantities = quantities_of(sharp_map, surface, ALL.sensor)
    return scene, Canvas(scene, sharp_map, surface, quantities, None, shown.append), waits, shown


def never():
    return False


def test_something_is_visible_while_a_mesh_is_on_its_way(page):
    nodes, canvas, waits, shown = page
    canvas.show_mesh(ALL, never)
    less = replace(ALL, max_uncertainty_m=8.0)
    canvas.show_mesh(less, never)  # the old mesh stays until the new one is drawn
    assert waits.pop() == ["mesh 1", "mesh 2"]
    assert nodes.seen() == ["mesh 2"]
    canvas.show_mesh(MOVING, never)
    assert waits.pop() == ["mesh 2", "mesh 3"]
    assert nodes.seen() == ["mesh 3"]
    assert shown == [ALL, less, MOVING]
    canvas.show_mesh(replace(MOVING, max_uncertainty_m=0.0), never)
    assert nodes.seen() == []
    assert len(canvas.faces) == 0


def test_a_superseded_mesh_is_not_sent(page):
    nodes, canvas, _, shown = page
    canvas.show_mesh(ALL, never)
    canvas.show_mesh(MOVING, lambda: True)
    assert nodes.seen() == ["mesh 1"]
    assert shown == [ALL]


class SlowCanvas:
    def __init__(self):
        self.scans, self.meshes = [], []
        self.drawn = threading.Event()

    def show_scan(self, state):
        time.sleep(0.02)
        self.scans.append(state.sensor[0])

    def show_mesh(self, state, _):
        self.meshes.append(state.sensor[0])
        self.drawn.set()

    def wait(self):
        assert self.drawn.wait(10)
        self.drawn.clear()


def test_the_newest_state_wins():
    canvas = SlowCanvas()
    painter = Painter(canvas, ALL)
    canvas.wait()
    for i in range(200):
        painter.change(sensor=(float(i), 0.0, 0.0), settle_s=9.0)
        time.sleep(0.001)
    painter.change(settle_s=0.0)
    canvas.wait()
    assert 1 < len(canvas.scans) < 100
    assert canvas.scans == sorted(canvas.scans)
    assert canvas.meshes == [0.0, 199.0]
    painter.change(sensor=(5.0, 0.0, 0.0), settle_s=0.05)  # a pause ends a drag
    canvas.wait()
    assert canvas.meshes[-1] == 5.0
    waiting = threading.Thread(target=painter.wait)
    waiting.start()
    painter.stop()
    waiting.join(10)
    assert not waiting.is_alive()
    assert not painter._thread.is_alive()


def test_an_error_of_the_thread_is_raised():
    class Broken(SlowCanvas):
        def show_mesh(self, *_):
            raise MemoryError

    with pytest.raises(MemoryError):
        Painter(Broken(), ALL).wait()
