# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Files of poses in each format, what was assumed of them, and interpolation."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from radarsdf.io.poses.reading import TransformChain, poses_of, read_poses
from radarsdf.io.poses.trajectory import Trajectory
from radarsdf.io.scans import Notes
from scipy.spatial.transform import Rotation

from ..conftest import pose

POSES = np.stack([pose([i, 2.0, 3.0], 0.1 * i) for i in range(3)])
# A camera looks along z, its x to the right: the sensor looks along x, its y to the left. It is 0.2 m behind and above.
TR = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0.2], [1, 0, 0, -0.2], [0, 0, 0, 1]])


def written(path, rows):
    path.write_text("\n".join(" ".join(repr(float(x)) for x in row) for row in rows) + "\n")
    return path


@pytest.mark.parametrize("shape", [(3, 16), (12, 4)])
def test_matrices(tmp_path, shape):
    notes = Notes()
    assert_allclose(read_poses(written(tmp_path / "poses.txt", POSES.reshape(shape)), notes), POSES)
    assert notes.lines == []


def test_array(tmp_path):
    np.save(tmp_path / "poses.npy", POSES)
    assert_allclose(read_poses(tmp_path / "poses.npy", Notes()), POSES)
    np.save(tmp_path / "poses.npy", POSES[0])
    with pytest.raises(ValueError, match=r"poses\.npy must hold poses \(F, 4, 4\)"):
        read_poses(tmp_path / "poses.npy", Notes())
    (tmp_path / "poses.npy").write_bytes(b"\x93NUMPY")
    with pytest.raises(ValueError, match=r"not a whole \.npy file"):
        read_poses(tmp_path / "poses.npy", Notes())


def test_kitti_with_calibration(tmp_path):
    """The truth are poses of the sensor in the frame of the first one; KITTI stores those of the camera."""
    truth = np.linalg.inv(POSES[0]) @ POSES
    camera = TR @ truth @ np.linalg.inv(TR)
    path = written(tmp_path / "poses.txt", camera[:, :3].reshape(3, 12))
    (tmp_path / "calib.txt").write_text(
        "P0: " + " ".join(["0"] * 12) + "\nTr: " + " ".join(map(repr, TR[:3].ravel().tolist())) + "\n"
    )
    notes = Notes()
    assert_allclose(read_poses(path, notes, [tmp_path / "calib.txt"]), truth, atol=1e-12)
    assert len(notes.lines) == 1
    assert "T_world_sensor = inv(Tr) P Tr" in notes.lines[0]
    notes = Notes()
    assert_allclose(read_poses(path, notes, [tmp_path / "none.txt"]), camera, atol=1e-12)
    assert "no calibration Tr" in notes.lines[0]
    (tmp_path / "calib.txt").write_text("Tr: 1 2 3\n")
    with pytest.raises(ValueError, match=r"calib\.txt is not a KITTI calibration"):
        read_poses(path, Notes(), [tmp_path / "calib.txt"])


@pytest.mark.parametrize("separator", [" ", ", ", ","])
def test_tum(tmp_path, separator):
    rows = [[10, 1, 2, 3, 0, 0, 0, 1], [10.2, 2, 2, 3, 0, 0, 1, 0]]
    header = "timestamp,x,y,z,qx,qy,qz,qw\n" if "," in separator else "# time x y z\n"
    (tmp_path / "a.tum").write_text(header + "\n".join(separator.join(map(str, row)) for row in rows))
    trajectory = read_poses(tmp_path / "a.tum", Notes())
    assert isinstance(trajectory, Trajectory)
    assert_allclose(trajectory.pose_at(10.1, 0.5), pose([1.5, 2, 3], np.pi / 2), atol=1e-12)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "not a table of poses"),
        ("1 2 3\n4 5 6\n", "has 3 columns: poses have 8"),
        ("1 2 3 4 5 6 7 8\n1 2 3\n", "not a table of poses"),
        ("1 0 0 0 0 0 0 nan\n", "finite"),
        ("1 0 0 0 0 0 0 one\n", "not a table of poses"),
        ("1 0 0 0 0 0 0 1\n", "at least two poses"),
        ("1 0 0 0 0 0 0 2\n2 0 0 0 0 0 0 1\n", "unit quaternions"),
        ("2 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", "order of their times"),
        (" ".join(["1"] * 12), "rigid"),
        (" ".join(["1"] * 16), "rigid"),
        ("\x00\x01", "not a table of poses"),
    ],
)
def test_damaged_files(tmp_path, text, message):
    (tmp_path / "poses.txt").write_text(text)
    with pytest.raises(ValueError, match=message) as error:
        read_poses(tmp_path / "poses.txt", Notes())
    assert str(tmp_path / "poses.txt") in str(error.value)


def test_poses_as_users_give_them(tmp_path):
    assert_allclose(poses_of(POSES.tolist(), Notes()), POSES)
    assert_allclose(poses_of(str(written(tmp_path / "a.txt", POSES.reshape(3, 16))), Notes()), POSES)
    chain = TransformChain((POSES[1],))
    assert poses_of(chain, Notes()) is chain
    with pytest.raises(ValueError, match=r"must be \(F, 4, 4\) T_world_sensor"):
        poses_of(np.eye(4), Notes())
    with pytest.raises(ValueError, match="pose 1 is not a rigid transform"):
        poses_of([np.eye(4), np.ones((4, 4))], Notes())


def test_one_time_of_many_is_as_all_of_them():
    rng = np.random.default_rng(0)
    times_s = 1.7e9 + np.cumsum(rng.uniform(0.05, 0.4, 50))
    trajectory = Trajectory(times_s, rng.normal(size=(50, 3)), Rotation.random(50, random_state=0))
    wanted = np.concatenate([rng.uniform(times_s[0], times_s[-1], 40), times_s[[0, 7, -1]]])
    expected = trajectory.poses(wanted, 1.0)
    assert_allclose([trajectory.pose_at(t, 1.0) for t in wanted], expected, atol=1e-9)
    assert trajectory.pose_at(times_s[0] - 0.01, 1.0) is None
    assert trajectory.pose_at(times_s[-1] + 0.01, 1.0) is None
    assert_allclose(trajectory.pose_at(times_s[-1] + 4e-4, 1.0), expected[-1], atol=1e-9)  # times are rounded
    assert trajectory.pose_at((times_s[3] + times_s[4]) / 2, 0.01) is None
    chain = TransformChain((POSES[1], trajectory, POSES[2]))
    assert_allclose(chain.pose_at(wanted[0], 1.0), POSES[1] @ expected[0] @ POSES[2], atol=1e-9)
    assert chain.pose_at(0.0, 1.0) is None
    assert chain.span() == trajectory.span()
