# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The occupancy grid of two dimensions, and its files as ROS's map_server reads them."""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from radarsdf.checks import number, path_of
from radarsdf.grids.costmap import ground
from radarsdf.io.files import check_outputs, write_whole

if TYPE_CHECKING:
    from radarsdf.grids.grid import Grid

_PIXELS = {-1: 205, 0: 254, 1: 0}  # as map_saver writes unknown, free and occupied


@dataclass(frozen=True)
class FlatGrid:
    """What is occupied, free and unknown in the columns of a grid."""

    origin: NDArray[np.float64]
    """(2,) lower corner of column (0, 0), world, m."""
    cell_size: float
    """Edge of a column, m."""
    state: NDArray[np.int8]
    """(X, Y) -1: unknown, 0: free, 1: occupied."""

    def save(self, path: str | PathLike[str]) -> None:
        """Writes ``NAME.yaml`` and beside it ``NAME.pgm``, as ROS's map_server reads them, of this path ``NAME.yaml``.

        Raises
        ------
        ValueError
            For another suffix.
        OSError
            If a file cannot be written.
        """
        target = path_of(path, "path")
        check_flat_path(target)
        image = target.with_suffix(".pgm")
        check_outputs([target, image])
        pixels = np.zeros(self.state.shape, np.uint8)
        for state, gray in _PIXELS.items():
            pixels[self.state == state] = gray
        rows = np.ascontiguousarray(pixels.T[::-1])  # the first row of an image is the last of y
        header = f"P5\n{rows.shape[1]} {rows.shape[0]}\n255\n".encode()
        write_whole(image, header + rows.tobytes())
        text = (
            f"image: {_quoted(image.name)}\nmode: trinary\nresolution: {self.cell_size:.9g}\n"
            f"origin: [{self.origin[0]:.9f}, {self.origin[1]:.9f}, 0.0]\n"
            "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
        )
        write_whole(target, text.encode())


def check_flat_path(path: Path) -> None:
    """Raises a ValueError for a path that :meth:`FlatGrid.save` does not take."""
    if path.suffix != ".yaml":
        msg = f"{path} must end in .yaml; the image is written beside it"
        raise ValueError(msg)


def _quoted(name: str) -> str:
    escaped = name.replace("'", "''")
    return f"'{escaped}'"


def flat_grid(grid: Grid, lower_m: float, upper_m: float) -> FlatGrid:
    """See :meth:`Grid.flat`."""
    lower_m, upper_m = number(lower_m, "lower_m"), number(upper_m, "upper_m")
    if lower_m >= upper_m:
        msg = f"upper_m must be above lower_m, {lower_m}, not {upper_m}"
        raise ValueError(msg)
    height, _ = ground(grid)
    if not np.isfinite(height).any():
        top = grid.origin[2] + grid.shape[2] * grid.voxel_size
        msg = (
            f"no column of the grid shows ground between z = {grid.origin[2]:.2f} and {top:.2f} m: choose a box that reaches "
            "from below the ground to two voxels or more above it"
        )
        raise ValueError(msg)
    from scipy.ndimage import distance_transform_edt  # noqa: PLC0415 - slow to import

    nearest = distance_transform_edt(np.isnan(height), return_distances=False, return_indices=True)
    base = height[tuple(nearest)]
    z = grid.origin[2] + (np.arange(grid.shape[2]) + 0.5) * grid.voxel_size
    above = z - base[..., None]
    half = grid.voxel_size / 2
    # Whole voxels: one that only reaches into the heights from below may be of the ground.
    between = (above - half >= lower_m) & (above - half < upper_m)
    occupied = (grid.occupied & between).any(axis=2)
    free = np.where(between, grid.free, True).all(axis=2) & between.any(axis=2)
    # A column whose heights reach out of the box is free only as far as the box tells.
    free &= base + upper_m <= grid.origin[2] + grid.shape[2] * grid.voxel_size + half
    state = np.full(height.shape, -1, np.int8)
    state[free], state[occupied] = 0, 1
    return FlatGrid(grid.origin[:2].copy(), grid.voxel_size, state)
