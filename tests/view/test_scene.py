"""Contents of the page during and after updates. viser is not needed: the scene only records its nodes."""

import contextlib
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from radarsdf.view import scene as module
from radarsdf.view.scene import Canvas, Painter, State
from radarsdf.view.surface import ShownSurface, quantities_of

ALL = State((0.0, 0.0, 1.5), limits=(9.0, 0.0), quantity="intensity")
MOVING = replace(ALL, coarse=True, sensor=(3.0, 0.0, 1.5))


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
    """A scene, its canvas, and the visible nodes whenever the canvas waits for the page."""
    scene, waits, shown = Scene(), [], []
    monkeypatch.setattr(module, "wait_until_drawn", lambda *_: waits.append(scene.seen()))
    surface = ShownSurface.of(sharp_map, 0.4, max_vertices=100_000, progress=False)
    quantities = quantities_of(sharp_map, surface, ALL.sensor)
    return scene, Canvas(scene, sharp_map, surface, quantities, None, shown.append), waits, shown


def never():
    return False


def test_something_is_visible_while_a_mesh_is_transferred(page):
    nodes, canvas, waits, shown = page
    canvas.show_mesh(ALL, never)
    less = replace(ALL, limits=(8.0, 0.0))
    canvas.show_mesh(less, never)  # the old mesh stays until the new one is drawn
    assert waits.pop() == ["mesh 1", "mesh 2"]
    assert nodes.seen() == ["mesh 2"]
    canvas.show_cloud(MOVING)
    assert nodes.seen() == ["cloud"]
    canvas.show_mesh(MOVING, never)
    assert waits.pop() == ["cloud", "mesh 3"]
    assert nodes.seen() == ["mesh 3"]
    assert shown == [ALL, less, MOVING]
    canvas.show_mesh(replace(MOVING, limits=(0.0, 0.0)), never)
    assert nodes.seen() == []
    assert len(canvas.faces) == 0


def test_a_superseded_mesh_does_not_count_as_drawn(page):
    nodes, canvas, _, shown = page
    canvas.show_mesh(ALL, never)
    canvas.show_cloud(MOVING)
    answers = iter([False, True])  # a new position arrives while waiting for the page
    canvas.show_mesh(MOVING, lambda: next(answers))
    assert nodes.seen() == ["cloud", "mesh 2"]
    assert shown == [ALL]
    canvas.show_mesh(MOVING, never)
    assert [name for name in nodes.nodes if "mesh" in name] == ["/surface/mesh 3"]


def test_the_cloud_hides_what_the_mesh_hides(page, sharp_map):
    _, canvas, _, _ = page
    limit = float(np.median(canvas._surface.uncertainty_m))
    canvas.show_cloud(replace(MOVING, limits=(limit, 0.0)))
    seen = canvas._cloud.points + sharp_map.origin
    assert 0 < len(seen) == len(canvas._cloud.colors) < len(canvas._spread)
    assert (sharp_map.uncertainty(seen) <= limit * 1.01).all()


class SlowCanvas:
    def __init__(self):
        self.clouds, self.meshes = [], []
        self.drawn = threading.Event()

    def show_scan(self, state):
        pass

    def show_cloud(self, state):
        time.sleep(0.02)
        self.clouds.append(state.sensor[0])

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
        painter.change(sensor=(float(i), 0.0, 0.0), coarse=True, settle_s=9.0)
        time.sleep(0.001)
    painter.change(coarse=False, settle_s=0.0)
    canvas.wait()
    assert 1 < len(canvas.clouds) < 100
    assert canvas.clouds == sorted(set(canvas.clouds))
    assert canvas.meshes == [0.0, 199.0]
    painter.change(sensor=(5.0, 0.0, 0.0), coarse=True, settle_s=0.05)  # a pause ends a drag
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
