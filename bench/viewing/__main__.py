# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Updates while the sensor is dragged, as clients receive and draw them: `python -m bench.viewing`.

A plain websocket client drags and counts; then a browser without a screen, where there is one, drags by the mouse, and
each frame that it draws is kept: none may be blank. The map is that of the scene `hugin`, simulated. The table is
printed and written to `bench_results/viewing.md`, the emptiest and the fullest frame of the drag beside it.
"""

from __future__ import annotations

import argparse
import statistics
import time
from pathlib import Path
from typing import Any

import numpy as np
import radarsdf
from numpy.typing import NDArray
from radarsdf.io import Scans
from radarsdf.view.viewer import Viewer

from bench.paper.report import ROOT
from bench.timing import timed

from .client import PlainClient, is_mesh
from .page import camera_of, drawn, open_page, pixel_of, why_no_browser

_VOXEL_M = 0.0712  # about 400,000 vertices of hugin
_CLOUD = "/surface/cloud"
_DRAG_M = 8.0


def main(arguments: list[str] | None = None) -> None:
    """Measure, print and write the table."""
    words = _parser().parse_args(arguments)
    simulation = radarsdf.simulate.hugin(frames=20 if words.quick else None)
    scans = Scans(simulation.points, simulation.poses, simulation.intensities)
    radar_map = radarsdf.fit(scans.points, scans.poses, scans.intensities, progress=False)
    voxel_m = 0.4 if words.quick else words.voxel
    words.out.mkdir(parents=True, exist_ok=True)
    lines = []
    with Viewer(
        radar_map, scans, voxel_size=voxel_m, max_vertices=10_000_000, port=0, progress=False
    ) as viewer:
        lines += [f"{len(viewer.surface.vertices)} vertices, {len(viewer.surface.faces)} triangles.", ""]
        lines += ["| client | what | |", "|---|---|---|"]
        lines += [f"| plain | {what} | {value} |" for what, value in _plain(viewer, words.seconds).items()]
        missing = why_no_browser()
        if missing is None:
            rows = _browser(viewer, words.seconds, words.out)
            lines += [f"| chromium | {what} | {value} |" for what, value in rows.items()]
        else:
            lines += [f"| chromium | {missing} | |"]
    print("\n".join(lines))
    (words.out / "viewing.md").write_text("\n".join(lines) + "\n", encoding="utf-8")


def _plain(viewer: Viewer, seconds: float) -> dict[str, str]:
    """What a client receives that draws nothing."""
    with PlainClient(viewer.host, viewer.port) as client:
        with timed() as starting:
            client.wait_for(is_mesh)
        _settled(client)
        before = len(client.received())
        began_s, ended_s = client.drag(seconds)
        mesh = client.wait_for(is_mesh, before)
        received = client.received(before)
        updates = [m for m in received if m.changes(_CLOUD, "colors") and m.at_s <= ended_s]
        if len(updates) < 2:
            msg = f"{len(updates)} updates in {seconds:g} s: drag for longer (--seconds)"
            raise SystemExit(msg)
        gaps_s = np.diff([m.at_s for m in updates])
        frames = {m.at_s: m.frame_bytes for m in received if m.at_s <= ended_s}
        return {
            "until the first mesh": f"{starting.wall_s:.2f} s",
            "updates a second": f"{len(updates) / (ended_s - began_s):.1f}",
            "between two updates, median, worst": f"{np.median(gaps_s):.3f}, {gaps_s.max():.3f} s",
            "an update": f"{statistics.median(m.frame_bytes for m in updates) / 1e3:.0f} kB",
            "all while dragging": f"{sum(frames.values()) / (ended_s - began_s) / 1e6:.2f} MB/s",
            "from the drag's end to the mesh": f"{mesh.at_s - ended_s:.2f} s",
            "a mesh": f"{mesh.frame_bytes / 1e6:.1f} MB",
        }


def _browser(viewer: Viewer, seconds: float, out: Path) -> dict[str, str]:
    """What a browser draws."""
    server: Any = viewer._server
    with open_page(f"http://127.0.0.1:{viewer.port}") as page:
        with timed() as starting:
            page.wait_until(lambda: drawn(page.screenshot()) > 0)
            before = page.settle()
        camera, sensor = camera_of(server), np.array(viewer._gizmo.position)
        arrow = sensor + [0.6 * viewer._gizmo.scale, 0, 0]
        first = drawn(before)
        meshes = viewer._canvas.sent
        page.start_recording()
        page.drag(
            pixel_of(camera, arrow),
            pixel_of(camera, arrow + [_DRAG_M, 0, 0]),
            steps=round(seconds / 0.05),
            step_s=0.05,
        )
        with timed() as swapping:
            page.wait_until(lambda: viewer._canvas.sent > meshes and not viewer._canvas.coarse)
        page.settle()
        frames = page.stop_recording()
    counts = [drawn(frame) for _, frame in frames]
    for name, number in (("least", int(np.argmin(counts))), ("most", int(np.argmax(counts)))):
        _save(out / f"viewing_{name}.png", frames[number][1])
    moved_m = float(np.linalg.norm(np.array(viewer._gizmo.position) - sensor))
    return {
        "until it is drawn": f"{starting.wall_s:.1f} s",
        "the sensor was dragged": f"{moved_m:.1f} m",
        "from the drag's end until the mesh is drawn": f"{swapping.wall_s:.2f} s",
        "frames during drag and swap": str(len(frames)),
        "pixels of the scene before, least, most": f"{first}, {min(counts)}, {max(counts)}",
        "blank frames": str(sum(count < first / 2 for count in counts)),
    }


def _settled(client: PlainClient, quiet_s: float = 1.0) -> None:
    """Wait until nothing more comes."""
    count = -1
    while count != len(client.received()):
        count = len(client.received())
        time.sleep(quiet_s)


def _save(path: Path, frame: NDArray[np.uint8]) -> None:
    from PIL import Image  # noqa: PLC0415 - comes with viser

    Image.fromarray(frame).save(path)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m bench.viewing", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="only show that it works")
    parser.add_argument(
        "--seconds", type=float, default=5.0, help="how long the sensor is dragged; default: 5"
    )
    parser.add_argument(
        "--voxel", type=float, default=_VOXEL_M, help=f"voxels of the mesh, m; default: {_VOXEL_M}"
    )
    parser.add_argument("--out", type=Path, default=ROOT / "bench_results", help="default: bench_results")
    return parser


if __name__ == "__main__":
    main()
