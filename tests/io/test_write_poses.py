# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Poses written are those that are read again, here and by evo; scans without poses are read as such."""

import numpy as np
import pytest
from radarsdf.io import write_poses
from radarsdf.io.poses import read_poses
from radarsdf.scans import Notes

from ..poses.drift import trajectory

POSES, TIMES = trajectory(7), np.arange(7) * 0.25 + 1.6e9


@pytest.mark.parametrize("name", ["a.tum", "a.kitti", "a.npy"])
def test_poses_come_back(tmp_path, name):
    write_poses(tmp_path / name, POSES, TIMES)
    found = read_poses(tmp_path / name, Notes())
    if not isinstance(found, np.ndarray):
        np.testing.assert_allclose(found.times_s, TIMES)
        found = found.poses(TIMES)
    np.testing.assert_allclose(found, POSES, atol=1e-8)


def test_wrong_arguments_are_refused_and_nothing_is_written(tmp_path):
    with pytest.raises(ValueError, match=r"\.tum, \.kitti, \.npy"):
        write_poses(tmp_path / "a.txt", POSES, TIMES)
    with pytest.raises(ValueError, match="needs times"):
        write_poses(tmp_path / "a.tum", POSES)
    with pytest.raises(ValueError, match="times_s must be"):
        write_poses(tmp_path / "a.tum", POSES, TIMES[:3])
    with pytest.raises(ValueError, match="rigid"):
        write_poses(tmp_path / "a.kitti", 2 * POSES)
    assert list(tmp_path.iterdir()) == []
