"""``radarsdf live`` replays a recording, reports whether the map kept up, and writes it."""

import contextlib
import json
import re
import socket
import subprocess
import sys
import time

import numpy as np
import pytest
import radarsdf
from radarsdf.cli.live import replay
from radarsdf.io.npz import write_scans
from radarsdf.scans import Scan, Scans
from radarsdf.view.foxglove import foxglove_sink
from radarsdf.view.rerun import rerun_sink
from radarsdf.view.sinks import FREE_COLOR

from ..conftest import ground_and_wall
from .calls import refusal, values

SCENE = ground_and_wall(scans=6, returns_per_scan=600)


@pytest.fixture
def recording(tmp_path):
    write_scans(tmp_path / "scans.npz", Scans(SCENE.points, SCENE.poses, SCENE.intensities))
    return tmp_path


def test_it_writes_the_map_and_the_poses_of_scans(recording, capsys):
    out, trajectory = recording / "map.safetensors", recording / "way.npy"
    words = ["live", recording / "scans.npz", "--rate", 0, "--quick", "--quiet"]
    said = values(capsys, *words, "-o", out, "--trajectory", trajectory)
    assert (said["scans"], said["dropped"], said["lost"]) == (6, 0, 0)
    assert 0 < said["p50_s"] <= said["worst_s"]
    assert np.load(trajectory).tobytes() == SCENE.poses.tobytes()
    assert len(radarsdf.load(out).mesh(0.2).faces) > 100


class Clock:
    """Replaces the module `time`; integrating a scan takes `integration_s`."""

    def __init__(self, integration_s):
        self.now_s, self.integration_s, self.taken = 100.0, integration_s, []

    def perf_counter(self):
        return self.now_s

    def sleep(self, seconds):
        assert seconds >= 0
        self.now_s += seconds

    scan_ids = ()

    def __len__(self):
        return len(self.taken)

    def integrate(self, _points, pose, _intensities, *, time_s, **_named):
        self.taken.append((round(self.now_s - 100, 9), round(time_s, 9)))
        self.now_s += self.integration_s
        return type("Done", (), {"pose": pose, "moved": (), "notes": ()})


@pytest.mark.parametrize(
    ("rate", "integration_s", "times_s", "begun_s"),
    [(5.0, 0.005, None, {0: 0, 1: 0.02, 2: 0.04, 3: 0.06, 4: 0.08, 5: 0.1}),
     (10.0, 0.024, None, {0: 0, 2: 0.024, 4: 0.048, 5: 0.072}),  # the newest is always taken
     (0.0, 0.03, None, {i: 0.03 * i for i in range(6)}),
     (1.0, 0.01, [7, 8, 8.5, 9, 9.1, 9.2], {0: 0, 1: 1, 2: 1.5, 3: 2, 4: 2.1, 5: 2.2})],
)  # fmt: skip
def test_scans_are_replayed_in_time_and_dropped_if_late(monkeypatch, rate, integration_s, times_s, begun_s):
    clock = Clock(integration_s)
    monkeypatch.setattr("radarsdf.cli.live.time", clock)
    times_s = None if times_s is None else np.array(times_s)
    done = replay(clock, Scans(SCENE.points, SCENE.poses, None, times_s=times_s), rate=rate)
    assert (done.integrated, done.dropped, done.lost) == (len(begun_s), 6 - len(begun_s), 0)
    stamps = 0.1 * np.arange(6) if times_s is None else times_s
    assert clock.taken == [(pytest.approx(begun), pytest.approx(stamps[i])) for i, begun in begun_s.items()]
    np.testing.assert_allclose(done.seconds, integration_s)


def test_scans_without_poses_need_times(recording, capsys):
    assert "times" in refusal(capsys, recording, "live", recording / "scans.npz", "--find")


def test_mcap_readers_decode_what_is_shown(recording, capsys):
    decoder = pytest.importorskip("mcap_protobuf.decoder").DecoderFactory()
    pytest.importorskip("foxglove")
    from mcap.reader import make_reader  # noqa: PLC0415

    out, made = recording / "o.mcap", recording / "map.safetensors"
    values(capsys, "live", recording / "scans.npz", "--rate", 0, "--quiet", "--mcap", out, "-o", made)
    messages = {}
    with out.open("rb") as file:
        for schema, channel, *read in make_reader(file, decoder_factories=[decoder]).iter_decoded_messages():
            kind = channel.topic, schema.name.removeprefix("foxglove.")
            messages.setdefault(kind, []).append(read)
    one_each = [("/tf", "FrameTransform"), ("/pose/radar", "PoseInFrame"), ("/returns/radar", "PointCloud")]
    others = [("/surface", "SceneUpdate"), ("/free_space", "VoxelGrid"), ("/grid", "Grid")]
    assert set(messages) == {*one_each, *others}
    for key in one_each:
        assert [message.log_time for message, _ in messages[key]] == [round(1e8 * i) for i in range(6)]
    cloud = messages[one_each[2]][3][1]
    rows = np.frombuffer(cloud.data, "<f4").reshape(-1, cloud.point_stride // 4)
    expected = np.column_stack([SCENE.points[3], SCENE.intensities[3]]).astype(np.float32)
    np.testing.assert_array_equal(rows, expected)
    assert [field.name for field in cloud.fields] == ["x", "y", "z", "intensity"]
    assert messages[one_each[0]][3][1].translation.x == SCENE.poses[3, 0, 3]
    entity = messages["/surface", "SceneUpdate"][-1][1].entities[0]
    mesh, found = radarsdf.load(made).mesh(0.2), entity.triangles[0]
    vertices = np.array([[p.x, p.y, p.z] for p in found.points])
    assert len(found.colors) == len(vertices) > 0.5 * len(mesh.vertices)
    assert max(found.indices) == len(vertices) - 1
    assert np.isin(np.round(vertices[:, 2], 1), [0.0]).any()
    assert (vertices.min(axis=0) > mesh.bounds[0] - 1).all()
    assert (vertices.max(axis=0) < mesh.bounds[1] + 1).all()
    assert [point.x for point in entity.lines[0].points] == SCENE.poses[:, 0, 3].tolist()
    space = messages["/free_space", "VoxelGrid"][-1][1]
    shape = -1, space.row_count, space.column_count, space.cell_stride
    cells = np.frombuffer(space.data, "u1").reshape(shape)
    assert (space.slice_stride, space.row_stride) == cells.strides[:2]
    origin = np.array([getattr(space.pose.position, axis) for axis in "xyz"])
    ahead = np.array([[12.0, 0.0, 1.0], [30.0, 0.0, 1.0], [14.0, 0.0, 0.01]])  # free, behind the wall, ground
    x, y, z = np.floor((ahead - origin) / space.cell_size.x).astype(int).T
    inside = x < space.column_count
    assert tuple(cells[z[inside][0], y[inside][0], x[inside][0]]) == (*FREE_COLOR, 40)
    grid = messages["/grid", "Grid"][-1][1]
    assert len(grid.data) == space.row_count * space.column_count * grid.cell_stride
    # At the ground, not at the bottom of the box.
    assert grid.pose.position.z == pytest.approx(0, abs=0.05) != space.pose.position.z


def test_rerun_reads_what_is_shown(recording, capsys):
    pytest.importorskip("rerun")
    out = recording / "o.rrd"
    values(capsys, "live", recording / "scans.npz", "--rate", 0, "--quiet", "--rrd", out)

    def rerun(*words):
        command = [sys.executable, "-m", "rerun", "rrd", *words, out]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout

    rerun("verify")
    rows = re.findall(r"with (\d+) rows .* - /map/(\S+)", rerun("print"))
    counts = {name: sum(int(n) for n, other in rows if other == name) for _, name in rows}
    assert {name: counts[name] for name in ("radar", "radar/returns")} == {"radar": 6, "radar/returns": 6}
    assert min(counts[name] for name in ("surface", "trajectory", "free_space")) >= 1


def test_a_failed_replay_leaves_no_files(recording, capsys):
    pytest.importorskip("foxglove")
    pytest.importorskip("rerun")
    outputs = [recording / "o.mcap", recording / "o.rrd"]
    outputs[0].write_bytes(b"old")
    words = ["live", recording / "scans.npz", "--find", "--mcap", outputs[0], "--rrd", outputs[1]]
    refusal(capsys, recording, *words)
    assert outputs[0].read_bytes() == b"old"
    assert {path.name for path in recording.iterdir()} == {"scans.npz", "o.mcap"}


@pytest.mark.parametrize(("option", "missing"), [("--foxglove", "foxglove-sdk"), ("--rerun", "rerun-sdk")])
def test_missing_viewers_are_named(option, missing, recording, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, option.strip("-"), None)
    assert missing in refusal(capsys, recording, "live", recording / "scans.npz", option)


@pytest.mark.parametrize(("open_sink", "library"), [(foxglove_sink, "foxglove"), (rerun_sink, "rerun")])
def test_viewers_are_served_to_this_machine_only(open_sink, library):
    pytest.importorskip(library)

    def answers(host, port):
        with contextlib.suppress(OSError), socket.create_connection((host, port), timeout=1):
            return True
        return False

    def all_answer(ports, wanted):
        until_s = time.monotonic() + 30
        while {answers("127.0.0.1", port) for port in ports} != {wanted} and time.monotonic() < until_s:
            time.sleep(0.1)
        return {answers("127.0.0.1", port) for port in ports} == {wanted}

    with open_sink(None) as sink:
        ports = [int(port) for port in re.findall(r"127\.0\.0\.1(?::|%3A)(\d+)", sink.url)]
        assert len(ports) >= 1
        assert all_answer(ports, True)
        assert not any(answers("127.0.0.2", port) for port in ports)  # also this machine, on Linux
    assert all_answer(ports, False)


def test_a_viewer_that_connects_later_sees_the_last_messages():
    pytest.importorskip("foxglove")
    connect = pytest.importorskip("websockets.sync.client").connect
    with foxglove_sink(None) as sink:
        for time_s in (1.0, 2.0):
            sink.show_scan(Scan(SCENE.points[0], SCENE.poses[0]), time_s)
        with connect(sink.url, subprotocols=["foxglove.sdk.v1"]) as server:
            advertised = next(said for said in map(json.loads, server) if said["op"] == "advertise")
            wanted = [{"id": one["id"], "channelId": one["id"]} for one in advertised["channels"]]
            server.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
            stamps_ns = [int.from_bytes(server.recv(timeout=30)[5:13], "little") for _ in wanted]
    assert stamps_ns == [2_000_000_000] * 3
