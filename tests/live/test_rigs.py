"""Live maps of several radars: tracking of the body, sums at the poses of the radars, and files."""

import contextlib
from dataclasses import replace

import numpy as np
import pytest
import radarsdf
from radarsdf import FitConfig, LiveMap
from radarsdf.interrupts import at_once
from radarsdf.live.sums import RadarSums
from radarsdf.poses.consistency import Consistency
from radarsdf.poses.rigid import aligned
from radarsdf.poses.search import Lost
from radarsdf.returns.evidence import BLOCK_BITS
from radarsdf.returns.noise import RigNoise, SensorNoise
from radarsdf.returns.rays import prepare
from radarsdf.returns.sums import WEIGHT_UNIT, MeanRays, ScanSums
from radarsdf.simulate import simulate_rig

from scenes.kinds import KINDS
from scenes.rigs import FRAME_S, drive_of_rig, three_radars


@pytest.fixture(scope="module")
def scans():
    return drive_of_rig(radarsdf.simulate.hugin(seed=6, frames=16), seed=2).scans


def three_at_20_hz(drive, frames, apart_s=0.0):
    """Scans of three radars that begin `apart_s` after each other."""
    radars = enumerate(three_radars(drive.sensor).items())
    radars = {label: replace(radar, rate_hz=20.0, first_s=apart_s * k) for k, (label, radar) in radars}
    return simulate_rig(drive.scene, radars, drive.poses[:frames], FRAME_S * np.arange(frames)).scans


def integrate(live, scans, i, pose=None):
    known = {"doppler_mps": scans.doppler_mps[i], "time_s": scans.times_s[i], "sensor": scans.sensors[i]}
    return live.integrate(scans.points[i], pose, scans.intensities[i], **known, scan_id=i)


def test_scans_at_poses_of_the_body_are_those_of_a_fit(scans, tmp_path):
    config = FitConfig.quick()
    live = LiveMap(config, T_body_sensor=scans.T_body_sensor, folder=tmp_path / "scans", max_bytes=200_000)
    for i in range(8):
        integrate(live, scans, i, scans.poses[i])
        if i == 3:
            live.mesh()  # estimates the noise of each radar, and again with twice as many scans
    weighted = live.map().mesh(config.leaf_size_m)
    meshes = (np.unique(mesh.vertices, axis=0) for mesh in (live.mesh(), weighted))
    np.testing.assert_array_equal(*meshes)
    chosen = scans.select(range(8))
    fitted = radarsdf.fit(chosen, config=config)
    vertices = fitted.mesh(0.2).vertices
    np.testing.assert_array_equal(live.finish().mesh(0.2).vertices, vertices)
    # Poses of the radars are rounded otherwise. In the unit of another radar, intensities would have errors of 6 dB.
    seen = [of.intensity(vertices, scans.poses[0, :3, 3], sensor="rear") for of in (live.map(), fitted)]
    assert np.nanmax(np.abs(seen[0] - seen[1])) < 0.1
    assert np.nanmax(np.abs(live.map().sdf(vertices))) < 1e-3
    live.save(tmp_path / "live.npz")
    loaded = LiveMap.load(tmp_path / "live.npz", folder=tmp_path / "others")
    assert (loaded.mesh().vertices == live.mesh().vertices).all()
    loaded.remove(3)
    live.remove(3)
    assert (loaded.mesh().vertices == live.mesh().vertices).all()
    more = [integrate(each, scans, 8).pose for each in (loaded, live)]
    np.testing.assert_allclose(*more, atol=0.05)


def test_the_noise_of_radars_that_take_turns_is_that_of_each(scans, monkeypatch):
    """Regression: every second scan was sampled, all of one radar."""
    monkeypatch.setattr("radarsdf.live.state._NOISE_RETURNS", 6000)
    rows = [[i for i, label in enumerate(scans.sensors) if label == own][:8] for own in ("front", "rear")]
    live = LiveMap(FitConfig.quick(), T_body_sensor=scans.T_body_sensor)
    for i in np.ravel(rows, order="F").tolist():
        integrate(live, scans, i, scans.poses[i])
    live.mesh()
    front, rear, _ = live._state.noise.of_sensors
    assert rear.range_m > 1.5 * front.range_m  # twice, by construction


@pytest.mark.parametrize(
    ("kind", "seed", "count", "apart_s"), [("yard", 0, 90, 0.0), ("forest", 1, 200, 0.017)]
)
def test_the_body_is_tracked_by_radars_whose_scans_are_close(kind, seed, count, apart_s):
    """Narrow radars seemed to contradict right Doppler from 8 scans, and differences of their maps were taken for turns in pitch."""
    scans = three_at_20_hz(KINDS[kind](seed=seed), count // 6 + 3, apart_s)
    live = LiveMap(T_body_sensor=scans.T_body_sensor)
    for i in range(count):
        integrate(live, scans, i)
    placed = aligned(np.stack([live.pose(i) for i in range(count)]), scans.poses[:count])
    assert np.linalg.norm((placed - scans.poses[:count])[:, :3, 3], axis=1).max() < 0.1


def test_a_slow_rig_is_tracked_from_the_start():
    """Regression: before the sign of the Doppler was known, scans that returns alone do not place were refused, also all later ones."""
    scans = three_at_20_hz(radarsdf.simulate.oculii(seed=2), 12, apart_s=0.017)
    live = LiveMap(T_body_sensor=scans.T_body_sensor)
    for i in range(50):
        with contextlib.suppress(Lost):
            integrated = integrate(live, scans, i)
    ids = list(live.scan_ids)
    named = {note.split(":")[0] for note in integrated.notes}
    assert named == set(scans.sensors)  # the Doppler of all moved the body
    placed = aligned(np.stack([live.pose(i) for i in ids]), scans.poses[ids])
    assert len(ids) > 45
    assert np.linalg.norm((placed - scans.poses[ids])[:, :3, 3], axis=1).max() < 0.05


def test_comparisons_of_doppler_are_spread_over_scans(monkeypatch):
    """They took 60 to 100 ms of a single scan."""
    scans, steps = three_at_20_hz(KINDS["yard"](seed=0), 15, 0.017), []
    compare = Consistency.in_steps

    def recorded(*given):
        for found in compare(*given):
            steps.append(found)
            yield found

    monkeypatch.setattr(Consistency, "in_steps", recorded)
    live = LiveMap(T_body_sensor=scans.T_body_sensor)
    for i in range(44):
        count = len(steps)
        notes = integrate(live, scans, i).notes
        assert len(steps) <= count + 1
    assert any(steps)
    assert {note.split(":")[0] for note in notes} == set(scans.sensors)
    checks = live._follower._checks.values()
    before = {check.under_way for check in checks} - {None}
    integrate(live, scans, 44, live.pose(43))
    integrate(live, scans, 45)
    assert before.isdisjoint(check.under_way for check in checks)  # a given pose ends them
    assert before


def test_each_scan_needs_the_label_of_its_radar(scans):
    with pytest.raises(ValueError, match="sensor must be one of"):
        LiveMap(T_body_sensor=scans.T_body_sensor).integrate(scans.points[0], np.eye(4))
    with pytest.raises(ValueError, match="sensor must be one of"):
        LiveMap().integrate(scans.points[0], np.eye(4), sensor="front")


def test_scans_of_a_radar_far_from_the_body_are_sealed_beyond_a_ball():
    """Regression: the reach of returns was measured from the body, and the removal of the scan failed."""
    T_body_sensor = np.eye(4)
    T_body_sensor[0, 3] = 5.0
    live = LiveMap(FitConfig.quick(), T_body_sensor={"front": T_body_sensor})
    live.integrate(np.tile([10.0, 0, 0], (5, 1)) + 0.1 * np.arange(5)[:, None], np.eye(4), sensor="front")
    live.clear_outside([0, 0, 0], 12.0)
    assert live.sealed_scans == 1


def test_cells_with_very_many_returns_keep_their_mean():
    """The sums of two radars, weighted by their noise, exceed 64 bits after half an hour at one place."""
    sums, corner = (
        RadarSums(2),
        ScanSums.of(prepare([[[0.19, 0.01, 0.1]]], [np.eye(4)], origin=[0, 0, 0]), 0.2),
    )
    many = corner.sums * WEIGHT_UNIT * 10_000_000
    columns = corner.keys, many, np.ones(1, np.uint32), corner.keys >> BLOCK_BITS, np.ones(1, np.uint32)
    at_once(*sums.insert([columns, columns]))
    noises = SensorNoise(0.1, 0.01, 0.01), SensorNoise(0.05, 0.005, 0.005)
    found = sums.weighted(0.2, RigNoise(*noises[0].deviations, noises, (26, 102)))
    np.testing.assert_allclose(MeanRays.of_sums(found).points, [[0.19, 0.01, 0.1]], atol=1e-5)
    _, moments = found.merged_moments()
    np.testing.assert_allclose(moments[0, 4] / moments[0, 0], 0.19**2, rtol=1e-4)
