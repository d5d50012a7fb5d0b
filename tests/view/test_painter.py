# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The thread that paints: the newest wish wins, nothing waits for it, and its errors are not lost."""

from __future__ import annotations

import threading
import time

import pytest
from radarsdf.view.painter import Painter, Wish

START = Wish((0.0, 0.0, 0.0), max_uncertainty_m=1.0, min_confidence=0.0)


class Canvas:
    def __init__(self, cloud_s=0.0):
        self.clouds, self.meshes, self.cloud_s = [], [], cloud_s
        self.drawn = threading.Event()

    def show_scan(self, wish):
        pass

    def show_cloud(self, wish):
        time.sleep(self.cloud_s)
        self.clouds.append(wish.sensor[0])

    def show_mesh(self, wish, superseded):
        assert not superseded()
        self.meshes.append(wish.sensor[0])
        self.drawn.set()

    def wait(self):
        assert self.drawn.wait(10)
        self.drawn.clear()


@pytest.fixture
def painted():
    started = []

    def start(canvas):
        painter = Painter(canvas, START)
        started.append(painter)
        return painter

    yield start
    for painter in started:
        painter.stop()


def test_the_newest_position_wins(painted):
    canvas = Canvas(cloud_s=0.02)
    painter = painted(canvas)
    canvas.wait()
    began_s = time.perf_counter()
    for i in range(200):
        painter.wish(sensor=(float(i), 0.0, 0.0), coarse=True, settle_s=9.0)
        time.sleep(0.001)
    assert time.perf_counter() - began_s < 2.0  # no wish waited for the canvas
    painter.wish(coarse=False, settle_s=0.0)
    canvas.wait()
    assert 1 < len(canvas.clouds) < 100
    assert canvas.clouds == sorted(set(canvas.clouds))
    assert canvas.meshes == [0.0, 199.0]  # the first, and the last: none in between


def test_a_pause_is_taken_for_the_end(painted):
    canvas = Canvas()
    painter = painted(canvas)
    canvas.wait()
    painter.wish(sensor=(5.0, 0.0, 0.0), coarse=True, settle_s=0.05)
    canvas.wait()
    assert (canvas.clouds, canvas.meshes) == ([5.0], [0.0, 5.0])


def test_an_error_ends_the_wait(painted):
    class Broken(Canvas):
        def show_mesh(self, *_):
            msg = "too large"
            raise MemoryError(msg)

    with pytest.raises(MemoryError, match="too large"):
        painted(Broken()).wait()


def test_stop_ends_the_thread_and_the_wait():
    painter = Painter(Canvas(), START)
    waiting = threading.Thread(target=painter.wait)
    waiting.start()
    painter.stop()
    waiting.join(10)
    assert not waiting.is_alive()
    assert "radarsdf view" not in [thread.name for thread in threading.enumerate()]
