# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""A map that was saved goes on as if nothing had happened, and damaged files are refused."""

import io
import json
import math

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


def test_scans_come_back_as_they_were_given(tmp_path):
    """With float64 and float32 points, with Doppler and without, with moving returns and without."""
    live, rng = LiveMap(), np.random.default_rng(0)
    live.save(tmp_path / "empty.npz")
    assert len(LiveMap.load(tmp_path / "empty.npz")) == 0
    for i in range(4):
        points = SCENE.points[i] if i % 2 else SCENE.points[i].astype(np.float32)
        still = -points @ [1.0, 0, 0] / np.linalg.norm(points, axis=1)
        speeds = still + 3.0 * (rng.random(len(points)) < 0.05)
        live.integrate(points, SCENE.poses[i], doppler_mps=speeds if i > 1 else None, time_s=0.1 * i)
    live.save(tmp_path / "live.npz")
    again = LiveMap.load(tmp_path / "live.npz")
    for one, other in zip(live._state.scans(), again._state.scans(), strict=True):
        assert one.time_s == other.time_s
        for name, value in vars(one).items():
            if isinstance(value, np.ndarray):
                assert (value.dtype, value.tobytes()) == (
                    getattr(other, name).dtype,
                    getattr(other, name).tobytes(),
                )
            else:
                assert getattr(other, name) == value


def test_damaged_files_are_refused(tmp_path):
    file = tmp_path / "live.npz"
    map_of(range(2)).save(file)
    whole = file.read_bytes()
    with np.load(io.BytesIO(whole)) as loaded:
        arrays = dict(loaded)
    for damaged in (b"", whole[: len(whole) // 2], b"PK" + bytes(100)):
        file.write_bytes(damaged)
        with pytest.raises(ValueError, match=r"live\.npz"):
            LiveMap.load(file)
    for changed in (
        {"is_static 1": arrays["points 1"]},
        {"keys": arrays["keys"][::-1]},
        {"points 0": arrays["points 0"][:, 0]},
    ):
        np.savez(file, **arrays | changed)
        with pytest.raises(ValueError, match=r"live\.npz"):
            LiveMap.load(file)
    described = json.loads(arrays["described"].tobytes())
    for name, value in (
        ("format", 1), ("origin", None), ("noise", [math.nan] * 3), ("poses", []), ("max_bytes", -1), ("sealed", [0]),
        ("ids", [0, 0]), ("config", []),
    ):  # fmt: skip
        text = json.dumps(described | {name: value}).encode()
        np.savez(file, **arrays | {"described": np.frombuffer(text, np.uint8)})
        with pytest.raises(ValueError, match=r"live\.npz"):
            LiveMap.load(file)
