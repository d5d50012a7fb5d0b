# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Files of poses that other programs read."""

from __future__ import annotations

import io
from os import PathLike

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from radarsdf.checks import check_poses, path_of, real_array
from radarsdf.io.files import write_whole

POSE_SUFFIXES = (".tum", ".kitti", ".npy")
"""Of files that :func:`write_poses` writes."""


def check_pose_suffix(path: str | PathLike[str]) -> None:
    """Raises a ValueError for a name that :func:`write_poses` would refuse."""
    if path_of(path, "path").suffix.lower() not in POSE_SUFFIXES:
        msg = f"{path} is no file of poses that can be written: those end in {', '.join(POSE_SUFFIXES)}"
        raise ValueError(msg)


def check_pose_times(path: str | PathLike[str], times_s: ArrayLike | None) -> None:
    """Raises a ValueError if :func:`write_poses` would refuse to write without times."""
    if times_s is None and path_of(path, "path").suffix.lower() == ".tum":
        msg = (
            f"{path} needs times, when each pose was taken, s, and there are none: .kitti and .npy do without"
        )
        raise ValueError(msg)


def write_poses(path: str | PathLike[str], poses: ArrayLike, times_s: ArrayLike | None = None) -> None:
    """Writes a trajectory, whole or not at all.

    Parameters
    ----------
    path : path-like
        The suffix says the format: ``.tum``, lines of ``time x y z qx qy qz qw``; ``.kitti``, lines of twelve numbers, the
        first three rows of each matrix; ``.npy``, the array (F, 4, 4). evo reads the first two.
    poses : (F, 4, 4) array_like
        T_world_sensor, m.
    times_s : (F,) array_like, optional
        s. ``.tum`` needs them; the others have no place for them.

    Raises
    ------
    ValueError
        If the suffix is none of these, poses are no rigid transforms, or times are missing, not finite or not as many.
    OSError
        If the file cannot be written.

    Examples
    --------
    >>> from pathlib import Path
    >>> import numpy as np
    >>> from radarsdf.io import write_poses
    >>> write_poses("poses.tum", [np.eye(4)], [12.5])
    >>> print(Path("poses.tum").read_text().strip())
    12.500000000 0.000000000 0.000000000 0.000000000 0.000000000 0.000000000 0.000000000 1.000000000
    """
    check_pose_suffix(path)
    check_pose_times(path, times_s)
    suffix = path_of(path, "path").suffix.lower()
    matrices = check_poses(poses)
    text = io.BytesIO()
    if suffix == ".npy":
        np.save(text, matrices)
    elif suffix == ".kitti":
        np.savetxt(text, matrices[:, :3].reshape(-1, 12), "%.12g")
    else:
        times_s = real_array(times_s, "times_s")
        if times_s.shape != (len(matrices),) or not np.isfinite(times_s).all():
            msg = f"times_s must be one finite number for each of {len(matrices)} poses, not {times_s.shape}"
            raise ValueError(msg)
        quaternions = Rotation.from_matrix(matrices[:, :3, :3]).as_quat()
        np.savetxt(text, np.column_stack([times_s, matrices[:, :3, 3], quaternions]), "%.9f")
    write_whole(path, text.getvalue())
