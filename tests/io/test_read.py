"""Reading files and folders: scans, their order, their poses, and notes."""

import logging
import tracemalloc

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from radarsdf.io import UNPOSED, Scan, Scans, read, write_poses
from radarsdf.io.npz import read_scans, write_scans

from ..conftest import pose
from .test_folders import radar_cloud, write_pcd

POSES = np.stack([pose([float(i), 2.0, 3.0], 0.1 * i) for i in range(11)])


def clouds(folder, count=11, name="scan_{}.pcd"):
    """Scan i holds i + 1 returns at x = i, with Power and Doppler."""
    for i in range(count):
        xyz = np.column_stack([np.full(i + 1, i), np.arange(i + 1), np.ones(i + 1)])
        cloud = radar_cloud(xyz, Doppler=np.full(i + 1, -i), Power=np.arange(i + 1))
        write_pcd(folder / name.format(i), cloud)
    return folder


def test_a_folder_in_natural_order(tmp_path):
    scans = read(clouds(tmp_path), POSES)
    for _ in range(2):  # it can be iterated again
        seen = list(scans)
        assert [len(scan) for scan in seen] == list(range(1, 12))
    assert isinstance(seen[0], Scan)
    scan = seen[10]
    assert_array_equal(scan.points[:, 0], 10)
    assert scan.points.dtype == np.float32
    assert_array_equal(scan.T_world_sensor, POSES[10])
    assert_array_equal(scan.intensities, np.arange(11))
    assert_array_equal(scan.doppler_mps, -10)
    assert scan.time_s is None
    assert scan.sigma is None
    assert len(scans) == 11
    assert scans.notes == []


def test_reading_is_lazy_and_damaged_scans_are_left_out(tmp_path):
    clouds(tmp_path)
    whole = (tmp_path / "scan_7.pcd").read_bytes()
    scans = read(tmp_path, POSES)
    stream = iter(scans)
    assert [len(next(stream)) for _ in range(3)] == [1, 2, 3]
    for number, data in ((5, b"damaged"), (7, whole[:-2]), (8, b"")):
        (tmp_path / f"scan_{number}.pcd").write_bytes(data)
    assert [len(scan) for scan in stream] == [4, 5, 7, 10, 11]
    assert_array_equal(scans.poses, POSES[[0, 1, 2, 3, 4, 6, 9, 10]])
    (note,) = scans.notes
    assert note.startswith("3 scans left out")
    assert "scan_5.pcd is not a complete .pcd file" in note


def test_scans_of_bad_poses_are_left_out(tmp_path):
    poses = POSES.copy()
    poses[3, 0, 0] = np.nan
    scans = read(clouds(tmp_path), poses)
    assert [len(scan) for scan in scans] == [1, 2, 3, *range(5, 12)]
    assert "1 of 11 poses" in scans.notes[0]
    assert scans.notes[0].endswith("pose 3")
    write_scans(tmp_path / "a.npz", Scans([np.ones((1, 3))] * 11, poses))
    scans = read(tmp_path / "a.npz")
    assert len(scans) == 10
    assert "1 of 11 poses" in scans.notes[0]


def test_memory_is_that_of_a_scan(tmp_path):
    for i in range(30):
        np.save(tmp_path / f"{i}.npy", np.ones((50_000, 4), np.float32))  # 0.8 MB
    scans = read(tmp_path, np.tile(np.eye(4), (30, 1, 1)))
    next(iter(scans))  # which imports what it needs
    tracemalloc.start()
    assert sum(len(scan) for scan in scans) == 30 * 50_000
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 6e6  # of 24 MB in all


def test_scans_outside_of_the_poses_and_in_gaps_are_counted(tmp_path):
    clouds(tmp_path, 8, "{}.0.pcd")
    rows = [f"{t} {t} 0 0 0 0 0 1" for t in (1, 2, 3, 6, 7)]
    (tmp_path / "poses.txt").write_text("\n".join(rows))
    scans = read(tmp_path, max_gap_s=1.5)
    assert scans.times_s.tolist() == [1, 2, 3, 6, 7]
    assert [note.split(":")[0] for note in scans.notes[1:]] == ["3 scans left out"]
    assert [len(s) for s in scans] == [2, 3, 4, 7, 8]
    assert len(scans.notes) == 2
    assert read(tmp_path, max_gap_s=3).times_s.tolist() == [1, 2, 3, 4, 5, 6, 7]
    (tmp_path / "poses.txt").write_text("100 0 0 0 0 0 0 1\n101 0 0 0 0 0 0 1\n")
    with pytest.raises(ValueError, match=r"at 0\.0 s, poses from 100\.0 to 101\.0 s"):
        len(read(tmp_path))


def test_what_is_not_finite_is_dropped_and_counted(tmp_path, caplog):
    nan, inf = np.nan, np.inf
    np.save(tmp_path / "0.npy", [[1, 2, 3, 4], [nan, 2, 3, 4], [1, inf, 3, 4], [1, 2, 3, nan]])
    np.save(tmp_path / "1.npy", [[nan, 2, 3, 4.0]])
    np.save(tmp_path / "2.npy", np.zeros((0, 4)))
    np.save(tmp_path / "3.npy", [[5, 6, 7, 8.0]])
    scans = read(tmp_path, POSES[:4])
    with caplog.at_level(logging.WARNING, "radarsdf.io"):
        assert [scan.points.tolist() for scan in scans] == [[[1, 2, 3]], [[5, 6, 7]]]
    assert caplog.messages == scans.notes
    assert scans.notes == [
        "4 returns left out: a coordinate or the intensity is not a finite number",
        "2 scans left out: they hold no returns",
    ]
    assert_array_equal(scans.poses, POSES[[0, 3]])


def test_what_cannot_be_read_is_named(tmp_path):
    clouds(tmp_path / "scans", 3)
    (tmp_path / "empty").mkdir()
    (tmp_path / "scans.h5").write_bytes(b"HDF")
    (tmp_path / "poses.tum").write_text("".join(f"{t} 0 0 0 0 0 0 1\n" for t in range(3)))
    for path, poses, error, names in (
        (tmp_path / "scans", POSES[:2], ValueError, "3 scans but 2 poses"),
        (tmp_path / "empty", POSES[:2], ValueError, "empty holds no scans"),
        (tmp_path / "nowhere", POSES[:2], FileNotFoundError, "nowhere does not exist"),
        (tmp_path / "scans", tmp_path / "poses.txt", FileNotFoundError, r"poses\.txt does not exist"),
        (tmp_path / "scans.h5", POSES[:2], ValueError, r"scans\.h5 is of no kind"),
    ):
        with pytest.raises(error, match=names):
            read(path, poses)
    scans = read(tmp_path)
    assert any("matched to the 3 poses in their order" in note for note in scans.notes)
    assert scans.times_s.tolist() == [0, 1, 2]


def test_poses_that_are_given_win_over_those_of_an_npz(tmp_path):
    points = [np.full((2, 3), float(i)) for i in range(4)]
    times_s = np.array([0.0, 0.1, 7.0, 7.1])
    scans = Scans(points, POSES[:4], times_s=times_s, ground_truth=np.zeros((1, 3)))
    path = tmp_path / "scans.npz"
    write_scans(path, scans)
    others = np.stack([pose([0, i, 0], 0.1 * i) for i in range(3)])
    # Poses of the first three, with rounded times, next to a gap too long for interpolation.
    write_poses(tmp_path / "found.tum", others, times_s[:3] + 4e-4)
    again = read(path, tmp_path / "found.tum")
    assert_allclose(again.poses, others, rtol=0, atol=0.01)
    assert_allclose(again.times_s, times_s[:3])
    assert [scan.points[0, 0] for scan in again] == [0, 1, 2]
    assert again.ground_truth is None
    assert "in place of those in scans.npz, without its ground truth" in again.notes[0]
    assert again.notes[1].startswith("1 scans left out: no poses within")
    mounting = pose([0.5, 0, 1], np.pi / 2)
    assert_allclose(read(path, POSES[1:5], extrinsic=mounting).poses, POSES[1:5] @ mounting)
    assert read(path, POSES[1:5], ground_truth=np.ones((2, 3))).ground_truth.shape == (2, 3)
    np.save(tmp_path / "lidar.npy", np.full((5, 3), 2.0))
    assert_allclose(read(path, ground_truth=tmp_path / "lidar.npy").ground_truth, np.full((5, 3), 2.0))
    with pytest.raises(ValueError, match="there are 4 scans but 2 poses"):
        read(path, POSES[:2])
    with pytest.raises(ValueError, match="extrinsic would have no effect"):
        read(path, extrinsic=mounting)


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


@pytest.mark.parametrize("mounted", [True, False])
def test_radars_and_mountings_are_kept(tmp_path, mounted):
    """Poses that are given are those of the body, as those of the file."""
    mountings = {"rear": pose([-1, 0, 0], np.pi), "front": pose([2, 0, 1], 0.3)} if mounted else None
    labels = ["front", "rear", "front"]
    points = [np.full((2, 3), i + 1.0) for i in range(3)]
    scans = Scans(points, POSES[:3], sensors=labels, T_body_sensor=mountings)
    write_scans(tmp_path / "rig.npz", scans)
    path = tmp_path / "rig.npz"
    for again in (read_scans(path), read(path), read(path, POSES[:3])):
        assert (again.sensors, [scan.sensor for scan in again]) == (labels, labels)
        assert_allclose(again.poses, POSES[:3], atol=1e-12)
        assert_allclose(again.sensor_poses, scans.sensor_poses, atol=1e-12)
        assert (again.T_body_sensor or {}).keys() == (mountings or {}).keys()
    write_poses(tmp_path / "body.tum", POSES[:3], np.arange(3.0))
    timed = Scans(points, POSES[:3], times_s=np.arange(3.0), sensors=labels, T_body_sensor=mountings)
    write_scans(tmp_path / "rig.npz", timed)
    again = read(tmp_path / "rig.npz", tmp_path / "body.tum")
    assert_allclose(again.sensor_poses, scans.sensor_poses, atol=1e-6)


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
        {"sensor": np.zeros(5, int)},
        {"sensor": np.full(5, 2), "sensor_labels": np.array(["front", "rear"])},
        {"sensor": np.zeros(5, int), "sensor_labels": np.arange(2)},
        {"sensor": np.zeros(5, int), "sensor_labels": np.array(["a"]), "T_body_sensor": np.ones((1, 4, 4))},
        {"T_body_sensor": np.eye(4)[None]},
    ],
    ids=str,
)
def test_arrays_that_do_not_fit(tmp_path, changes):
    path = written(tmp_path, **changes)
    with pytest.raises(ValueError, match=r"."):
        read_scans(path)


def test_arguments_without_effect_are_refused_or_noted(tmp_path):
    folder = clouds(tmp_path / "scans", 3)
    write_scans(tmp_path / "a.npz", Scans([np.ones((1, 3))] * 3, POSES[:3]))
    (tmp_path / "a.csv").write_text("x,y,z,range\n1,2,3,4\n")
    for path, options in (
        (folder, {"columns": 4}), (folder, {"topic": "/radar"}), (folder, {"R_sensor_imu": np.eye(3)}),
        (tmp_path / "a.npz", {"columns": 4}), (tmp_path / "a.npz", {"R_sensor_imu": np.eye(3)}),
        (folder, {"poses": UNPOSED, "extrinsic": np.eye(4)}),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=f"{list(options)[-1]} would have no effect"):
            read(path, **({"poses": POSES[:3]} | options))
    for options in ({"columns": 4}, {"fields": {"range": "range"}}):
        with pytest.raises(ValueError, match=r"columns|range"):
            len(read(tmp_path / "a.csv", POSES[:1], **options))
    assert any("max_gap_s" in note for note in read(folder, POSES[:3], max_gap_s=1.0).notes)
