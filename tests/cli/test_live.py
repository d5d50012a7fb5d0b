"""``radarsdf live`` replays a recording, reports whether the map kept up, and writes it."""

from unittest.mock import Mock

import numpy as np
import pytest
import radarsdf
from radarsdf.cli.live import Replay, _PeriodicView, replay
from radarsdf.io.npz import write_scans
from radarsdf.scans import Scans

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
    assert done.rows == list(begun_s)
    assert sorted(done.rows + done.dropped) == list(range(6))
    stamps = 0.1 * np.arange(6) if times_s is None else times_s
    assert clock.taken == [(pytest.approx(begun), pytest.approx(stamps[i])) for i, begun in begun_s.items()]
    np.testing.assert_allclose(done.seconds, integration_s)


def test_scans_without_poses_need_times(recording, capsys):
    assert "times" in refusal(capsys, recording, "live", recording / "scans.npz", "--find")


def test_the_page_shows_the_surface_periodically():
    page, done = Mock(), Replay(poses=[np.eye(4) + np.eye(4)[:, :1] * np.eye(4)[3]])
    shown = _PeriodicView(Mock(**{"mesh.return_value": "mesh"}), page)
    for due, times in ((True, 1), (False, 1), (True, 2)):
        shown._next_s = 0.0 if due else shown._next_s
        shown(done)
        shown._thread.join()
        assert page.show.call_count == times
    mesh, path = page.show.call_args.args
    assert (mesh, path.tolist()) == ("mesh", [[1.0, 0.0, 0.0]])
