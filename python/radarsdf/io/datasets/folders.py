# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What lies beside the scans of a folder: the pose of the radar on its platform, and points of a lidar.

`T_a_b` transforms points of frame b to frame a, and so does the matrix in a file `a_T_b.txt`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from radarsdf.checks import check_pose
from radarsdf.io.clouds.reading import read_points
from radarsdf.io.poses.trajectory import read_table

BASE_T_RADAR = "base_T_radar.txt"
"""A file beside scans: 4 x 4, the pose of the radar in the frame that has the poses."""


def base_T_radar(folder: Path) -> NDArray[np.float64]:
    """T_base_radar (4, 4) of ``base_T_radar.txt`` in a folder; the identity if there is none."""
    return read_transform(folder / BASE_T_RADAR, np.eye(4))


def lidar_map(folder: Path) -> NDArray[np.float64] | None:
    """Points (M, 3), world frame, m, of ``lidar.pcd`` or ``lidar.ply``. None if there is neither."""
    found = next((folder / name for name in ("lidar.pcd", "lidar.ply") if (folder / name).is_file()), None)
    return None if found is None else read_points(found)


def read_transform(path: Path, default: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rigid transform (4, 4) from a text file, or the default if there is no file."""
    if not path.is_file():
        return default
    matrix = read_table(path, 4)
    try:
        return check_pose(matrix, "the matrix")
    except ValueError as error:
        msg = f"{path} does not hold a rigid transform: {error}"
        raise ValueError(msg) from error
