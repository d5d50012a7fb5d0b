# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What was put away to a folder comes back with the same bits, when a scan reaches it."""

import pytest
from radarsdf import LiveMap

from bench.live.removal import state

from .test_live_map import ORIGIN, SCENE, SETTINGS, map_bits, mesh_bits

FAR = SCENE.poses.copy()
FAR[4:, 0, 3] += 200.0


def map_of(numbers, **arguments):
    live = LiveMap(SETTINGS, origin=ORIGIN, **arguments)
    for i in numbers:
        live.integrate(SCENE.points[i], FAR[i], SCENE.intensities[i], scan_id=int(i))
    return live


def put_away(folder):
    return sorted(folder.glob("region-*.npz"))


def test_a_map_that_was_put_away_comes_back_where_scans_reach_it(tmp_path):
    live, other = map_of(range(7), folder=tmp_path / "kept"), map_of(range(7))
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
        # What needs all of it has all of it, and leaves it where it was.
        assert map_bits(live.map()) == map_bits(other.map())
        assert len(put_away(tmp_path / "kept")) > 1
        assert mesh_bits(live.mesh()) == mesh_bits(near)
        live.remove(0)
        live.integrate(SCENE.points[0], FAR[0], SCENE.intensities[0], scan_id=0)
        assert put_away(tmp_path / "kept") == []
        assert state(live) == whole
        assert mesh_bits(live.mesh()) == mesh
    assert live.sealed_scans == 0


def test_a_state_has_what_is_put_away(tmp_path):
    live = map_of(range(7), folder=tmp_path / "kept")
    whole = state(live)
    live.clear_outside(FAR[6][:3, 3], 60.0)
    live.save(tmp_path / "live.npz")
    del live
    # As after a process was killed: the folder still has files, of which the state knows nothing.
    loaded = LiveMap.load(tmp_path / "live.npz", folder=tmp_path / "kept")
    assert state(loaded) == whole
    loaded.integrate(SCENE.points[7], FAR[0], SCENE.intensities[7])
    loaded.clear_outside(FAR[0][:3, 3], 60.0)
    loaded.move_all({4: FAR[5]})
    assert put_away(tmp_path / "kept") != []  # of before
    expected = map_of([0, 1, 2, 3, 5, 6])
    expected.integrate(SCENE.points[4], FAR[5], SCENE.intensities[4])
    expected.integrate(SCENE.points[7], FAR[0], SCENE.intensities[7])
    assert state(loaded) == state(expected)


def test_a_damaged_region_leaves_the_map_as_it_was(tmp_path):
    live = map_of(range(7), folder=tmp_path / "kept")
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
