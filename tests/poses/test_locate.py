"""Scans found again in a map, sessions joined, and loops closed."""

import numpy as np
import pytest
import radarsdf
from radarsdf import FitConfig
from radarsdf.poses.rigid import increments, moved, transform
from radarsdf.simulate import hugin

from scenes.kinds import KINDS
from scenes.revisits import SYMMETRIC, another_day, sessions, weaker
from scenes.rigs import drive_of_rig

from ..conftest import recorded_file
from .drift import first as first_scans
from .drift import measured

FEW = 12  # scans, of the 24 of another day: enough for two submaps


def fitted(first):
    return radarsdf.fit(first.points, first.poses, config=FitConfig.quick(), progress=False)


def located(radar_map, day, count=None, **more):
    return radarsdf.locate(radar_map, measured(day).select(range(len(day))[:count]), **more)


def errors(found, true):
    """Position errors, m, and angles, degrees."""
    off = increments(true, found)
    return np.linalg.norm(off[:, :3], axis=1), np.degrees(np.linalg.norm(off[:, 3:], axis=1))


@pytest.fixture(scope="module")
def first():
    return hugin(seed=1, frames=60)


@pytest.fixture(scope="module")
def radar_map(first):
    return fitted(first)


@pytest.fixture(scope="module")
def index(radar_map):
    return radarsdf.SurfaceIndex.of(radar_map)


@pytest.fixture(scope="module")
def day(first):
    return another_day(first, 1)


@pytest.fixture(scope="module")
def found(index, day):
    return located(index, day)


@pytest.fixture(scope="module")
def elsewhere():
    return first_scans(KINDS["yard"], FEW, seed=3, frames=24)


def test_scans_of_another_day_are_found_in_the_whole_map(found, day):
    off_m, off_deg = errors(found.poses, day.poses)
    assert np.median(off_m) < 0.05
    assert np.median(off_deg) < 0.3
    assert (found.segments == 0).all()
    assert found.explained.min() > 0.3
    sigmas = np.sqrt(found.covariance[:, :3, :3].trace(axis1=1, axis2=2))
    assert np.median(off_m / sigmas) < 3


@pytest.mark.parametrize("how", ["weaker", "reverse"])
def test_another_radar_and_the_other_direction(first, index, how):
    changed = {"sensor": weaker(first.sensor)} if how == "weaker" else {"reverse": True}
    other = another_day(first, 1, **changed)
    off_m, off_deg = errors(located(index, other).poses, other.poses)
    assert np.median(off_m) < 0.1
    assert np.median(off_deg) < 0.6


def test_a_saved_map_and_a_turned_world(first, day, tmp_path):
    # The pose of the frame of the odometry has nothing to do with that of the map.
    T = moved(np.eye(4), np.array([5e5, 5.4e6, 300.0, 0, 0, 2.0]))
    turned = radarsdf.fit(first.points, T @ first.poses, config=FitConfig.quick(), progress=False)
    turned.save(tmp_path / "map.safetensors")
    found = located(radarsdf.load(tmp_path / "map.safetensors"), day, FEW)
    assert np.median(errors(found.poses, T @ day.poses[:FEW])[0]) < 0.05


@pytest.mark.parametrize("name", list(SYMMETRIC))
def test_symmetric_places_are_refused(name):
    place = SYMMETRIC[name](seed=2, frames=30)
    with pytest.raises(radarsdf.Lost, match="two places") as refused:
        located(fitted(place), first_scans(another_day, FEW, place, 2))
    assert refused.value.places.shape == (2, 4, 4)


def halves(first, seed, **more):
    """The map of the first half of a drive, and scans of another day in the second half."""
    half = len(first) // 2
    mapped = radarsdf.fit(first.points[:half], first.poses[:half], config=FitConfig.quick(), progress=False)
    return mapped, another_day(first, seed, stretch=(0.5, 1.0), **more)


def test_the_unmapped_half_of_a_hall_is_not_found_in_the_other():
    # Its corner fits the mapped one, but the walls inside do not.
    mapped, day = halves(KINDS["hall"](seed=4, frames=60), 4, reverse=True)
    with pytest.raises(radarsdf.Lost):
        located(mapped, day)


@pytest.mark.parametrize("place", [hugin, KINDS["slope"]])
def test_scans_at_the_end_of_a_map_are_found(place):
    mapped, day = halves(place(seed=1, frames=60), 1)
    found = located(mapped, day)
    known = found.segments >= 0
    assert known[:FEW].all()
    assert errors(found.poses[known], day.poses[known])[0].max() < 0.1


def test_scans_of_another_place_are_refused(index, elsewhere):
    with pytest.raises(radarsdf.Lost):
        located(index, elsewhere)


NEAR = np.array([0.2, -0.2, 0.1, 0.01, 0, 0.03])


def test_a_guess_replaces_the_search():
    tunnel = KINDS["tunnel"](seed=2, frames=40)
    day = another_day(tunnel, 2)
    index = radarsdf.SurfaceIndex.of(fitted(tunnel))
    with pytest.raises(radarsdf.Lost):
        located(index, day, FEW)
    found = located(index, day, guess=moved(day.poses[0], NEAR))
    off = np.abs(increments(day.poses, found.poses)[:, :3])
    sigmas = np.sqrt(np.einsum("fii->fi", found.covariance)[:, :3])
    assert np.median(off / sigmas) < 3
    assert np.median(errors(found.poses, day.poses)[0]) < 0.5


def test_a_wrong_guess_is_refused(index, day):
    right = located(index, day, FEW, guess=moved(day.poses[0], NEAR))
    assert np.median(errors(right.poses, day.poses[:FEW])[0]) < 0.05
    for off in ([15.0, 0, 0, 0, 0, 0], [0, -8.0, 0, 0, 0, 0.5], [0, 0, 0, 0, 0, 3.0]):
        with pytest.raises(radarsdf.Lost, match="guess"):
            located(index, day, 6, guess=moved(day.poses[0], np.array(off)))


def test_a_guess_that_returns_do_not_confirm_is_not_sure(index, elsewhere):
    guess = moved(elsewhere.poses[0], np.array([30.0, 0, 0, 0, 0, 0]))
    one = located(index, elsewhere, 1, guess=guess)
    for found in (located(index, elsewhere, guess=guess), one):
        assert any("guess" in note for note in found.report["notes"])
        assert (np.sqrt(np.einsum("fii->fi", found.covariance)[:, :2]) >= 0.5).all()


def kidnapped(first, index, begin, counts):
    """A drive moved to the share `begin` of its path after the first of `counts` scans: as located, and true poses."""
    parts = zip(counts, (0.0, begin), strict=True)
    drives = [first_scans(another_day, count, first, 1, stretch=(s, s + 0.3)) for count, s in parts]
    one, other = map(measured, drives)
    times_s = np.concatenate([one.times_s, one.times_s[-1] + 0.1 + other.times_s])
    speeds = one.doppler_mps + other.doppler_mps
    found = radarsdf.locate(index, one.points + other.points, doppler_mps=speeds, times_s=times_s)
    return found, np.concatenate([drive.poses for drive in drives])


@pytest.mark.parametrize(
    ("begin", "counts"), [(0.7, (FEW, FEW)), (0.173, (FEW, FEW)), (0.237, (15, 9)), (0.3, (8, 16))]
)
def test_a_kidnapped_radar_is_found_again(first, index, begin, counts):
    # After 12 scans by 43 and 1 m, after 15 by 2.5 m, after 8 by 12 m.
    found, true = kidnapped(first, index, begin, counts)
    known, early = found.segments >= 0, counts[0]
    assert errors(found.poses[known], true[known])[0].max() < 0.5
    assert known[:early].mean() > 0.8
    assert known[early:].mean() > 0.8
    assert not set(found.segments[early:][known[early:]]) & set(found.segments[:early][known[:early]])


def test_sessions_are_joined_or_apart():
    of_place = sessions("hugin", 4)

    def scans(day, posed):
        poses = day.poses if posed else np.full((len(day), 4, 4), np.nan)
        return measured(day).with_poses(poses)

    together = [scans(day, posed=i == 0) for i, day in enumerate(of_place.together)]
    found = radarsdf.join(together)
    assert found.report["joined"] == [0, 1, 2]
    for poses, day in zip(found.poses, of_place.together, strict=True):
        assert np.median(errors(poses, day.poses)[0]) < 0.05
    assert errors(found.poses[0], of_place.together[0].poses)[0].max() < 1e-2  # true poses do not bend
    found = radarsdf.join([scans(day, posed=False).select(range(FEW)) for day in of_place.apart])
    assert found.verdicts[0, 1] != "joined"
    assert np.isnan(found.poses[1]).all()


def test_sessions_of_a_rig_keep_their_true_poses():
    days = [drive_of_rig(day, seed=i).scans for i, day in enumerate(sessions("hugin", 1).together[:2])]
    away = transform(np.array([0, 0, 0.7]), np.array([5.0, -3.0, 0.4]))
    found = radarsdf.join([days[0], days[1].with_poses(away @ days[1].poses)])
    for poses, day in zip(found.poses, days, strict=True):
        assert errors(poses, day.poses)[0].max() < 0.05


def test_the_second_arc_of_a_recorded_roundabout():
    arrays = np.load(recorded_file("astyx/r0144_0167.npz"))
    rows = [np.flatnonzero((arrays["frame"] == i) & arrays["static"]) for i in range(len(arrays["poses"]))]
    scans = [arrays["points"][of_scan].astype(np.float64) for of_scan in rows]
    radar_map = radarsdf.fit(scans[:11], arrays["poses"][:11], config=FitConfig.quick(), progress=False)
    guess = moved(arrays["poses"][11], np.array([0.2, 0.2, 0.1, 0, 0, 0.02]))
    speeds = [arrays["doppler"][of_scan] for of_scan in rows[11:]]
    later = {"doppler_mps": speeds, "times_s": arrays["times"][11:]}
    found = radarsdf.locate(radar_map, scans[11:], **later, guess=guess)
    off_m, off_deg = errors(found.poses, arrays["poses"][11:])

    assert np.median(off_m) < 0.3
    assert np.median(off_deg) < 2


def test_motion_that_returns_do_not_observe_is_refused_with_a_guess():
    along = radarsdf.simulate.wall(frames=24)
    radar_map = radarsdf.fit(along.points, along.poses, config=FitConfig.quick(), progress=False)
    with pytest.raises(ValueError, match="do not observe how the sensor moved"):
        radarsdf.locate(radar_map, along.points, times_s=0.1 * np.arange(24), guess=along.poses[0])


def test_a_live_map_of_another_session_finds_the_radar(first, day, tmp_path):
    live = radarsdf.LiveMap()
    for scan in measured(first):
        live.integrate(scan.points, scan.T_world_sensor, doppler_mps=scan.doppler_mps, time_s=scan.time_s)
    live.save(tmp_path / "live.npz")
    live = radarsdf.LiveMap.load(tmp_path / "live.npz")
    lost, off_m = 0, []
    for i, scan in enumerate(measured(day)):
        try:
            found = live.integrate(scan.points, doppler_mps=scan.doppler_mps, time_s=86_400 + scan.time_s)
        except radarsdf.Lost:
            lost += 1
            continue
        off_m.append(errors(found.pose[None], day.poses[i : i + 1])[0][0])
    assert lost < 15
    assert np.max(off_m) < 0.15
    # With the first one that was found, those before it came into the map.
    assert len(live) == len(first) + len(day)


def test_the_index_of_a_map_is_saved(index, found, day, tmp_path):
    index.save(tmp_path / "index.npz")
    again = located(radarsdf.SurfaceIndex.load(tmp_path / "index.npz"), day)
    assert np.abs(found.poses - again.poses).max() < 1e-3
    content = bytearray((tmp_path / "index.npz").read_bytes())
    content[2000] ^= 255
    (tmp_path / "index.npz").write_bytes(content)
    with pytest.raises(ValueError, match=r"index\.npz"):
        radarsdf.SurfaceIndex.load(tmp_path / "index.npz")
