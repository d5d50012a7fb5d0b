"""``radarsdf live --ros2`` maps the topics of another process, and publishes what rosbags decodes."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from threading import RLock

import numpy as np
import pytest
import radarsdf
from radarsdf.io.npz import write_scans
from radarsdf.scans import Notes, Scans

from ..conftest import ground_and_wall
from .calls import refusal

pytest.importorskip("cyclonedds", reason="topics of ROS 2 need cyclonedds")
pytest.importorskip("rosbags")
from radarsdf.io.bag_messages import POSE_TYPES, TRANSFORM_TYPES, Message, Pose
from radarsdf.io.bag_poses import Tracks
from radarsdf.io.dds import Node, make_message
from radarsdf.io.recordings import Request
from radarsdf.io.subscription import Subscription, _RecentTrack

SCENE = ground_and_wall(scans=12, returns_per_scan=600)
DOMAIN = 100 + os.getpid() % 100
LIVE = [sys.executable, "-m", "radarsdf", "live", "--ros2", "/radar/points", "--ros2-domain", str(DOMAIN)]
SETTINGS = "--set training.sdf_iterations=40 --set training.intensity_iterations=20"
FAST = [*SETTINGS.split(), "--quiet", "--json"]
TIMEOUT_S = 180


@pytest.fixture
def node():
    with contextlib.closing(Node(DOMAIN)) as node:
        yield node


def received(node, readers):
    """Topics and messages that arrived since the last call, decoded by rosbags from their bytes."""
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415

    store = get_typestore(Stores.ROS2_HUMBLE)
    for topic, kinds in node.published().items():
        if topic not in readers and topic.startswith(("/radarsdf", "/tf")):
            latched = topic in ("/radarsdf/surface", "/radarsdf/grid")
            readers[topic] = node.reader(topic, *kinds, reliable=True, latched=latched), *kinds
    for topic, (reader, kind) in readers.items():
        for sample in reader.take(100):
            if sample.sample_info.valid_data:
                yield topic, store.deserialize_cdr(sample.data, kind)


@pytest.mark.parametrize("posed", [True, False])
def test_it_maps_and_publishes(posed, tmp_path, node):
    scans, out, trajectory = (tmp_path / name for name in ("scans.npz", "map.safetensors", "way.npy"))
    write_scans(scans, Scans(SCENE.points, SCENE.poses, SCENE.intensities))
    talker = [Path(__file__).with_name("ros2_talker.py"), scans, DOMAIN, 10, "tf" if posed else ""]
    messages, readers, last_m = {}, {}, 10.5 if posed else 5.0  # the drive is 11 m long
    with (
        subprocess.Popen(
            [*LIVE, *FAST, "-o", out, "--trajectory", trajectory], stdout=subprocess.PIPE
        ) as live,
        subprocess.Popen([sys.executable, *map(str, talker)]) as talking,
    ):
        until_s, seen = time.monotonic() + TIMEOUT_S, False
        try:
            while not (seen and len(messages) == 4) and live.poll() is None and time.monotonic() < until_s:
                for topic, message in received(node, readers):
                    messages.setdefault(topic, []).append(message)
                    seen = seen or (topic == "/radarsdf/pose" and message.pose.position.x > last_m)
                time.sleep(0.05)
        finally:
            talking.kill()
            live.send_signal(signal.SIGTERM if posed else signal.SIGINT)  # the normal ends
        said = json.loads(live.communicate(timeout=TIMEOUT_S)[0])
        for topic, message in received(node, readers):  # of the whole map: that of one scan has no free cell
            messages.setdefault(topic, []).append(message)
    assert said["dropped"] == 0
    if posed:
        assert said["scans"] == len(SCENE.poses)
        np.testing.assert_allclose(np.load(trajectory), SCENE.poses, atol=1e-6)
    assert len(radarsdf.load(out).mesh(0.2).faces) > 100
    assert set(messages) == {"/radarsdf/pose", "/radarsdf/surface", "/radarsdf/grid", "/tf"}
    pose, surface, grid = (messages[f"/radarsdf/{name}"][-1] for name in ("pose", "surface", "grid"))
    world = "world" if posed else "map"
    assert {message.header.frame_id for message in (pose, surface, grid)} == {world}
    corners = np.array([[point.x, point.y, point.z] for point in surface.points])
    assert len(corners) > 300
    assert len(corners) % 3 == 0
    assert np.median(np.minimum(abs(corners[:, 2] + (0 if posed else 1.5)), abs(corners[:, 0] - 20))) < 0.1
    assert {0, 100} <= set(grid.data) <= {-1, 0, 100}
    assert len(grid.data) == grid.info.width * grid.info.height
    child = messages["/tf"][-1].transforms[0]
    frames = child.header.frame_id, child.child_frame_id
    assert frames == (world, "radar")  # one parent: of the talker, or ours


def test_late_static_transforms_replace_an_assumed_mounting():
    scans = Subscription.__new__(Subscription)
    scans._request = Request(pose_topic="/odom", notes=Notes())
    scans._tracks, scans._frames, scans._lock = Tracks(_RecentTrack), {"/radar/points": "radar"}, RLock()
    scans.unposed, scans._assumed = False, True

    def add(topic, message_type, time_s, child, parent, x):
        pose = Pose(time_s, parent, child, (x, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0))
        scans._add(Message(Path(), topic, message_type, time_s, 0, time_s, parent, [pose]))

    for time_s in (1.0, 2.0):
        add("/odom", POSE_TYPES[0], time_s, "base", "odom", time_s)
    assert scans._known() is scans._known()  # derived once
    assert scans._find("radar").pose_at(1.5, 2.0)[0, 3] == 1.5
    assert not scans.remounted()
    add("/tf_static", TRANSFORM_TYPES[0], 3.0, "radar", "base", 2.0)
    assert scans.remounted()
    assert not scans.remounted()
    assert scans._find("radar").pose_at(1.5, 2.0)[0, 3] == 3.5
    for time_s in (30.0, 31.0, 1.0, 2.0):  # the clock is set back: a simulator, or a recording, starts again
        add("/odom", POSE_TYPES[0], time_s, "base", "odom", 50 + time_s)
    assert scans._find("radar").pose_at(1.5, 2.0)[0, 3] == 53.5
    assert scans._find("radar").pose_at(30.5, 2.0) is None


def test_other_types_are_named(node):
    node.publish("/radar/points", make_message("std_msgs/msg/String", data="no points"))
    run = subprocess.run(LIVE, capture_output=True, text=True, timeout=TIMEOUT_S, check=False)
    assert run.returncode == 1
    assert "/radar/points" in run.stderr
    assert "std_msgs/msg/String" in run.stderr


@pytest.mark.parametrize(
    "words",
    [[], ["--ros2-odom", "/odom"], ["--ros2", "radar"], ["--ros2", "/r", "--rate", 2], ["--ros2", "/r", "--topic", "/r"],
     ["--ros2", "/r", "--ros2-domain", 231], ["--ros2", "/r", "--find", "--ros2-odom", "/odom"], ["scans.npz", "--ros2", "/r"]],
)  # fmt: skip
def test_useless_options_are_refused(words, tmp_path, capsys):
    refusal(capsys, tmp_path, "live", *words, status=2)
