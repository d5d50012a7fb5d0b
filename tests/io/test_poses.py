"""Pose files of each format, notes on assumptions, and interpolation."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from radarsdf.io import write_poses
from radarsdf.io.poses import poses_of, read_poses
from radarsdf.scans import Notes

from ..conftest import pose
from ..poses.drift import trajectory

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


def test_kitti_with_calibration(tmp_path):
    """True poses of the sensor are in the frame of the first one; KITTI stores poses of the camera."""
    truth = np.linalg.inv(POSES[0]) @ POSES
    camera = TR @ truth @ np.linalg.inv(TR)
    path = written(tmp_path / "poses.txt", camera[:, :3].reshape(3, 12))
    (tmp_path / "calib.txt").write_text(
        "P0: " + " ".join(["0"] * 12) + "\nTr: " + " ".join(map(repr, TR[:3].ravel().tolist())) + "\n"
    )
    notes = Notes()
    assert_allclose(read_poses(path, notes), truth, atol=1e-12)
    assert "by Tr of calib.txt" in notes.lines[0]
    (tmp_path / "calib.txt").unlink()
    notes = Notes()
    assert_allclose(read_poses(path, notes), camera, atol=1e-12)
    assert "no calib.txt" in notes.lines[0]
    (tmp_path / "calib.txt").write_text("Tr: 1 2 3\n")
    with pytest.raises(ValueError, match=r"calib\.txt is not a KITTI calibration"):
        read_poses(path, Notes())


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "not a table of poses"),
        ("1 2 3\n4 5 6\n", "has 3 columns: poses have 8"),
        ("1 2 3 4 5 6 7 8\n1 2 3\n", "no unit quaternion.*pose 0"),
        ("1 0 0 0 0 0 0 nan\n", "finite"),
        ("1 0 0 0 0 0 0 one\n", "finite"),
        ("1 0 0 0 0 0 0 1\n", "at least two"),
        ("1 0 0 0 0 0 0 2\n2 0 0 0 0 0 0 1\n", "unit quaternion"),
        ("1 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 0\n", "holds 1 poses at different times"),
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


HALF = np.sqrt(0.5)
NAMED = {
    "w first": "timestamp,x,y,z,qw,qx,qy,qz\n{t},1,2,3,{h},0,0,{h}\n",
    "TUM in a comment": "# timestamp tx ty tz qx qy qz qw\n{t} 1 2 3 0 0 {h} {h}\n",
    "index and more": "id;q_z;q_w;q_x;q_y;time;pos_z;pos_y;pos_x;vx\n7;{h};{h};0;0;{t};3;2;1;9\n",
    "EuRoC": "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z [],v_RS_R_x [m s^-1]\n"
    "{t}000000000,1,2,3,{h},0,0,{h},0.5\n",
    "rostopic": "%time,field.header.seq,field.header.stamp,field.header.frame_id,field.pose.pose.position.x,field.pose.pose.position.y,"
    "field.pose.pose.position.z,field.pose.pose.orientation.x,field.pose.pose.orientation.y,field.pose.pose.orientation.z,"
    "field.pose.pose.orientation.w,field.pose.covariance0,field.twist.twist.linear.x\n"
    "{t}500000000,1,{t}000000000,map,1,2,3,0,0,{h},{h},0,0.1\n",
    "seconds and nanoseconds": "secs,nsecs,x,y,z,qx,qy,qz,qw\n{t},0,1,2,3,0,0,{h},{h}\n",
}


@pytest.mark.parametrize("layout", NAMED)
def test_names_decide_what_columns_mean(tmp_path, layout):
    head, row = NAMED[layout].format(h=HALF, t="1700000000").splitlines()
    (tmp_path / "a.csv").write_text("\n".join([head, row, row.replace("1700000000", "1700000001")]))
    found = read_poses(tmp_path / "a.csv", Notes())
    assert found.times_s.tolist() == [1_700_000_000, 1_700_000_001]
    assert_allclose(found.poses(found.times_s), [pose([1.0, 2, 3], np.pi / 2)] * 2, atol=1e-9)


@pytest.mark.parametrize(
    "head",
    [
        "x [mm],y_mm,z (mm),qx,qy,qz,qw,time [min]",
        "p_x/mm,p_y [mm],p_z [mm],q_x [],q_y [],q_z [],q_w [],t(min)",
    ],
)
def test_units_of_named_columns_of_poses(tmp_path, head):
    (tmp_path / "a.csv").write_text(f"{head}\n1000,2000,3000,0,0,0,1,1\n2000,2000,3000,0,0,0,1,2\n")
    found = read_poses(tmp_path / "a.csv", Notes())
    assert_allclose(found.positions, [[1, 2, 3], [2, 2, 3]])
    assert found.times_s.tolist() == [60, 120]
    (tmp_path / "a.csv").write_text((tmp_path / "a.csv").read_text().replace("min", "blink"))
    with pytest.raises(ValueError, match=r"a\.csv.*unit 'blink'"):
        read_poses(tmp_path / "a.csv", Notes())


def test_one_bad_pose_is_left_out_and_named(tmp_path):
    rows = [f"{t} {t} 0 0 0 0 0 1" for t in range(10)]
    rows[2], rows[4], rows[6] = "2 nan 0 0 0 0 0 1", "4 4 0 0 0 0 0 0", "6 6 0 0 0 oops 0 1"
    rows[7], rows[8] = rows[8], rows[7]
    (tmp_path / "a.tum").write_text("# mine\n" + "\n".join([*rows, rows[9], "10 1 2"]))
    notes = Notes()
    assert read_poses(tmp_path / "a.tum", notes).times_s.tolist() == [0, 1, 3, 5, 7, 8, 9]
    assert "5 of 12 poses are left out" in notes.lines[0]
    assert notes.lines[0].endswith("the first: pose 2")
    notes = Notes()
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[1, 0, 3], poses[3, :3, :3] = np.nan, 0
    for given in (poses, written(tmp_path / "k.txt", poses.reshape(5, 16))):
        found = poses_of(given, notes)
        assert np.isfinite(found).all(axis=(1, 2)).tolist() == [True, False, True, False, True]
    assert ["2 of 5 poses" in note and note.endswith("pose 1") for note in notes.lines] == [True, True]
    with pytest.raises(ValueError, match="pose 0 is not"):
        poses_of(np.full((2, 4, 4), np.nan), Notes())


WRITTEN, TIMES = trajectory(7), np.arange(7) * 0.25 + 1.6e9


@pytest.mark.parametrize("name", ["a.tum", "a.kitti", "a.npy"])
def test_poses_come_back(tmp_path, name):
    write_poses(tmp_path / name, WRITTEN, TIMES)
    found = read_poses(tmp_path / name, Notes())
    if not isinstance(found, np.ndarray):
        np.testing.assert_allclose(found.times_s, TIMES)
        found = found.poses(TIMES)
    np.testing.assert_allclose(found, WRITTEN, atol=1e-8)


def test_wrong_arguments_are_refused_and_nothing_is_written(tmp_path):
    with pytest.raises(ValueError, match=r"\.tum, \.kitti, \.npy"):
        write_poses(tmp_path / "a.txt", WRITTEN, TIMES)
    with pytest.raises(ValueError, match="needs times"):
        write_poses(tmp_path / "a.tum", WRITTEN)
    with pytest.raises(ValueError, match="times_s must be"):
        write_poses(tmp_path / "a.tum", WRITTEN, TIMES[:3])
    with pytest.raises(ValueError, match="rigid"):
        write_poses(tmp_path / "a.kitti", 2 * WRITTEN)
    assert list(tmp_path.iterdir()) == []
