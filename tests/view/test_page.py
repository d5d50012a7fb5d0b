# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The page in a real browser without a screen: a drag and a click by the mouse, and every frame that is drawn."""

from __future__ import annotations

import numpy as np
import pytest
from radarsdf.io import Scans
from radarsdf.view.viewer import Viewer

pytest.importorskip("viser", reason="the extra view is not installed")

from bench.viewing.page import camera_of, drawn, open_page, pixel_of, why_no_browser

pytestmark = pytest.mark.skipif(why_no_browser() is not None, reason=str(why_no_browser()))


def test_a_drag_and_a_click(sharp_map, scene):
    scans = Scans(scene.points, scene.poses, scene.intensities)
    with (
        Viewer(sharp_map, scans, voxel_size=0.4, port=0, progress=False) as viewer,
        open_page(f"http://127.0.0.1:{viewer.port}", 800, 450) as page,
    ):
        page.wait_until(lambda: drawn(page.screenshot()) > 8_000)
        camera = camera_of(viewer._server)
        before = page.settle()

        # A click on the plane.
        target = np.array([13.0, 0.0, 0.0])
        page.click(pixel_of(camera, target - sharp_map.origin))
        page.wait_until(lambda: "signed distance" in page.text())
        position = page.text().split("position")[1].split("signed")[0].strip().removesuffix(" m")
        assert np.array(position.split(","), float) == pytest.approx(target, abs=0.5)

        # The sensor is dragged by its arrow along x, and no frame is blank meanwhile.
        start, meshes = np.array(viewer._gizmo.position), viewer._canvas.sent
        arrow = start + [0.6 * viewer._gizmo.scale, 0, 0]
        page.start_recording()
        page.drag(pixel_of(camera, arrow), pixel_of(camera, arrow + [4, 0, 0]), steps=10, step_s=0.06)
        page.wait_until(lambda: viewer._canvas.sent > meshes and not viewer._canvas.coarse)
        after = page.settle()
        frames = page.stop_recording()
        moved = np.array(viewer._gizmo.position) - start
        assert moved == pytest.approx([4, 0, 0], abs=1)
        assert viewer._painter.newest.sensor == pytest.approx(viewer._gizmo.position + sharp_map.origin)
        assert len(frames) >= 3
        least = min(drawn(frame) for _, frame in frames)
        assert least > 0.8 * drawn(before)

        # The surface has other colours now.
        both = (before.min(axis=2) < 235) & (after.min(axis=2) < 235)
        both[:, 470:] = False  # the panel
        change = np.abs(after.astype(int) - before)[both].mean()
        assert change > 3
