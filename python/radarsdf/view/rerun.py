"""rerun: a growing map in its web viewer, or in an .rrd file. An extra."""

import contextlib
import importlib
import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote

from radarsdf.arrays import Floats
from radarsdf.checks import restating
from radarsdf.extras import require
from radarsdf.grids.grid import Grid
from radarsdf.io.files import checked_suffix, whole_file
from radarsdf.scans import Scan
from radarsdf.view.serving import LOCALHOST, free_port
from radarsdf.view.sinks import FREE_COLOR, PATH_COLOR, Sink, frame_of, uncertainty_colors


class RerunSink(Sink):
    def __init__(self, rerun: Any, stream: Any) -> None:
        self._rerun, self._stream = rerun, stream
        stream.log("map", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)

    def show_scan(self, scan: Scan, time_s: float) -> None:
        T, name = scan.T_world_sensor, f"map/{frame_of(scan)}"
        pose = self._rerun.Transform3D(translation=self.local(T[None, :3, 3])[0], mat3x3=T[:3, :3])
        self._log(time_s, {name: pose, f"{name}/returns": self._rerun.Points3D(scan.points, radii=0.05)})

    def show_surface(self, mesh: Any, path: Floats, time_s: float) -> None:
        style = {"vertex_normals": mesh.vertex_normals, "vertex_colors": uncertainty_colors(mesh)[0]}
        local = {"vertex_positions": self.local(mesh.vertices), "triangle_indices": mesh.faces}
        line = self._rerun.LineStrips3D([self.local(path)], colors=[PATH_COLOR])
        self._log(time_s, {"map/trajectory": line, "map/surface": self._rerun.Mesh3D(**local, **style)})

    def show_grid(self, grid: Grid, time_s: float) -> None:
        free, radius_m = self.local(grid.centres(grid.free)), 0.2 * grid.voxel_size
        points = self._rerun.Points3D(free, colors=[FREE_COLOR], radii=radius_m)
        self._log(time_s, {"map/free_space": points})

    def _log(self, time_s: float, entities: dict[str, Any]) -> None:
        self._stream.set_time("time", timestamp=time_s)  # of this thread
        for name, entity in entities.items():
            self._stream.log(name, entity)


@contextlib.contextmanager
def rerun_sink(path: Path | None) -> Iterator[Sink]:
    """Yield a sink that writes an .rrd file whole or not at all; without a path, a web viewer for this machine only."""
    rerun = require("rerun", what="rerun needs")
    stream = rerun.RecordingStream("radarsdf")
    checked_suffix(path, [".rrd"], "rerun")
    if path is not None:
        with whole_file(path) as file:
            stream.save(file.name)
            yield RerunSink(rerun, stream)
            with restating(f"{path} was not written", RuntimeError, kind=OSError):
                stream.flush()
            stream.disconnect()
        return
    port = free_port(LOCALHOST, None, 9876)
    page = free_port(LOCALHOST, None, port + 1)
    words = ["--serve-web", "--bind", LOCALHOST, "--port", str(port), "--web-viewer-port", str(page)]
    # The SDK itself would serve to all machines, and `python -m rerun` is the parent of the viewer. Ctrl-C is not for it.
    package = Path(importlib.import_module("rerun_cli").__file__ or "").parent
    binary = shutil.which("rerun", path=f"{package}{os.pathsep}{package / 'Rerun.app/Contents/MacOS'}")
    quiet: dict[str, Any] = dict.fromkeys(("stdout", "stderr"), subprocess.DEVNULL)
    with subprocess.Popen([binary or "rerun", *words], start_new_session=True, **quiet) as server:
        try:
            stream.connect_grpc(url := f"rerun+http://{LOCALHOST}:{port}/proxy")
            sink = RerunSink(rerun, stream)
            sink.url = f"http://{LOCALHOST}:{page}?url={quote(url)}"
            yield sink
            stream.disconnect()
        finally:
            server.terminate()
