# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Scan files: what is read, what is left out, and what is refused."""

import numpy as np
import pytest
from radarsdf.io.npz import read_scans, write_scans
from radarsdf.scans import Scans

from ..conftest import pose


def arrays():
    return {
        "points": np.arange(18, dtype=np.float32).reshape(6, 3),
        "frame": np.array([2, 0, 2, 0, 3, 0], np.int32),
        "poses": np.stack([pose([float(i), 0, 0]) for i in range(5)]),
        "intensity": np.arange(6, dtype=np.float32) * 10,
        "static": np.array([1, 1, 0, 1, 0, 1], bool),
        "lidar_points": np.ones((4, 3)),
    }


def written(tmp_path, **changes):
    path = tmp_path / "scans.npz"
    np.savez(path, **{k: v for k, v in (arrays() | changes).items() if v is not None})
    return path


def test_static_returns_by_frame(tmp_path):
    scans = read_scans(written(tmp_path))
    # Frame 3's only return moves; 1 and 4 never had one.
    np.testing.assert_array_equal(scans.poses[:, 0, 3], [0, 2])
    assert [s[:, 0].tolist() for s in scans.points] == [[3, 9, 15], [0]]
    assert [v.tolist() for v in scans.intensities] == [[10, 30, 50], [0]]
    assert scans.poses.dtype == np.float64
    assert scans.ground_truth.shape == (4, 3)


@pytest.mark.parametrize("with_intensity", [True, False])
def test_what_is_written_is_read(tmp_path, with_intensity):
    rng = np.random.default_rng(0)
    points = [rng.normal(size=(n, 3)) for n in (4, 1, 3)]
    intensities = [rng.normal(size=len(p)) for p in points] if with_intensity else None
    poses = np.stack([pose([5.4e6 + i / 3, 0, 0], i) for i in range(3)])
    scans = Scans(points, poses, intensities, rng.normal(size=(5, 3)) if with_intensity else None)
    write_scans(tmp_path / "scans.npz", scans)
    again = read_scans(tmp_path / "scans.npz")
    np.testing.assert_array_equal(again.poses, poses)
    for i in range(3):
        np.testing.assert_array_equal(again.points[i], points[i])
        if with_intensity:
            np.testing.assert_array_equal(again.intensities[i], intensities[i])
    assert (again.ground_truth is None) == (not with_intensity)
    part = again.select(np.array([2, 0]))
    assert [len(p) for p in part.points] == [3, 4]
    np.testing.assert_array_equal(part.poses, poses[[2, 0]])
    assert (part.intensities is None) == (not with_intensity)


@pytest.mark.parametrize(
    "changes",
    [
        {"frame": None},
        {"intensity": np.zeros(7)},
        {"static": np.ones((6, 1), bool)},
        {"frame": np.array([0, 0, 0, 0, 0, 5], np.int32)},
        {"frame": np.array([0, 0, 0, 0, 0, np.nan])},
        {"frame": np.array([0, 0, 0, 0, 0, 0.5])},
        {"frame": np.array(list("abcdef"))},
        {"points": np.array([{}] * 6, object)},
    ],
    ids=str,
)
def test_arrays_that_do_not_fit(tmp_path, changes):
    path = written(tmp_path, **changes)
    with pytest.raises(ValueError, match=r"."):
        read_scans(path)


@pytest.mark.parametrize("keep", [0, 3, 100, -30])
def test_truncated_files(tmp_path, keep):
    path = written(tmp_path)
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(ValueError, match=r"scans\.npz"):
        read_scans(path)
