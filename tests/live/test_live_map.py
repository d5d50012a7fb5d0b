"""A live map depends only on its present scans, not on how they were added, moved and removed."""

import contextlib
import errno
import os
import sqlite3
import threading

import numpy as np
import pytest
import radarsdf
from radarsdf import FitConfig, LiveMap
from radarsdf.live.surface import regions_of
from radarsdf.scans import Scans

from bench.live.removal import state

from ..conftest import ground_and_wall, pose
from ..returns.walls import distance_from_wall_m, stated_wall

ORIGIN = (2.0, 0.0, 1.0)
KNOWN = {"range_noise_m": 0.02, "azimuth_noise_rad": 1e-3, "elevation_noise_rad": 1e-3}
SETTINGS = FitConfig(num_threads=1, returns=KNOWN)  # a given noise does not depend on previous scans
SCENE = ground_and_wall(scans=8, returns_per_scan=800)


def map_of(numbers, config=SETTINGS, poses=SCENE.poses, **arguments):
    live = LiveMap(config, origin=ORIGIN, **arguments)
    for i in numbers:
        live.integrate(SCENE.points[i], poses[i], SCENE.intensities[i], scan_id=int(i))
    return live


def mesh_bits(mesh):
    parts = (mesh.vertices, mesh.faces, *mesh.vertex_attributes.values())
    return [np.ascontiguousarray(part).tobytes() for part in parts]


def map_bits(radar_map):
    found = radar_map.evidence
    arrays = [parameter.detach().numpy() for parameter in radar_map.field.parameters()]
    return [array.tobytes() for array in [*arrays, found.information, found.hits, found.visibility]]


def test_a_map_after_random_operations_equals_one_of_its_scans():
    rng = np.random.default_rng(5)
    live, inside, poses = map_of([], SETTINGS.override(num_threads=3)), {}, SCENE.poses.copy()
    for _ in range(60):
        i = int(rng.integers(len(SCENE.points)))
        action = rng.choice(["toggle", "move", "mesh"], p=[0.6, 0.25, 0.15])
        if action == "toggle" and i in inside:
            live.remove(i)
            del inside[i]
        elif action == "toggle":
            live.integrate(SCENE.points[i], poses[i], SCENE.intensities[i], scan_id=i)
            inside[i] = True
        elif action == "move" and i in inside:
            poses[i] = pose(rng.uniform(-1, 1, 3) + [i, 0, 1.5], rng.uniform(-0.1, 0.1))
            live.move(i, poses[i])
        elif inside:
            live.mesh()  # its cache must not affect later results
    assert 2 < len(inside) < len(SCENE.points)
    fresh = map_of(rng.permutation(sorted(inside)), poses=poses)
    assert state(live) == state(fresh)
    assert mesh_bits(live.mesh()) == mesh_bits(fresh.mesh())
    for i in list(inside):
        live.remove(i)
    assert (live._state.sums.num_cells, len(live._state.sums.block_keys()), len(live)) == (0, 0, 0)
    assert len(live.mesh().faces) == 0


def test_an_incremental_mesh_equals_that_of_a_quick_fit():
    live = map_of([])
    for i in range(6):
        assert live.integrate(SCENE.points[i], SCENE.poses[i], SCENE.intensities[i]).scan_id == i
        grown = live.mesh()
        assert mesh_bits(grown) == mesh_bits(map_of(range(i + 1)).mesh())
    quick = FitConfig.quick(num_threads=1, returns=KNOWN, encoding={"bridge_cells": 4})
    batch = radarsdf.fit(SCENE.points[:6], SCENE.poses[:6], config=quick, origin=ORIGIN, progress=False)
    whole = batch.mesh(quick.leaf_size_m)
    assert len(whole.faces) == len(grown.faces) > 1000

    def triangles(mesh):
        corners = np.concatenate([mesh.vertices, mesh.vertex_attributes["confidence"][:, None]], axis=1)
        return np.unique(corners[mesh.faces].reshape(len(mesh.faces), -1), axis=0)

    assert triangles(whole).tobytes() == triangles(grown).tobytes()


def test_a_change_updates_bridges_outside_its_region():
    live, poses = map_of([]), SCENE.poses
    for points, at in zip(SCENE.points, poses, strict=True):
        live.integrate(points[::4], at)
    live.mesh()
    world = np.concatenate([p @ at[:3, :3].T + at[:3, 3] for p, at in zip(SCENE.points, poses, strict=True)])
    round_one = world[np.linalg.norm(world - world[3], axis=1) < 1.5]
    live.integrate((round_one - poses[0][:3, 3]) @ poses[0][:3, :3], poses[0])
    grown = mesh_bits(live.mesh())
    live._state._surface = None
    assert grown == mesh_bits(live.mesh())


def test_only_the_changed_part_of_a_long_drive_is_recomputed():
    """The distance exceeds the reach of smoothing, so that most of the map is unaffected."""
    poses = SCENE.poses.copy()
    poses[:, :3, 3] += 40.0 * np.arange(len(poses))[:, None] * [1, 0, 0]
    live = map_of(range(7), poses=poses)
    live.mesh()
    live.integrate(SCENE.points[7], poses[6], SCENE.intensities[7])
    surface, changes, _ = live._state.changes()
    regions = surface.update(*changes)
    assert 0 < len(regions) < 0.4 * len(regions_of(surface.distances.gather()["keys"]))
    grown = mesh_bits(live.mesh())
    live._state._surface = None
    assert grown == mesh_bits(live.mesh())


def test_map_and_finish_equal_fits_of_all_scans():
    config = FitConfig(num_threads=1, training={"sdf_iterations": 3, "intensity_iterations": 3})
    live = map_of([3, 0, 2, 1, 4], config)
    live.remove(3)
    numbers = [0, 2, 1, 4]
    scans = ([given[i] for i in numbers] for given in (SCENE.points, SCENE.poses, SCENE.intensities))
    points, poses, intensities = scans
    for found, settings in (
        (live.finish(progress=False), config),
        (live.map(), FitConfig.quick(num_threads=1, encoding={"bridge_cells": 4})),
    ):
        fitted = radarsdf.fit(
            points, np.stack(poses), intensities, config=settings, origin=ORIGIN, progress=False
        )
        assert map_bits(found) == map_bits(fitted)
        mesh = found.mesh(0.2)
        at = mesh.vertices[:50], poses[0][:3, 3]
        assert found.intensity(*at).tobytes() == fitted.intensity(*at).tobytes()


def test_returns_are_weighted_by_their_stated_deviations(tmp_path):
    points, poses, sigmas = stated_wall()
    equal, stated = LiveMap(FitConfig.quick()), LiveMap(FitConfig.quick(), folder=tmp_path / "live")
    for scan, at, own in zip(points, poses, sigmas, strict=True):
        equal.integrate(scan, at)
        last = stated.integrate(scan, at, sigmas=own).scan_id
    assert distance_from_wall_m(stated.mesh()) < 0.8 * distance_from_wall_m(equal.mesh())
    stated.save(tmp_path / "live.npz")
    again = LiveMap.load(tmp_path / "live.npz")
    assert mesh_bits(again.mesh()) == mesh_bits(stated.mesh())
    given = {"config": FitConfig.quick(), "origin": stated.origin}
    assert map_bits(again.finish()) == map_bits(radarsdf.fit(Scans(points, poses, sigmas=sigmas), **given))
    fewer = LiveMap(FitConfig.quick())
    for scan, at, own in zip(points[:-1], poses, sigmas, strict=False):
        fewer.integrate(scan, at, sigmas=own)
    stated.remove(last)
    assert state(stated) == state(fewer)


def test_concurrent_readers_see_the_map_before_or_after_a_scan():
    known = {tuple(mesh_bits(map_of(range(i)).mesh())) for i in range(1, 7)}
    live, seen, done = map_of([0]), [], threading.Event()

    def read():
        while not done.is_set():
            seen.append(tuple(mesh_bits(live.mesh())))

    readers = [threading.Thread(target=read) for _ in range(2)]
    for reader in readers:
        reader.start()
    for i in range(1, 6):
        live.integrate(SCENE.points[i], SCENE.poses[i], SCENE.intensities[i])
    done.set()
    for reader in readers:
        reader.join()
    assert seen
    assert set(seen) <= known


def test_sizes_are_not_read_during_integration(monkeypatch):
    """The core changes its tables without the GIL: sizes read meanwhile are undefined."""
    live, found, during = map_of(range(3)), [], []
    reader = threading.Thread(target=lambda: found.append(repr(live)))
    apply = live._state._apply

    def slowly(*change):
        reader.start()
        reader.join(0.2)
        during.extend(found)
        return apply(*change)

    monkeypatch.setattr(live._state, "_apply", slowly)
    live.integrate(SCENE.points[3], SCENE.poses[3], SCENE.intensities[3])
    reader.join()
    assert (during, found) == ([], [repr(live)])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"scan_id": 2}, "already"),
        ({"points": SCENE.points[3] + 1e7}, "million cells"),
        ({"points": np.zeros((800, 2))}, "shape"),
        ({"pose": 2 * np.eye(4)}, "rigid"),
        ({"intensities": None}, "intensities"),
        ({"intensities": np.zeros(3)}, "shape"),
        ({"doppler_mps": np.zeros(3)}, "doppler_mps of scan 0 must have shape"),
    ],
)
def test_a_bad_scan_leaves_the_map_unchanged(change, words):
    live = map_of(range(3))
    before, mesh = state(live), mesh_bits(live.mesh())
    scan = {"points": SCENE.points[3], "pose": SCENE.poses[3], "intensities": SCENE.intensities[3]}
    with pytest.raises(ValueError, match=words):
        live.integrate(**scan | change)
    assert (state(live), mesh_bits(live.mesh()), len(live)) == (before, mesh, 3)
    live.integrate(**scan)
    assert state(live) == state(map_of(range(4)))


@pytest.mark.parametrize("points", [np.zeros((0, 3)), np.full((5, 3), np.nan)], ids=["empty", "nan"])
def test_a_scan_without_returns_changes_nothing(points):
    live = map_of(range(3))
    mesh = mesh_bits(live.mesh())
    assert len(live.integrate(points, SCENE.poses[3], np.zeros(len(points))).blocks) == 0
    assert mesh_bits(live.mesh()) == mesh


def test_moving_several_scans_is_atomic():
    live = map_of(range(4))
    before = state(live)
    moved = SCENE.poses.copy()
    moved[:, :3, 3] += [0.3, -0.2, 0.1]
    with pytest.raises(KeyError, match="no scan 9"):
        live.move_all({0: moved[0], 9: moved[1]})
    assert state(live) == before
    for wrong in (list(moved[:4]), None, moved):
        with pytest.raises(TypeError, match="poses must be a Mapping"):
            live.move_all(wrong)
    with pytest.raises(ValueError, match="the pose of scan 1"):
        live.move_all({0: moved[0], 1: moved[1, :3]})
    with pytest.raises(TypeError, match="scan_id must be a Hashable"):
        live.integrate(SCENE.points[0], SCENE.poses[0], SCENE.intensities[0], scan_id=[7])
    changed = live.move_all(dict(enumerate(moved[:4])))
    assert state(live) == state(map_of(range(4), poses=moved))
    assert len(changed) > 10
    assert len(live.move_all(dict(enumerate(moved[:4])))) == 0  # nothing changes


def stored_scans(folder):
    with contextlib.closing(sqlite3.connect(folder / "scans.sqlite")) as file:
        return file.execute("SELECT count(*) FROM scans").fetchone()[0]


def test_nothing_of_scans_in_a_folder_stays_in_memory(tmp_path):
    live, whole = map_of(range(8), folder=tmp_path / "scans"), map_of(range(8))
    assert live._state.log.num_bytes == 0
    assert not live._state.log._scans
    for one in (live, whole):
        one.move(2, SCENE.poses[3])
        one.remove(4)
    assert stored_scans(tmp_path / "scans") == len(live) == 7
    assert (live.scan_ids, state(live)) == (whole.scan_ids, state(whole))
    np.testing.assert_array_equal(live.trajectory()[1], SCENE.poses[[0, 1, 3, 3, 5, 6, 7]])
    with pytest.raises(ValueError, match="scan_id"):
        live.integrate(SCENE.points[4], SCENE.poses[4], SCENE.intensities[4], scan_id=(4,))


def test_old_scans_are_stored_on_disk_or_sealed(tmp_path):
    needed = map_of(range(8)).num_bytes
    spilled = map_of(range(8), max_bytes=needed - 60_000, folder=tmp_path / "scans")
    stored = stored_scans(tmp_path / "scans")
    assert 0 < stored < 8
    assert spilled.num_bytes <= needed - 60_000
    spilled.remove(0)
    assert stored_scans(tmp_path / "scans") == stored - 1
    assert state(spilled) == state(map_of(range(1, 8)))
    sealed = map_of(range(8), max_bytes=needed - 60_000)
    assert sealed.sealed_scans == stored
    with pytest.raises(ValueError, match="sealed"):
        sealed.remove(0)
    with pytest.raises(ValueError, match="sealed"):
        sealed.finish()
    assert state(sealed) == state(map_of(range(8)))
    assert len(sealed.map().mesh(0.2).faces) > 100


def test_a_full_disk_leaves_the_map_unchanged(tmp_path, monkeypatch):
    needed = map_of(range(7)).num_bytes
    live = map_of(range(6), max_bytes=needed - 60_000, folder=tmp_path / "scans")
    before, ids, poses = state(live), live.scan_ids, [live.pose(i) for i in range(6)]

    def full(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr("radarsdf.live.store._Rows.write", full)
        for _ in range(3):
            with pytest.raises(OSError, match="No space"):
                live.integrate(SCENE.points[6], SCENE.poses[6], SCENE.intensities[6])
        with pytest.raises(OSError, match="No space"):
            live.move_all({0: SCENE.poses[1], 1: SCENE.poses[0]})
    assert (state(live), live.scan_ids) == (before, ids)
    assert all((live.pose(i) == pose).all() for i, pose in enumerate(poses))
    assert live.integrate(SCENE.points[6], SCENE.poses[6], SCENE.intensities[6]).scan_id == 6
    with live._state.whole():
        assert state(live) == state(map_of(range(7)))


def test_a_folder_belongs_to_one_map(tmp_path):
    folder = tmp_path / "scans"
    live = map_of(range(8), max_bytes=map_of(range(8)).num_bytes - 60_000, folder=folder)
    with pytest.raises(BlockingIOError, match=rf"scans is being used by process {os.getpid()}"):
        LiveMap(folder=folder)
    live.remove(0)
    assert state(live) == state(map_of(range(1, 8)))
    del live
    assert len(LiveMap(folder=folder)) == 0  # previous files are overwritten
    (folder / "notes.txt").touch()
    with pytest.raises(ValueError, match="other files"):
        LiveMap(folder=folder)
    (tmp_path / "scans.sqlite").touch()  # a foreign file: no map has used this folder
    with pytest.raises(ValueError, match="other files"):
        LiveMap(folder=tmp_path)


def test_distant_regions_are_dropped():
    live = map_of(range(8))
    live.mesh()
    keys = live._state.sums.block_keys()
    gone = live.clear_outside([20.0, 0.0, 1.0], 9.0)
    assert 0 < len(gone) < len(keys)
    mesh = live.mesh()
    assert np.linalg.norm(mesh.vertices - [20.0, 0.0, 1.0], axis=1).max() < 9.0 + 1.6 * np.sqrt(3)
    live._state._surface = None
    assert mesh_bits(mesh) == mesh_bits(live.mesh())
    assert live.sealed_scans == 8  # all were taken farther away
    with pytest.raises(ValueError, match="sealed"):
        live.remove(3)
    live.integrate(SCENE.points[0], SCENE.poses[0], SCENE.intensities[0], scan_id="again")
    live.remove("again")
