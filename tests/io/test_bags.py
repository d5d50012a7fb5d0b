"""Bags of ROS 1 and ROS 2: each kind of message, each source of poses, clocks, several bags, and damaged ones."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from radarsdf.io import read

from ..conftest import pose

pytest.importorskip("rosbags", reason="the extra ros is not installed")


from .bag_writing import KINDS, BagWriter

START_S = 1_700_000_000.0
TIMES_S = START_S + np.arange(5) * 0.1
NO_EXTRINSIC = (
    "no extrinsic is known between the frame of /odom, base_link, and that of the scans, radar: the poses are taken as "
    "those of the radar; give extrinsic if they are not"
)
MOUNTING = pose([0.5, 0.0, 1.0], np.pi / 2)


def moved(time_s):
    """The pose of the base: 1 m/s along x, 0.5 rad/s to the left."""
    return pose([time_s - START_S, 0, 0], 0.5 * (time_s - START_S))


MOVED = np.stack([moved(t) for t in TIMES_S])


def columns(i):
    """i + 1 returns of scan i."""
    ones = np.ones(i + 1, np.float32)
    return {
        "x": i * ones,
        "y": 2 * ones,
        "z": 3 * ones,
        "doppler": -ones,
        "power": 50 + np.arange(i + 1, dtype=np.float32),
    }


def name(folder, kind, stem="drive"):
    return folder / (f"{stem}.bag" if kind == "ros1" else stem)


def scans_and(folder, kind, write_poses, cloud=BagWriter.cloud2, times_s=TIMES_S, **options):
    """A bag of scans in the frame radar, and poses from `write_poses(bag)`, recorded 0.02 s after the stamps."""
    path = name(folder, kind)
    with BagWriter(path, kind) as bag:
        write_poses(bag)
        for i, time_s in enumerate(times_s):
            bag.write("/radar", cloud(bag, time_s, columns(i), **options), time_s + 0.02)
    return path


def odometry(bag):
    for time_s in START_S + np.arange(-1, 12) * 0.05:
        bag.write("/odom", bag.odometry(time_s, moved(time_s)), time_s + 0.001)


def check(scans, poses=MOVED, notes=None):
    for _ in range(2):
        seen = list(scans)
        assert len(seen) == 5
        for i, scan in enumerate(seen):
            assert_array_equal(scan.points, np.column_stack([columns(i)[axis] for axis in "xyz"]))
            assert_array_equal(scan.intensities, columns(i)["power"])
            assert_array_equal(scan.doppler_mps, -1)
    assert_allclose(scans.times_s, TIMES_S, rtol=0, atol=1e-6)
    assert_allclose(scans.poses, poses, rtol=0, atol=1e-4)  # 1 m/s interpolated on a bend
    if notes is not None:
        assert scans.notes == notes


@pytest.mark.parametrize("kind", KINDS)
def test_cloud2_and_odometry(tmp_path, kind):
    path = scans_and(tmp_path, kind, odometry)
    notes = ["poses: 13 of /odom", NO_EXTRINSIC]
    check(read(path), notes=notes)
    check(read(path, extrinsic=MOUNTING), MOVED @ MOUNTING, notes[:1])
    check(read(path, topic="/radar", pose_topic="/odom"))
    if kind != "ros1":  # the file in the folder too
        (file,) = [p for p in path.iterdir() if p.suffix in (".db3", ".mcap")]
        check(read(file))
    check(read(path, fields={"intensity": "Power"}))
    no_doppler = read(path, fields={"doppler": None})
    assert no_doppler.doppler_mps is None


def test_cloud2_in_rows_with_other_types(tmp_path):
    cloud = {
        "rcs": np.array([-3, 4, 5, 6, 7, 8], np.int8), "x": np.arange(6.0), "y": np.arange(6.0), "z": np.arange(6.0),
        "ring": np.arange(6, dtype=np.uint16),
    }  # fmt: skip
    with BagWriter(tmp_path / "a.bag", "ros1") as bag:
        odometry(bag)
        message = bag.cloud2(START_S, cloud, height=2, padding=3, big_endian=True)
        rows = np.asarray(message.data).reshape(2, -1)
        message.data = np.concatenate([np.pad(row, (0, 10)) for row in rows])  # space after each row
        message.row_step += 10
        bag.write("/radar", message, START_S)
    (scan,) = read(tmp_path / "a.bag")
    assert_array_equal(scan.points, np.stack([np.arange(6.0)] * 3, axis=1))
    assert_array_equal(scan.intensities, [-3, 4, 5, 6, 7, 8])


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_cloud_with_channels(tmp_path, kind):
    check(read(scans_and(tmp_path, kind, odometry, BagWriter.cloud)))


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_radar_msgs(tmp_path, kind):
    with BagWriter(name(tmp_path, kind), kind) as bag:
        odometry(bag)
        for i, time_s in enumerate(TIMES_S):
            returns = [[10, 0, 0, -1, 50], [10, np.pi / 2, 0, 2, 60]]
            bag.write("/scan", bag.radar_scan(time_s, returns[: 1 + i % 2]), time_s)
    scans = list(read(name(tmp_path, kind)))
    assert [len(scan) for scan in scans] == [1, 2, 1, 2, 1]
    assert_allclose(scans[1].points, [[10, 0, 0], [0, 10, 0]], atol=1e-5)
    assert_array_equal(scans[1].doppler_mps, [-1, 2])
    assert_array_equal(scans[1].intensities, [50, 60])


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_the_last_path_message_is_used(tmp_path, kind):
    def write(bag):
        for count in (2, 5):  # the second one is corrected
            poses = {t: moved(t) @ pose([5.0 - count, 0, 0]) for t in TIMES_S[:count]}
            bag.write("/path", bag.path(poses), TIMES_S[count - 1])

    check(read(scans_and(tmp_path, kind, write)))


def tree(bag, static_topic="/tf_static", base="base_link"):
    """map -> odom -> base_link -> mast -> radar: the first is constant but published repeatedly."""
    mast = {(base, "mast"): pose([0, 0, 1.0]), ("mast", "radar"): pose([0.5, 0, 0], np.pi / 2)}
    bag.write(static_topic, bag.transforms(START_S - 3, mast), START_S - 3)
    for time_s in START_S + np.arange(-1, 12) * 0.05:
        edges = {("odom", base): moved(time_s), ("map", "odom"): pose([100.0, 0, 0])}
        bag.write("/tf", bag.transforms(time_s, edges), time_s)


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_tree_of_transforms(tmp_path, kind):
    path = scans_and(tmp_path, kind, tree)
    world = pose([100.0, 0, 0])
    check(read(path), world @ MOVED @ MOUNTING, ["poses: TF, map -> odom -> base_link -> mast -> radar"])
    check(read(path, world_frame="odom"), MOVED @ MOUNTING)
    check(read(path, pose_topic="/tf", extrinsic=pose([0, 0, 2.0])), world @ MOVED @ pose([0, 0, 2.0]))
    with pytest.raises(
        ValueError, match="world_frame earth is not above radar, whose frames are radar -> mast"
    ):
        read(path, world_frame="earth")


@pytest.mark.parametrize("stamp_s", [0.0, 12.0])
def test_zero_or_constant_stamps_are_replaced_by_recording_times(tmp_path, stamp_s):
    with BagWriter(tmp_path / "a.bag", "ros1") as bag:
        odometry(bag)
        for i, time_s in enumerate(TIMES_S):
            bag.write("/radar", bag.cloud2(stamp_s, columns(i), "base_link"), time_s)
    why = "are constant" if stamp_s else "are zero"
    scans = read(tmp_path / "a.bag")
    assert scans.notes[0] == f"the header stamps of /radar {why}: the record time is used instead"
    check(scans)
    with pytest.raises(ValueError, match="no scan has a pose"):
        list(read(tmp_path / "a.bag", stamps="header"))


def test_poses_of_a_file(tmp_path):
    path = scans_and(tmp_path, "mcap", lambda _: None)
    with pytest.raises(
        ValueError, match=r"has no poses \(Odometry, PoseStamped, Path or TF\): give a file of poses"
    ):
        read(path)
    rows = [
        f"{t:.6f} {t - START_S:.6f} 0 0 0 0 {np.sin((t - START_S) / 4):.9f} {np.cos((t - START_S) / 4):.9f}"
        for t in TIMES_S
    ]
    (tmp_path / "poses.tum").write_text("\n".join(rows))
    check(read(path, tmp_path / "poses.tum"))
    check(read(path, MOVED))
    with pytest.raises(ValueError, match="5 scans but 3 poses"):
        read(path, MOVED[:3])
    check(read(tmp_path))  # a folder of bags, with a file of poses


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_several_bags(tmp_path, kind):
    """Poses in one, scans in two others; given in any order."""
    paths = [name(tmp_path, kind, stem) for stem in ("b", "c", "a")]
    with BagWriter(paths[0], kind) as bag:
        odometry(bag)
    for path, part in ((paths[1], range(3, 5)), (paths[2], range(3))):
        with BagWriter(path, kind) as bag:
            for i in part:
                bag.write("/radar", bag.cloud2(TIMES_S[i], columns(i)), TIMES_S[i])
    check(read(paths))
    check(read(tmp_path))
    check(read(paths[1:], poses=paths[0]))


def test_ambiguous_choices_are_rejected(tmp_path):
    with BagWriter(tmp_path / "a.bag", "ros1") as bag:
        odometry(bag)
        for topic in ("/left/points", "/right/points"):
            bag.write(topic, bag.cloud2(START_S, columns(1)), START_S)
    with BagWriter(tmp_path / "b.bag", "ros1") as bag:
        for topic in ("/gps", "/slam"):
            for time_s in (START_S - 0.1, START_S + 0.1):
                bag.write(topic, bag.pose_stamped(time_s, np.eye(4)), time_s)
        bag.write("/lidar", bag.cloud2(START_S, columns(1)), START_S)
        bag.write("/front_radar", bag.cloud2(START_S, columns(1)), START_S)  # the radar, by its name
    assert len(read(tmp_path / "a.bag", topic="/right/points")) == 1
    for path, choices, names in (
        ("a.bag", {}, "/left/points"),
        ("a.bag", {"topic": "/up"}, "/up"),
        ("a.bag", {"topic": "/odom"}, "/odom has messages nav_msgs/msg/Odometry"),
        ("a.bag", {"topic": "/left/points", "pose_topic": "/left/points"}, "topics with poses are /odom"),
        ("b.bag", {}, "choose one with pose_topic, of /gps, /slam"),
    ):
        with pytest.raises(ValueError, match=names):
            read(tmp_path / path, **choices)
    with pytest.raises(ValueError, match="is not a bag"):
        read([tmp_path / "a.bag", tmp_path])


@pytest.mark.parametrize("kind", KINDS)
def test_damaged_bags(tmp_path, kind):
    """Truncated bags. Changed bytes are in test_hostile_files.py."""
    path = scans_and(tmp_path, kind, odometry)
    file = path if kind == "ros1" else next(p for p in path.iterdir() if p.suffix in (".db3", ".mcap"))
    whole = file.read_bytes()
    for size in (0, 10, len(whole) // 3):
        file.write_bytes(whole[:size])
        for target in {path, file}:
            with pytest.raises(ValueError, match="is not a complete bag") as error:
                list(read(target))
            assert str(tmp_path) in str(error.value)
    if kind != "ros1":
        file.unlink()
        text = "rosbag2_bagfile_information: !!python/object/apply:os.getcwd []\n"
        (path / "metadata.yaml").write_text(text)
        with pytest.raises(ValueError, match="is not a complete bag"):
            read(path)
