# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""``radarsdf live`` replays a recording, says how the map kept up, and writes it."""

from __future__ import annotations

import time

import numpy as np
import pytest
import radarsdf
from radarsdf.cli.live import replay
from radarsdf.io.npz import write_scans
from radarsdf.scans import Scans

from ..conftest import ground_and_wall
from .calls import refusal, values

SCENE = ground_and_wall(scans=6, returns_per_scan=600)


@pytest.fixture
def recording(tmp_path):
    write_scans(tmp_path / "scans.npz", Scans(SCENE.points, SCENE.poses, SCENE.intensities))
    return tmp_path


def test_it_writes_the_map_and_where_scans_were_placed(recording, capsys):
    out, trajectory = recording / "map.safetensors", recording / "way.npy"
    words = ["live", recording / "scans.npz", "--rate", 0, "--quick", "--quiet"]
    said = values(capsys, *words, "-o", out, "--trajectory", trajectory)
    assert (said["scans"], said["dropped"], said["lost"]) == (6, 0, 0)
    assert 0 < said["p50_s"] <= said["worst_s"]
    assert np.load(trajectory).tobytes() == SCENE.poses.tobytes()
    assert len(radarsdf.load(out).mesh(0.2).faces) > 100


def test_scans_that_come_too_fast_are_dropped():
    class Slow:
        def integrate(self, *_given, **_named):
            time.sleep(0.03)
            return type("Done", (), {"pose": np.eye(4), "moved": ()})

    scans = Scans(SCENE.points, SCENE.poses, None)
    done = replay(Slow(), scans, rate=10.0)  # a scan each 10 ms
    assert done.dropped
    assert done.rows[0] == 0
    assert done.rows[-1] == 5  # the newest is always taken
    assert sorted(done.rows + done.dropped) == list(range(6))


def test_scans_without_poses_need_times(recording, capsys):
    assert "times" in refusal(capsys, recording, "live", recording / "scans.npz", "--find")
