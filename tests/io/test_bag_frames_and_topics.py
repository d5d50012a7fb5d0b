"""Bags of several sensors: frames of messages, the topic of poses, and damaged messages."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from radarsdf.io import NoPoses, read, write_poses

from ..conftest import pose

pytest.importorskip("rosbags", reason="the extra ros is not installed")

from .bag_writing import BagWriter
from .test_bags import MOUNTING, START_S, moved, odometry

TIMES_S = START_S + np.arange(10) * 0.1
POINT = {"x": [5.0], "y": [0.0], "z": [0.0], "doppler": [-1.0]}
REAR = pose([0.0, 0.0, 0.0], np.pi)


def straight(time_s):
    return pose([time_s - START_S, 0, 0])


def tf(bag, edges, moving=straight, times_s=TIMES_S):
    """odom -> base moves, and the `edges` are constant."""
    bag.write("/tf_static", bag.transforms(START_S, edges), START_S - 1)
    for time_s in times_s:
        bag.write("/tf", bag.transforms(time_s, {("odom", "base"): moving(time_s)}), time_s)


def clouds(bag, topic="/radar", frame="radar", times_s=TIMES_S, cloud=POINT):
    for time_s in times_s:
        bag.write(topic, bag.cloud2(time_s, cloud, frame), time_s)


def bag_of(tmp_path, *parts, kind="mcap"):
    """A bag that each of `parts` writes to."""
    path = tmp_path / ("drive.bag" if kind == "ros1" else "drive")
    with BagWriter(path, kind) as bag:
        for part in parts:
            part(bag)
    return path


def seen(scans):
    """Returns of the scans in the world, in the order of time."""
    return [scan.world_points[0].round(3).tolist() for scan in scans]


EDGES = {("base", "front"): np.eye(4), ("base", "rear"): REAR}


def test_each_message_has_the_pose_of_its_own_frame(tmp_path):
    path = bag_of(
        tmp_path,
        lambda bag: tf(bag, EDGES),
        lambda bag: clouds(bag, frame="front", times_s=TIMES_S[:4]),
        lambda bag: clouds(bag, frame="rear", times_s=TIMES_S[4:8]),
        lambda bag: clouds(bag, frame="unknown", times_s=TIMES_S[8:]),
    )
    scans = read(path)
    front = [[5 + 0.1 * i, 0, 0] for i in range(4)]
    assert_allclose(seen(scans), front + [[0.1 * i - 5, 0, 0] for i in range(4, 8)], atol=1e-3)
    assert "2 scans left out: no poses lead to their frame, unknown" in scans.notes


@pytest.mark.parametrize("poses", ["odometry", "file"])
def test_several_topics_are_merged_by_time(tmp_path, poses):
    """The rear radar has other fields."""

    def rear(bag):
        clouds(bag, "/rear", "rear", TIMES_S + 0.03, {"x": [5.0], "y": [0.0], "z": [0.0], "rcs": [3.0]})

    def odom(bag):
        if poses == "odometry":
            for time_s in np.append(TIMES_S, TIMES_S[-1] + 0.1):
                bag.write("/odom", bag.odometry(time_s, straight(time_s), child="base"), time_s)
        bag.write("/tf_static", bag.transforms(START_S, EDGES), START_S - 1)

    path = bag_of(tmp_path, odom, lambda bag: clouds(bag, "/front", "front"), rear)
    rows = [f"{t:.6f} {t - START_S:.6f} 0 0 0 0 0 1" for t in np.append(TIMES_S, TIMES_S[-1] + 0.1)]
    (tmp_path / "base.tum").write_text("\n".join(rows))
    scans = read(path, None if poses == "odometry" else tmp_path / "base.tum", topic=["/front", "/rear"])
    assert len(scans) == 20
    assert (np.diff(scans.times_s) > 0).all()
    assert_allclose(np.array(seen(scans))[::2, 0], 5 + 0.1 * np.arange(10), atol=1e-3)
    assert_allclose(np.array(seen(scans))[1::2, 0], 0.1 * np.arange(10) + 0.03 - 5, atol=1e-3)
    assert [scan.intensities is None for scan in scans][:2] == [True, False]
    with pytest.raises(ValueError, match="no topic /up"):
        read(path, topic=["/front", "/up"])


@pytest.mark.parametrize("topic", ["/robotGoalPose", "/initialpose", "/mavros/setpoint_position/local"])
def test_goals_are_no_poses_of_the_sensor(tmp_path, topic):
    """Even if they are as dense as the scans."""

    def goals(bag):
        for time_s in TIMES_S:
            bag.write(topic, bag.pose_stamped(time_s, pose([50.0, 3, 0])), time_s)

    path = bag_of(tmp_path, lambda bag: tf(bag, {("base", "radar"): MOUNTING}), clouds, goals)
    scans = read(path)
    assert_allclose(scans.poses[0], MOUNTING, atol=1e-9)
    assert any(note.startswith(f"poses of {topic} are ignored") for note in scans.notes)
    assert read(path, pose_topic=topic).poses[0, 0, 3] == 50.5  # what is asked for is read
    with pytest.raises(NoPoses, match="has no poses"):
        read(bag_of(tmp_path, clouds, goals, kind="ros1"))


def test_sparse_or_unrelated_poses_are_ignored(tmp_path):
    def others(bag):
        for time_s in START_S + np.arange(-2, 5) * 0.5:  # corrections
            bag.write("/amcl_pose", bag.pose_stamped(time_s, pose([70.0, 0, 0])), time_s)
        for time_s in TIMES_S[3:5]:
            bag.write("/short", bag.pose_stamped(time_s, pose([80.0, 0, 0])), time_s)
        for time_s in TIMES_S:
            bag.write("/tag", bag.pose_stamped(time_s, pose([2.0, 0, 0]), "base"), time_s)  # of an object
            bag.write("/person", bag.pose_stamped(time_s, pose([10 * (time_s - START_S), 0, 0])), time_s)
            bag.write("/leader", bag.odometry(time_s, pose([90.0, 0, 0]), "odom", "leader"), time_s)
            plan = {time_s: pose([1.0, 0, 0])}  # without stamps
            message = bag.path({**plan, time_s + 1: pose([2.0, 0, 0])})
            for stamped in message.poses:
                stamped.header.stamp.sec = stamped.header.stamp.nanosec = 0
            bag.write("/route", message, time_s)

    path = bag_of(tmp_path, lambda bag: tf(bag, {("base", "radar"): MOUNTING}), clouds, others)
    scans = read(path)
    assert_allclose(scans.poses[0], MOUNTING, atol=1e-9)
    passed = [note.split()[2] for note in scans.notes if note.startswith("poses of")]
    assert passed == ["/amcl_pose", "/leader", "/person", "/route", "/short", "/tag"]


@pytest.mark.parametrize("which", ["mocap", "path", "odom"])
def test_topics_without_a_frame_have_poses_of_the_base(tmp_path, which):
    """They have no frame name; the base moves with the radar."""

    def write(bag):
        bag.write("/tf_static", bag.transforms(START_S, {("base", "radar"): MOUNTING}), START_S - 1)
        dense_s = START_S + np.arange(-5, 55) * 0.02
        for time_s in dense_s:
            if which == "mocap":
                bag.write("/vrpn/robot/pose", bag.pose_stamped(time_s, moved(time_s), "world"), time_s)
            if which == "odom":
                bag.write("/wheel/odom", bag.odometry(time_s, moved(time_s), child="base"), time_s)
        if which == "path":
            bag.write("/slam/path", bag.path({t: moved(t) for t in dense_s}), dense_s[-1])

    scans = read(bag_of(tmp_path, write, clouds))
    assert_allclose(scans.poses, [moved(t) @ MOUNTING for t in TIMES_S], atol=1e-3)
    assert any(note.startswith("poses: 60 of") for note in scans.notes)


@pytest.mark.parametrize("other", ["as good", "constant", "short"])
def test_the_parent_frame_with_poses_is_used(tmp_path, other):
    short_s = START_S + np.arange(50) * 0.002
    times_s = {"as good": TIMES_S, "constant": TIMES_S.repeat(3), "short": short_s}[other]

    def second(bag):
        for time_s in times_s:
            T_parent_base = pose([7.0, 0, 0]) if other == "constant" else straight(time_s).copy()
            T_parent_base[:3, 3] *= 1000 if other == "short" else 1  # far, but not for long
            bag.write("/tf", bag.transforms(time_s, {("camera_init", "base"): T_parent_base}), time_s)

    scans = read(bag_of(tmp_path, lambda bag: tf(bag, {("base", "radar"): MOUNTING}), second, clouds))
    assert_allclose(scans.poses, [straight(t) @ MOUNTING for t in TIMES_S], atol=1e-6)
    assert any("several parents in TF" in note and "odom is used" in note for note in scans.notes)


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
@pytest.mark.parametrize("number", [0, 6])
def test_a_damaged_message_is_skipped_and_named(tmp_path, kind, number):
    def write(bag):
        odometry(bag)
        for i, time_s in enumerate(TIMES_S[:5].repeat(2)[:10]):
            message = bag.cloud2(time_s + 0.01 * (i % 2), POINT)
            if i == number:
                message.data = message.data[:5]
            if i == 8:  # a scan without returns
                message.width, message.data = 0, message.data[:0]
            bag.write("/radar", message, time_s + 0.01 * (i % 2))

    scans_path = bag_of(tmp_path, write, kind=kind)
    scans = read(scans_path)
    assert len(scans) == 8
    (note,) = (note for note in scans.notes if note.startswith("messages left out: 1 of 10"))
    assert f"message {number} of /radar, at" in note
    assert "1 scans left out: they hold no returns" in scans.notes
    in_order = read(scans_path, [pose([i, 0, 0]) for i in range(10)])  # still one for each message
    assert in_order.poses[:, 0, 3].tolist() == [i for i in range(10) if i not in (8, number)]


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
@pytest.mark.parametrize("source", ["tf", "odometry"])
def test_a_static_transform_holds_from_its_publication_on(tmp_path, kind, source):
    mountings = [pose([1, 0, 0.5]), pose([1, 0.5, 0.5], 0.2)]
    path = tmp_path / ("a.bag" if kind == "ros1" else "a")
    with BagWriter(path, kind) as bag:
        for i in range(10):
            stamp_s = 100 + i / 10
            if i in (0, 3, 5):
                static = bag.transforms(0.0, {("base", "radar"): mountings[i >= 5]})
                bag.write("/tf_static", static, stamp_s - 0.01)
            if source == "tf":
                bag.write("/tf", bag.transforms(stamp_s, {("odom", "base"): pose([i, 0, 0])}), stamp_s)
            else:
                bag.write("/odom", bag.odometry(stamp_s, pose([i, 0, 0]), child="base"), stamp_s)
            bag.write("/radar", bag.cloud2(stamp_s, dict.fromkeys("xyz", np.ones(1))), stamp_s + 0.01)
    scans = read(path)
    assert_allclose(scans.poses, [pose([i, 0, 0]) @ mountings[i >= 5] for i in range(10)], atol=1e-6)
    assert any("changes 1 times" in note for note in scans.notes)


@pytest.mark.parametrize("moves", [False, True])
def test_rare_corrections_hold_until_the_next_one(tmp_path, moves):
    """A frame that moves more than those below it, such as a ship under a turning radar, is no correction."""
    with BagWriter(tmp_path / "a.bag", "ros1") as bag:
        for i in range(31):
            stamp_s = 100 + i / 10
            base = pose([0, 0, 0], i / 5) if moves else pose([i, 0, 0])
            edges = {("odom", "radar"): base}
            if i % 10 == 0:
                edges[("map", "odom")] = pose([i if moves else i / 100, 0, 0])
            bag.write("/tf", bag.transforms(stamp_s, edges), stamp_s)
            bag.write("/radar", bag.cloud2(stamp_s, dict.fromkeys("xyz", np.ones(1))), stamp_s + 0.01)
    scans = read(tmp_path / "a.bag")
    held = any("the last one before a scan holds" in note for note in scans.notes)
    assert (len(scans), held) == ((4, False) if moves else (31, True))
    if not moves:
        assert_allclose(scans.poses[:, 0, 3], [i + i // 10 / 10 for i in range(31)], atol=1e-6)


def test_single_zero_stamps_are_replaced(tmp_path):
    with BagWriter(tmp_path / "a.bag", "ros1") as bag:
        for i in range(14):
            stamp_s = 100 + i / 10
            for topic, message in (("/tf", bag.transforms), ("/radar", bag.cloud2)):
                content = (
                    {("odom", "radar"): pose([i, 0, 0])}
                    if topic == "/tf"
                    else dict.fromkeys("xyz", np.ones(1))
                )
                zero = i in ((4, 12) if topic == "/radar" else (0, 7))
                bag.write(topic, message(0.0 if zero else stamp_s, content), stamp_s + 0.25)
    scans = read(tmp_path / "a.bag")
    assert_allclose(scans.poses[:, 0, 3], np.arange(14), atol=1e-4)
    assert sum("are zero" in note for note in scans.notes) == 2


def test_fields_without_a_role_may_have_any_type(tmp_path):
    with BagWriter(tmp_path / "a.bag", "ros1") as bag:
        message = bag.cloud2(100.0, dict.fromkeys("xyz", np.ones(2, np.float32)))
        for fields in ((12, 99, 1), (12, 7, 0), (400, 7, 1), (0, 0, 0)):
            message.fields.append(bag.make("sensor_msgs/msg/PointField", f"f{len(message.fields)}", *fields))
        bag.write("/radar", message, 100.0)
    assert_allclose(read(tmp_path / "a.bag", [np.eye(4)]).points, np.ones((1, 2, 3)))


LEVER = {("base", "front"): pose([2.0, 0, 0.5]), ("base", "rear"): pose([-1.0, 0.3, 0], np.pi)}


def turning(time_s):
    return pose([time_s - START_S, 0, 0], 0.5 * (time_s - START_S))


def rig_bag(tmp_path, edges=LEVER, topics=("/front", "/rear"), frames=("front", "rear")):
    def imu(bag):
        for time_s in np.append(TIMES_S, TIMES_S[-1] + 0.1):
            bag.write("/imu", bag.imu(time_s, [0, 0, 0.5], [0, 0, 9.81], "base"), time_s)

    def odom(bag):
        bag.write("/tf_static", bag.transforms(START_S, edges), START_S - 1)
        for time_s in np.append(TIMES_S, TIMES_S[-1] + 0.1):
            bag.write("/odom", bag.odometry(time_s, turning(time_s), child="base"), time_s)

    parts = [odom, imu]
    for i, (topic, frame) in enumerate(zip(topics, frames, strict=True)):
        parts.append(lambda bag, i=i, t=topic, f=frame: clouds(bag, t, f, TIMES_S + 0.03 * i))
    return bag_of(tmp_path, *parts)


@pytest.mark.parametrize("topics", [("/front", "/rear"), ("/radar", "/radar")])
def test_several_radars_are_labelled_and_mounted_on_the_body(tmp_path, topics):
    """By their topics, or by their frames in one topic."""
    scans = read(rig_bag(tmp_path, topics=topics), topic=list(dict.fromkeys(topics)))
    front, rear = topics if topics[0] != topics[1] else ("front", "rear")
    assert scans.sensors == [front, rear] * 10
    assert_allclose([scans.T_body_sensor[front], scans.T_body_sensor[rear]], list(LEVER.values()), atol=1e-12)
    assert_allclose(scans.poses, [turning(t) for t in scans.times_s], atol=1e-6)
    assert_allclose(scans.sensor_poses[1], scans.poses[1] @ LEVER["base", "rear"], atol=1e-9)
    assert_allclose([s.T_world_sensor for s in scans], scans.sensor_poses, atol=1e-9)
    assert_allclose(scans.imu.R_sensor_imu, np.eye(3), atol=1e-12)  # of the body
    assert any(note.startswith("mountings: TF, base -> ") for note in scans.notes)
    # Poses that are given are those of the body, too: in order, or by time.
    again = read(tmp_path / "drive", scans.poses, topic=list(dict.fromkeys(topics)))
    assert_allclose(again.poses, scans.poses, atol=1e-12)
    write_poses(tmp_path / "body.tum", scans.poses, scans.times_s)
    by_time = read(tmp_path / "drive", tmp_path / "body.tum", topic=list(dict.fromkeys(topics)))
    assert_allclose(by_time.sensor_poses, scans.sensor_poses, atol=1e-5)


@pytest.mark.parametrize("edges", [{}, {("base", "front"): np.eye(4)}, "shared"])
def test_without_all_mountings_radars_have_labels_and_their_own_poses(tmp_path, edges):
    """Nor do topics tell them that share one frame."""
    shared = edges == "shared"
    bag = rig_bag(tmp_path, LEVER if shared else edges, frames=("front", "front" if shared else "rear"))
    scans = read(bag, [pose([0.1 * i, 0, 0]) for i in range(20)], topic=["/front", "/rear"])
    assert (scans.sensors, scans.T_body_sensor) == (["/front", "/rear"] * 10, None)
    assert_allclose(scans.poses[:, 0, 3], 0.1 * np.arange(20))
    assert any("no mountings are known" in note for note in scans.notes)


def test_one_topic_of_one_frame_has_no_labels(tmp_path):
    scans = read(rig_bag(tmp_path), topic="/front")
    assert (scans.sensors, scans.T_body_sensor) == (None, None)
    assert_allclose(scans.poses, [turning(t) @ LEVER["base", "front"] for t in TIMES_S], atol=1e-6)
