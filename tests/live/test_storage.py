# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""A map that was saved goes on as if nothing had happened, and damaged files are refused."""

from __future__ import annotations

import io
import json
import math
import subprocess
import sys
import time

import numpy as np
import pytest
from radarsdf import LiveMap

from bench.live.removal import state

from .test_live_map import SCENE, map_of, mesh_bits


def test_a_map_goes_on_from_its_file(tmp_path):
    file = tmp_path / "live.npz"
    live = map_of(range(6), max_bytes=map_of(range(6)).num_bytes - 30_000)
    assert live.sealed_scans > 0
    live.save(file)
    again = LiveMap.load(file)
    assert state(again) == state(live)
    assert (len(again), again.scan_ids, again.sealed_scans) == (6, live.scan_ids, live.sealed_scans)
    for one in (live, again):
        one.remove(5)
        one.integrate(SCENE.points[7], SCENE.poses[7], SCENE.intensities[7])
    assert state(again) == state(live)
    assert mesh_bits(again.mesh()) == mesh_bits(live.mesh())


def test_an_empty_map_can_be_saved(tmp_path):
    LiveMap().save(tmp_path / "live.npz")
    assert len(LiveMap.load(tmp_path / "live.npz")) == 0


def test_damaged_files_are_refused(tmp_path):
    file = tmp_path / "live.npz"
    map_of(range(2)).save(file)
    whole = file.read_bytes()
    for damaged in (b"", whole[: len(whole) // 2], b"PK" + bytes(100)):
        file.write_bytes(damaged)
        with pytest.raises(ValueError, match=r"live\.npz"):
            LiveMap.load(file)
    with np.load(io.BytesIO(whole)) as arrays:
        changed = dict(arrays) | {"counts": arrays["counts"] + 1}
    np.savez(file, **changed)
    with pytest.raises(ValueError, match="another number"):
        LiveMap.load(file)


def test_a_killed_process_leaves_its_last_state(tmp_path):
    code = """
import sys
from tests.live.test_live_map import SCENE, map_of
live, saved = map_of([]), 0
for i in range(10**6):
    k = i % len(SCENE.points)
    live.integrate(SCENE.points[k], SCENE.poses[k], SCENE.intensities[k])
    live.save(sys.argv[1])
    print(i + 1, flush=True)
"""
    file = tmp_path / "live.npz"
    with subprocess.Popen(
        [sys.executable, "-c", code, str(file)], stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        for _ in range(3):
            process.stdout.readline()
        time.sleep(0.01)
        process.kill()
        printed = process.stdout.read().split()
    live = LiveMap.load(file)
    assert len(live) >= (int(printed[-1]) if printed else 3)
    other = map_of([])
    for i in range(len(live)):
        k = i % len(SCENE.points)
        other.integrate(SCENE.points[k], SCENE.poses[k], SCENE.intensities[k])
    assert state(live) == state(other)


@pytest.mark.parametrize(
    ("name", "value"),
    [("format", 2), ("origin", [1.0]), ("origin", None), ("origin", [1e300] * 3), ("noise", [math.nan] * 3), ("noise_of", math.inf),
     ("next_id", 1e308), ("next_id", 1), ("with_intensities", "x"), ("with_intensities", False), ("max_bytes", []), ("max_bytes", -1),
     ("sealed", 3), ("sealed", [[1]]), ("sealed", [0]), ("ids", [0, 0]), ("held", [["points"]] * 2), ("config", [])],
)  # fmt: skip
def test_odd_metadata_is_refused(tmp_path, name, value):
    file = tmp_path / "live.npz"
    map_of(range(2)).save(file)
    with np.load(file) as loaded:
        arrays = dict(loaded)
    described = json.loads(arrays["described"].tobytes()) | {name: value}
    np.savez(file, **arrays | {"described": np.frombuffer(json.dumps(described).encode(), np.uint8)})
    with pytest.raises(ValueError, match=r"live\.npz"):
        LiveMap.load(file)
