"""What shows a growing map: pages, viewers, files and ROS 2 are a :class:`Sink` each."""

from abc import ABC, abstractmethod
from typing import Any

import numpy as np

from radarsdf.arrays import Bytes, Floats
from radarsdf.grids.grid import Grid
from radarsdf.map.colors import Scale
from radarsdf.scans import Scan

PATH_COLOR, FREE_COLOR = (0, 190, 255), (90, 160, 120)


class Sink(ABC):
    """A page, a viewer or a file. Positions are in the world frame, m. Methods may be called from several threads."""

    url = ""  # where it is served
    origin: Floats | None = None  # (3,) world, m: viewers compute in float32

    @abstractmethod
    def show_scan(self, scan: Scan, time_s: float) -> None:
        """Show the returns of a scan, and the pose of its radar."""

    @abstractmethod
    def show_surface(self, mesh: Any, path: Floats, time_s: float) -> None:
        """Replace the mesh, coloured by its uncertainty, and the sensor positions (F, 3)."""

    @abstractmethod
    def show_grid(self, grid: Grid, time_s: float) -> None:
        """Replace occupied and free space."""

    def local(self, positions: Floats) -> Floats:
        """Return positions (N, 3) relative to :attr:`origin`, whole kilometres near the first one."""
        if self.origin is None:
            self.origin = np.round(positions[0], -3)
        return positions - self.origin


def uncertainty_colors(mesh: Any) -> tuple[Bytes, Scale]:
    """Return the sRGB colours (V, 3) of the vertices of a mesh by their uncertainty, and their scale, m."""
    uncertainty_m = np.asarray(mesh.vertex_attributes["uncertainty_m"])
    scale = Scale.of(uncertainty_m)
    return scale(uncertainty_m), scale


def frame_of(scan: Scan) -> str:
    # With a slash, one radar would be the parent of another.
    return "radar" if scan.sensor is None else f"radar_{scan.sensor}".replace("/", "_")
