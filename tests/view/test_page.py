"""The page in a headless browser: a drag and a click, all frames meanwhile, and a narrow screen."""

import numpy as np
import pytest
from radarsdf.io import Scans
from radarsdf.map.colors import SHARES
from radarsdf.view.pages import Viewer
from radarsdf.view.surface import shaded
from scipy.spatial import cKDTree

pytest.importorskip("viser", reason="the extra view is not installed")

from .page import camera_of, drawn, open_page, pixel_of, why_no_browser

pytestmark = pytest.mark.skipif(why_no_browser() is not None, reason=str(why_no_browser()))


def test_a_drag_and_a_click(sharp_map, scene):
    scans = Scans(scene.points, scene.poses, scene.intensities)
    with (
        Viewer(sharp_map, scans, voxel_size=0.4, port=0, progress=False) as viewer,
        open_page(f"http://127.0.0.1:{viewer.port}", 900, 450) as page,
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

        # The sensor is dragged by its arrow along x, without a blank frame.
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
        both[:, 570:] = False  # the panels
        change = np.abs(after.astype(int) - before)[both].mean()
        assert change > 3


def _of_scale(pixels):
    """Whether each colour (N, 3) is on the scale, up to shading."""
    scale = SHARES(np.linspace(0, 1, 256))
    shades = np.concatenate([shaded(scale, np.full(256, factor)) for factor in np.linspace(0.87, 1, 8)])
    return cKDTree(shades.astype(float)).query(pixels.astype(float))[0] < 6


def test_a_narrow_screen_shows_the_map_in_the_colours_of_the_scale(sharp_map):
    with (
        Viewer(sharp_map, voxel_size=0.4, port=0, progress=False) as viewer,
        open_page(f"http://127.0.0.1:{viewer.port}", 390, 844) as page,
    ):
        viewer._gizmo.visible = False
        page.wait_until(lambda: page.tab.get_by_text("Reset view").count() > 0)
        seen = page.settle()[170:540]  # without the panel, and what the page says of the graphics card
        pixels = seen[seen.min(axis=2) < 200]
        assert len(pixels) > 2_000
        assert _of_scale(pixels).mean() > 0.9  # edges of triangles are blended with the white background

        # All of the surface is in the frame, and the controls are folded.
        camera = camera_of(viewer._server)
        corners = np.array([pixel_of(camera, point) for point in viewer._extent[::10]])
        assert (corners > 0).all()
        assert (corners < [390, 844]).all()
        panel = page.tab.get_by_text("radarsdf", exact=True).last.locator(
            "xpath=ancestor::div[contains(@style,'position: fixed')]"
        )
        assert panel.bounding_box()["height"] < 0.3 * 844
        page.tab.get_by_role("button", name="Expand panel controls").click()
        page.wait_until(lambda: page.tab.get_by_text("confidence ≥").is_visible())
