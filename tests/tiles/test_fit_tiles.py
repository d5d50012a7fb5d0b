"""Fits in tiles: the same steps as one fit, with any executor and after failures."""

import dataclasses
import multiprocessing
import os
import shutil
from concurrent.futures import Future

import numpy as np
import pytest
import radarsdf
from radarsdf import FitConfig
from radarsdf.io import Scan, Scans
from radarsdf.io.files import take_lock
from radarsdf.returns.noise import NOISE_SETTINGS
from radarsdf.tiles.fit_tiles import plan_tiles, run_fits
from radarsdf.tiles.plan import Plan, map_path

from scenes.rigs import drive_of_rig

from ..returns.walls import distance_from_wall_m, stated_wall
from .cluster import bits_of
from .conftest import CONFIG, TILE_M


def tiles_of(drive, out, **arguments):
    given = {"tile_size": TILE_M, "halo": 6.4, "config": CONFIG, "progress": False} | arguments
    return radarsdf.fit_tiles(drive, out, **given)


def test_returns_are_weighted_by_their_stated_deviations(tmp_path, caplog):
    points, poses, sigmas = stated_wall()
    false = [np.roll(own, 1, axis=0) for own in sigmas]
    off_m = []
    for i, own in enumerate((None, sigmas, false)):
        scans = Scans(points, poses, sigmas=own)
        city = tiles_of(scans, tmp_path / str(i), tile_size=102.4)
        assert city.clutter_ratio == radarsdf.fit(scans, config=CONFIG, progress=False).clutter_ratio
        off_m.append(distance_from_wall_m(city.mesh()))
        assert len(city.tiles) > 1
        assert ("deviations stated by the sensor" in caplog.text) is (own is false)
    assert off_m[1] < 0.8 * off_m[0]
    assert off_m[2] == off_m[0]


def test_one_tile_equals_one_fit(drive, tmp_path):
    city = tiles_of(drive, tmp_path / "city", tile_size=512, halo=51.2)
    contents = {tile.tile: city.contents_of(tile) for tile in city.tiles}
    assert len(contents) == 2  # the drive crosses a border, and each tile has the returns within 51 m
    part = contents[0, 0]
    scale = (city.intensity_scale.low, city.intensity_scale.high)
    config = CONFIG.override(returns={name: getattr(city.config.returns, name) for name in NOISE_SETTINGS})
    given = {"origin": part.origin, "intensity_range": scale}
    whole = radarsdf.fit(drive, config=config, **given, progress=False)
    np.testing.assert_array_equal(whole.field.table.leaf_keys(), part.field.table.leaf_keys())
    np.testing.assert_array_equal(whole.evidence.visibility, part.evidence.visibility)
    points = np.concatenate([s.world_points for s in drive])[::50]
    # Positions are rounded to float32 in another frame, and smoothing propagates the error: at most 0.24 mm.
    error_m = np.abs(city.sdf(points) - whole.sdf(points))
    assert np.nanmedian(error_m) < 1e-5
    assert np.nanmax(error_m) < 1e-3
    # So a return at the edge of a cell may lie in the next one.
    error = np.abs(city.intensity(points, [0, 0, 1]) - whole.intensity(points, [0, 0, 1]))
    error = error[np.isfinite(error)]  # within the measured elevations
    assert len(error) > 20
    assert error.mean() < 0.004 * (scale[1] - scale[0])
    assert error.max() < 0.02 * (scale[1] - scale[0])


def test_tiles_of_a_rig_have_the_noise_and_unit_of_each_radar(tmp_path):
    simulation = radarsdf.simulate.wall(seed=5, frames=12)
    rig, front = (drive_of_rig(simulation, *labels, seed=1).scans for labels in ((), (["front"],)))
    city = tiles_of(rig, tmp_path / "city")
    whole, alone = (radarsdf.fit(scans, config=CONFIG) for scans in (rig, front))
    assert len(city.tiles) > 1
    assert city.sensors.keys() == whole.sensors.keys()
    for label, gain_db in {"front": 0.0, "rear": -6.0, "side": 4.0}.items():
        sensor, expected = city.sensors[label], whole.sensors[label]
        np.testing.assert_allclose(sensor.noise.deviations, expected.noise.deviations, rtol=0.2)
        assert abs(sensor.unit[1] - gain_db) < 1.0
    points = np.asarray(whole.mesh().vertices)
    seen = [of.intensity(points, rig.poses[4, :3, 3]) for of in (city, alone)]
    assert abs(np.nanmedian(seen[0] - seen[1])) < 1.0


def test_trained_tiles(drive, tmp_path):
    config = FitConfig(num_threads=1, training={"sdf_iterations": 20, "intensity_iterations": 10})
    some = drive.select(np.arange(4))
    city = tiles_of(some, tmp_path / "city", config=config)
    whole = radarsdf.fit(some, config=config, progress=False)
    assert city.missing == {}
    points = np.concatenate([scan.world_points for scan in some])
    points = points[whole.observed(points) & city.observed(points)]
    # Of different networks after few iterations.
    assert np.median(np.abs(city.sdf(points) - whole.sdf(points))) < 0.05


def test_resuming_keeps_finished_tiles_and_changes_no_bit(drive, folder, tmp_path):
    again = tmp_path / "city"
    shutil.copytree(folder, again)
    plan = Plan.load(again)
    first, second = map_path(again, plan.tiles[0]), map_path(again, plan.tiles[1])
    first.unlink()
    second.write_bytes(second.read_bytes()[:1000])  # as a full disk would leave it without atomic writes
    others = {tile.name: map_path(again, tile).stat().st_mtime_ns for tile in plan.tiles[2:]}
    city = tiles_of(drive, again)
    assert city.missing == {}
    assert {tile.name: map_path(again, tile).stat().st_mtime_ns for tile in plan.tiles[2:]} == others
    assert bits_of(folder) == bits_of(again)


def test_a_failed_tile_is_named_and_the_others_continue(drive, tmp_path):
    out = tmp_path / "city"
    plan = plan_tiles(drive, out, tile_size=TILE_M, halo=6.4, config=CONFIG)
    bad = plan.tiles[2].name
    rays = out / "tiles" / bad / "rays.bin"
    rays.write_bytes(rays.read_bytes()[:-7])
    city = run_fits(out, progress=False)
    assert list(city.missing) == [bad]
    assert "rays of the plan" in city.missing[bad]
    assert len(city.tiles) == len(plan.tiles) - 1
    assert len(city.mesh(0.2, progress=False).faces) > 1000


class Broken:
    """An executor with workers that die."""

    def submit(self, task, *arguments):
        future = Future()
        if arguments[1] == "0_0":
            future.set_exception(multiprocessing.ProcessError("killed"))
        else:
            future.set_result(task(*arguments))
        return future


def test_a_killed_worker_loses_only_its_tile(drive, folder, tmp_path):
    city = tiles_of(drive, tmp_path / "city", executor=Broken())
    assert city.missing == {"0_0": "killed"}
    assert tiles_of(drive, tmp_path / "city").missing == {}
    assert bits_of(folder) == bits_of(tmp_path / "city")


def test_another_plan_is_rejected(drive, folder):
    with pytest.raises(ValueError, match="another plan: seed differ"):
        tiles_of(drive, folder, config=CONFIG.override(seed=1))
    with pytest.raises(ValueError, match="another plan: tile_size differ"):
        tiles_of(drive, folder, tile_size=25.6)
    with pytest.raises(ValueError, match="another plan: scans differ"):
        tiles_of(drive.select(np.arange(11)), folder)
    with pytest.raises(ValueError, match="num_threads differ"):
        tiles_of(drive, folder, config=CONFIG.override(num_threads=2))
    assert tiles_of(drive, folder, config=CONFIG.override(num_threads=0)).missing == {}  # any will do


def test_one_process_at_a_time_plans_a_folder(drive, folder, tmp_path):
    # A folder with a plan is unlocked.
    out, lock = (tmp_path / "city", take_lock(folder / "plan.lock", "planned"))
    os.close(lock)
    out.mkdir()
    lock = take_lock(out / "plan.lock", "planned")
    with pytest.raises(BlockingIOError, match=f"city is being planned by process {os.getpid()}"):
        plan_tiles(drive, out, tile_size=TILE_M, halo=6.4, config=CONFIG)
    os.close(lock)
    (out / "tiles" / "0_0").mkdir(parents=True)  # as after a killed process
    (out / "tiles" / "0_0" / "rays.bin").write_bytes(b"half")
    assert plan_tiles(drive, out, tile_size=TILE_M, halo=6.4, config=CONFIG) == Plan.load(folder)


def test_scans_may_be_an_iterator(drive, folder, tmp_path):
    city = tiles_of((scan for scan in drive), tmp_path / "city")
    assert city.plan == Plan.load(folder)


def changed(drive, number, **values):
    for i, scan in enumerate(drive):
        yield dataclasses.replace(scan, **values) if i == number else scan


def test_a_scan_in_another_city_has_a_tile_of_its_own(drive, folder, tmp_path):
    away = np.eye(4)
    away[:3, 3] = 1e7, -2e7, 100
    scans = [*drive, Scan(drive.points[0], away @ drive.poses[0], drive.intensities[0])]
    city = tiles_of(scans, tmp_path / "city")
    far = [tile for tile in city.tiles if tile.tile[0] > 100_000]
    assert far
    assert len(city.tiles) == len(Plan.load(folder).tiles) + len(far)
    returns = scans[-1].world_points
    seen = city.observed(returns)
    assert seen.mean() > 0.5
    step = city.sdf(returns[seen] + [1e-3, 0, 0]) - city.sdf(returns[seen])
    assert 0.2e-3 < np.median(np.abs(step)) < 5e-3  # a millimetre matters, 20,000 km from the world origin


def test_impossible_plans_are_rejected(tmp_path, drive):
    with pytest.raises(ValueError, match="there are no scans"):
        tiles_of([], tmp_path / "a")
    (tmp_path / "thesis.tex").touch()
    with pytest.raises(ValueError, match="holds other files"):
        tiles_of(drive, tmp_path)
    with pytest.raises(TypeError, match="scan 0 is ndarray"):
        tiles_of([np.zeros((3, 3))], tmp_path / "a")
    with pytest.raises(ValueError, match="no return of any scan lies within the ranges"):
        tiles_of(drive, tmp_path / "b", config=FitConfig.quick(returns={"min_range_m": 5000}))
    with pytest.raises(ValueError, match=r"halo, 25\.6 m, is larger"):
        tiles_of(drive, tmp_path / "c", halo=25.6)


@pytest.mark.parametrize(
    ("values", "said"),
    [({"T_world_sensor": None}, "has no pose"), ({"intensities": None}, "is not like those before")],
)
def test_a_bad_scan_is_named(drive, tmp_path, values, said):
    with pytest.raises(ValueError, match=f"scan 7 {said}"):
        tiles_of(changed(drive, 7, **values), tmp_path / "city")
    assert not (tmp_path / "city" / "plan.json").exists()
    assert tiles_of(drive, tmp_path / "city").missing == {}  # and the folder can be used again


def test_unusable_scans_are_excluded(drive, tmp_path):
    empty = {"points": np.zeros((0, 3)), "intensities": np.zeros(0)}
    nowhere = np.full((4, 4), np.nan)
    scans = changed(changed(drive, 7, T_world_sensor=nowhere), 3, **empty)
    assert tiles_of(scans, tmp_path / "city").missing == {}
    half = [
        dataclasses.replace(scan, T_world_sensor=nowhere) if i > 5 else scan for i, scan in enumerate(drive)
    ]
    with pytest.raises(ValueError, match="6 of 12 poses are not rigid transforms, the first is pose 6"):
        tiles_of(half, tmp_path / "half")
