"""Maps that were saved, or put away region by region, go on as if nothing had happened; damaged files are refused."""

import io
import json
import math
from functools import partial

import numpy as np
import pytest
import radarsdf
from radarsdf import FitConfig, LiveMap

from bench.live.removal import state

from .test_live_map import SCENE, map_bits, map_of, mesh_bits


def test_a_map_resumes_from_its_file(tmp_path):
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


def test_saved_scans_are_loaded_unchanged(tmp_path):
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


def test_damaged_files_are_rejected(tmp_path):
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


FAR = SCENE.poses.copy()
FAR[4:, 0, 3] += 200.0


far_map_of = partial(map_of, poses=FAR)


def put_away(folder):
    return sorted(folder.glob("region-*.npz"))


def test_stored_regions_are_reloaded_when_scans_reach_them(tmp_path):
    live, other = far_map_of(range(7), folder=tmp_path / "kept"), far_map_of(range(7))
    whole, mesh = state(live), mesh_bits(live.mesh())
    for _ in range(2):
        cells = live._state.sums.num_cells
        gone = live.clear_outside(FAR[6][:3, 3], 60.0)
        assert len(gone) > 0
        assert 0 < live._state.sums.num_cells < cells
        assert len(put_away(tmp_path / "kept")) > 1
        near = live.mesh()
        assert near.vertices[:, 0].min() > 150
        assert len(live.clear_outside(FAR[6][:3, 3], 60.0)) == 0
        # Operations on the whole map load all regions, and leave them stored.
        assert map_bits(live.map()) == map_bits(other.map())
        assert len(put_away(tmp_path / "kept")) > 1
        assert mesh_bits(live.mesh()) == mesh_bits(near)
        live.remove(0)
        live.integrate(SCENE.points[0], FAR[0], SCENE.intensities[0], scan_id=0)
        assert put_away(tmp_path / "kept") == []
        assert state(live) == whole
        assert mesh_bits(live.mesh()) == mesh
    assert live.sealed_scans == 0


def test_a_saved_state_includes_stored_regions(tmp_path):
    live = far_map_of(range(7), folder=tmp_path / "kept")
    whole = state(live)
    live.clear_outside(FAR[6][:3, 3], 60.0)
    live.save(tmp_path / "live.npz")
    del live
    # As after a killed process: the folder has files that the state does not reference.
    loaded = LiveMap.load(tmp_path / "live.npz", folder=tmp_path / "kept")
    assert state(loaded) == whole
    loaded.integrate(SCENE.points[7], FAR[0], SCENE.intensities[7])
    loaded.clear_outside(FAR[0][:3, 3], 60.0)
    loaded.move_all({4: FAR[5]})
    assert put_away(tmp_path / "kept") != []  # of before
    expected = far_map_of([0, 1, 2, 3, 5, 6])
    expected.integrate(SCENE.points[4], FAR[5], SCENE.intensities[4])
    expected.integrate(SCENE.points[7], FAR[0], SCENE.intensities[7])
    assert state(loaded) == state(expected)


def test_a_damaged_region_leaves_the_map_as_it_was(tmp_path):
    live = far_map_of(range(7), folder=tmp_path / "kept")
    live.clear_outside(FAR[6][:3, 3], 60.0)
    before, files = state(live), put_away(tmp_path / "kept")
    intact = files[0].read_bytes()
    for damaged in (b"", intact[: len(intact) // 2], b"PK" + bytes(200)):
        for file in files:
            file.write_bytes(damaged)
        with pytest.raises(ValueError, match="region-"):
            live.integrate(SCENE.points[7], FAR[0], SCENE.intensities[7])
        assert (state(live), len(live)) == (before, 7)
    live.integrate(SCENE.points[7], FAR[6], SCENE.intensities[7])  # which does not reach them


def test_ghosts_of_an_incremental_map_equal_those_of_a_new_one():
    scans = radarsdf.simulate.oculii(seed=6, frames=16)
    known = {"range_noise_m": 0.09, "azimuth_noise_rad": 0.012, "elevation_noise_rad": 0.02}
    live, fresh = (LiveMap(FitConfig(num_threads=1, returns=known), origin=(0, 0, 0)) for _ in range(2))
    for i in range(16):
        live.integrate(scans.points[i], scans.poses[i], scan_id=i)
        if i >= 8:
            live.remove(2 * (i - 8))
        if i % 8 == 7:
            live.mesh()
    for i in live.scan_ids:
        fresh.integrate(scans.points[i], scans.poses[i], scan_id=i)
    assert mesh_bits(live.mesh()) == mesh_bits(fresh.mesh())
    assert len(live._state._surface._ghosts) > 50


def test_flipped_bits_of_a_state_are_detected(tmp_path):
    path, rng = tmp_path / "flipped.npz", np.random.default_rng(0)
    map_of(range(2)).save(path)
    whole = path.read_bytes()
    for first in [0, len(whole) - 1000] * 20:  # the directory of the archive is at its end
        content = bytearray(whole)
        content[rng.integers(first, len(whole))] ^= 1 << rng.integers(8)
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"flipped\.npz"):
            LiveMap.load(path)
