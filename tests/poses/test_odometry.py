"""Poses of simulated drives, from measurements of radar and gyroscope alone."""

import numpy as np
import pytest
import radarsdf
from radarsdf import FitConfig
from radarsdf.io import Imu
from radarsdf.poses.rigid import aligned, between, turned_by
from radarsdf.simulate import drifted, measured_motion

from scenes.kinds import KINDS

from ..conftest import recorded_file
from .drift import first, measured, normalised_errors, position_error_m, thinned

BIAS_RAD_S = (0.01, -0.02, 0.03)


@pytest.fixture(scope="module")
def drive():
    """A third of a lap."""
    return thinned(first(radarsdf.simulate.oculii, 40, seed=62, frames=120), 2)


@pytest.fixture(scope="module")
def motion(drive):
    return measured_motion(drive, gyroscope_bias_rad_s=BIAS_RAD_S)


@pytest.fixture(scope="module")
def scans(drive):
    return measured(drive, gyroscope_bias_rad_s=BIAS_RAD_S)


@pytest.fixture(scope="module")
def found(drive, motion):
    return radarsdf.odometry(drive.points, doppler_mps=motion.doppler_mps, times_s=motion.times_s)


def gyroscope(motion):
    """In the axes of the radar."""
    return Imu(motion.times_s, motion.angular_velocity, R_sensor_imu=np.eye(3))


def length_m(poses):
    return np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum()


def errors(poses, true):
    """RMS errors of positions, m, and rotations, rad, after rigid alignment."""
    at = aligned(poses, true)
    return position_error_m(at, true), float(np.sqrt((turned_by(at, true) ** 2).mean()))


def test_returns_alone_are_not_counted_twice():
    """Steps tracked by the same returns are not independent evidence: NEES / 3 was 8 and more."""
    street = first(radarsdf.simulate.oculii, 20, seed=6, frames=30)
    found = radarsdf.odometry(street.points, times_s=measured_motion(street).times_s)
    assert 0.1 < np.median(normalised_errors(found, street.poses)) < 3


def test_errors_of_tracked_steps_do_not_persist():
    """Tracked steps as measurements left an error of 0.084 m."""
    street = first(radarsdf.simulate.hugin, 15, seed=6, frames=30)
    found = radarsdf.odometry(street.points, times_s=measured_motion(street).times_s)
    assert errors(found.poses, street.poses)[0] < 0.05


def test_damped_rolls_are_not_expected():
    """A motion prior of tracked rates, which returns hardly measure, left 0.6 degrees."""
    lap = measured(first(radarsdf.simulate.oculii, 70, seed=2), seed=2)
    assert errors(radarsdf.odometry(lap).poses, lap.poses)[1] < np.radians(0.5)


def test_a_scan_without_a_clear_match_is_not_lost_if_its_velocity_is_known():
    street = measured(radarsdf.simulate.astyx(seed=6), seed=6)
    found = radarsdf.odometry(street)
    assert found.report["segments"] == 1
    assert errors(found.poses, street.poses)[0] < 0.03


def test_planes_of_few_returns_are_coarse():
    """Regression: fine planes hardly constrained steps of 15 degrees, and the prior flattened them: an error of 0.5 m."""
    hall = measured(KINDS["hall"](seed=1, frames=24), seed=1)
    assert errors(radarsdf.odometry(hall).poses, hall.poses)[0] < 0.1


@pytest.mark.parametrize(("kind", "seed"), [("car_park", 5), ("hall", 4)])
def test_loops_close_only_where_returns_agree(kind, seed):
    """The car park was open by 1.95 m. The last scans in the hall also match walls 6.7 m away from their own."""
    lap = KINDS[kind](seed=seed)
    found = radarsdf.odometry(lap.points, times_s=measured_motion(lap, seed=seed).times_s)
    off = lap.poses[0] @ np.linalg.inv(found.poses[0]) @ found.poses[-1] - lap.poses[-1]
    assert np.linalg.norm(off[:3, 3]) < 0.2


def test_poses_are_estimated_from_doppler_and_returns(drive, found):
    position_m, turn_rad = errors(found.poses, drive.poses)
    assert position_m < 0.003 * length_m(drive.poses)
    assert turn_rad < 0.02
    assert found.report["segments"] == 1
    assert found.report["length_m"] == pytest.approx(length_m(drive.poses), rel=0.01)
    assert found.report["doppler_sign"] == 1
    assert 0.04 < found.report["moving"] / sum(map(len, drive.points)) < 0.2


def test_errors_agree_with_the_covariance(drive, found):
    assert 0.2 < np.mean(normalised_errors(found, drive.poses)) < 5


def test_a_gyroscope_measures_rotations_and_its_bias_is_estimated(drive, motion, scans, found):
    with_it = radarsdf.odometry(scans, imu=gyroscope(motion))
    assert errors(with_it.poses, drive.poses)[1] < errors(found.poses, drive.poses)[1]
    np.testing.assert_allclose(with_it.report["gyroscope_bias"], BIAS_RAD_S, atol=0.006)
    assert with_it.report["gyroscope"]


def test_the_sign_and_the_folds_of_the_doppler_do_not_matter(drive):
    folded = measured(drive, interval_mps=6.0, gyroscope_bias_rad_s=BIAS_RAD_S).select(range(20))
    assert max(np.abs(speeds).max() for speeds in folded.doppler_mps) <= 3.0 + 1e-6
    turned = radarsdf.odometry(folded, doppler_mps=[-speeds for speeds in folded.doppler_mps])
    assert turned.report["doppler_sign"] == -1
    assert errors(turned.poses, folded.poses)[0] < 0.005 * length_m(folded.poses)


def test_a_gap_is_bridged(scans):
    parts = scans.select(np.r_[0:12, 18:28])
    found = radarsdf.odometry(parts)
    assert found.report["segments"] == 1
    assert errors(found.poses, parts.poses)[0] < 0.005 * length_m(parts.poses)


def test_a_discontinuous_drive_has_two_segments(drive):
    other = measured(first(radarsdf.simulate.hugin, 10, seed=63, frames=20))
    before = measured(drive).select(range(12))
    times_s, speeds = np.r_[before.times_s, other.times_s + 60], before.doppler_mps + other.doppler_mps
    found = radarsdf.odometry(before.points + other.points, doppler_mps=speeds, times_s=times_s)
    assert found.segments.tolist() == [0] * 12 + [1] * 10
    assert "lost before the scans 12: 2 segments" in found.report["verdict"]
    assert found.longest_segment() == slice(0, 12)
    assert errors(found.poses[12:], other.poses)[0] < 0.1


def test_scans_suffice_if_they_observe_the_motion(scans):
    part = scans.select(range(20))
    found = radarsdf.odometry(part.points, times_s=part.times_s)
    assert not found.report["doppler"]
    assert errors(found.poses, part.poses)[0] < 0.01 * length_m(part.poses)


def test_a_single_wall_is_rejected():
    wall = measured(first(radarsdf.simulate.wall, 14, seed=5, frames=40))
    with pytest.raises(ValueError, match="returns alone do not observe"):
        radarsdf.odometry(wall.points, times_s=np.arange(14) / 10)
    assert errors(radarsdf.odometry(wall).poses, wall.poses)[0] < 0.05


def test_a_pattern_that_moves_with_the_sensor_is_not_evidence_of_standing():
    rng = np.random.default_rng(3)
    pattern = rng.uniform([3, -8, -1], [15, 8, 4], (500, 3))
    scans = [pattern + rng.normal(0, 0.02, pattern.shape) for _ in range(10)]
    notes = radarsdf.odometry(scans, times_s=0.1 * np.arange(10)).report["notes"]
    assert any("as well without any motion" in note for note in notes)


def test_too_few_returns_of_a_turning_sensor_are_rejected(drive, motion):
    few = [scan[:: max(1, len(scan) // 20)] for scan in drive.points]
    speeds = [v[:: max(1, len(v) // 20)] for v in motion.doppler_mps]
    with pytest.raises(ValueError, match="how the sensor turned"):
        radarsdf.odometry(few, doppler_mps=speeds, times_s=motion.times_s)
    found = radarsdf.odometry(few, doppler_mps=speeds, times_s=motion.times_s, imu=gyroscope(motion))
    assert found.report["length_m"] == pytest.approx(length_m(drive.poses), rel=0.05)


def test_the_bits_do_not_depend_on_threads(scans):
    part, settings = scans.select(range(8)), [FitConfig(num_threads=threads) for threads in (1, 3)]
    one, three = (radarsdf.odometry(part, config=config) for config in settings)
    np.testing.assert_array_equal(one.poses, three.poses)
    np.testing.assert_array_equal(one.covariance, three.covariance)


@pytest.mark.parametrize("counts", [[40], [1, 1], [3, 200, 1]])
def test_very_few_returns_give_finite_poses_or_a_clear_error(counts):
    rng = np.random.default_rng(1)
    scans = [rng.normal(0, 3, (n, 3)) for n in counts]
    speeds = [rng.normal(0, 1, n) for n in counts]
    try:
        found = radarsdf.odometry(scans, doppler_mps=speeds, times_s=np.arange(len(counts)))
    except ValueError as error:
        assert "returns alone do not observe" in str(error)  # noqa: PT017 - where the Doppler tells no velocity
    else:
        assert np.isfinite(found.poses).all()
        assert found.covariance.shape == (len(counts), 6, 6)


def test_doppler_improves_refined_poses(drive, motion):
    given = drifted(drive.poses[:24], 0.05, 0.004, 1)
    plain, by_doppler = (
        radarsdf.refine_poses(drive.points[:24], given, times_s=motion.times_s[:24], doppler_mps=speeds)
        for speeds in (None, [-speeds for speeds in motion.doppler_mps[:24]])
    )
    assert by_doppler.improved
    assert by_doppler.report["moving"] > 0
    assert errors(by_doppler.poses, drive.poses[:24])[0] < 0.5 * errors(plain.poses, drive.poses[:24])[0]


def test_wrong_arguments_are_refused(drive, motion):
    points, speeds, times = drive.points[:4], motion.doppler_mps[:4], motion.times_s[:4]
    for wrong, named in (
        ({"times_s": None, "doppler_mps": None}, "times_s are missing"),
        ({"times_s": None}, "Doppler needs times"),
        ({"times_s": times * 1e300}, "^times_s "),
        ({"doppler_mps": speeds[:3]}, "doppler_mps"),
    ):
        with pytest.raises(ValueError, match=named):
            radarsdf.odometry(points, **{"doppler_mps": speeds, "times_s": times} | wrong)


RETURNS = 40


def road(seed, rate_rad_s=0.0, speed_mps=25.0, elevation_deg=5.0, scans=40):
    """Scans, Doppler, times and poses of a radar of 28 by 10 degrees on a road between fences; 15 % of the returns move."""
    rng, times_s = np.random.default_rng(seed), np.arange(scans) / 15
    yaw = rate_rad_s * times_s
    poses = np.tile(np.eye(4), (scans, 1, 1))
    poses[:, :2, :2] = np.moveaxis([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]], 2, 0)
    middle = yaw[:-1] + rate_rad_s / 30
    poses[1:, :2, 3] = speed_mps / 15 * np.cumsum(np.column_stack([np.cos(middle), np.sin(middle)]), axis=0)
    fence = np.column_stack(
        [
            rng.uniform(0, 250 + poses[-1, 0, 3], 40_000),
            rng.choice([-30, -9, 9, 30], 40_000),
            rng.uniform(-1, 6, 40_000),
        ]
    )
    points, doppler_mps = [], []
    for pose in poses:
        seen = (fence - pose[:3, 3]) @ pose[:3, :3]
        ranges = np.linalg.norm(seen, axis=1)
        azimuth, elevation = np.arctan2(seen[:, 1], seen[:, 0]), np.arcsin(seen[:, 2] / ranges)
        inside = (np.abs(azimuth) < np.radians(14)) & (np.abs(elevation) < np.radians(5)) & (ranges < 150)
        chosen = rng.choice(np.flatnonzero(inside), RETURNS, replace=False)
        azimuth, elevation = azimuth[chosen], elevation[chosen] * elevation_deg / 5
        speeds = -speed_mps * np.cos(elevation) * np.cos(azimuth) + rng.normal(0, 0.07, RETURNS)
        speeds += np.where(rng.random(RETURNS) < 0.15, rng.uniform(2, 20, RETURNS), 0)
        azimuth, elevation = (
            azimuth + rng.normal(0, 0.004, RETURNS),
            elevation + rng.normal(0, 0.002 * elevation_deg, RETURNS),
        )
        level = np.cos(elevation)
        directions = np.column_stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])
        points.append(directions * (ranges[chosen] + rng.normal(0, 0.2, RETURNS))[:, None])
        doppler_mps.append(speeds)
    return points, doppler_mps, times_s, poses


def deviations(found, true):
    """Errors (F, 3) of positions relative to the middle scan, in its axes and in standard deviations."""
    middle = len(true) // 2
    at, of = (between(np.tile(poses[middle], (len(true), 1, 1)), poses) for poses in (found.poses, true))
    R = found.poses[middle, :3, :3]
    variances = np.einsum("ji,fjk,ki->fi", R, found.covariance[:, :3, :3], R)
    others = np.arange(len(true)) != middle
    return ((at - of)[:, :3, 3])[others] / np.sqrt(variances[others])


def end_error_m(found, true):
    """Horizontal error at the end, m, after alignment of the first poses."""
    ends = [between(poses[:1], poses[-1:])[0, :2, 3] for poses in (found.poses, true)]
    return float(np.linalg.norm(ends[0] - ends[1]))


@pytest.mark.parametrize("name", ["F_LRR_C", "B_LRR_C"])
def test_poses_of_radars_on_a_motorway_are_estimated(name):
    with np.load(recorded_file("aimotive_motorway/radar.npz")) as data:
        borders = np.cumsum(data[f"{name}_counts"])[:-1]
        points, doppler_mps = (
            np.split(data[f"{name}_{what}"], borders) for what in ("points", "doppler_mps")
        )
        times_s, true = data["times_s"], data[f"{name}_poses"]
    found = radarsdf.odometry(points, doppler_mps=doppler_mps, times_s=times_s)
    assert found.report["segments"] == 1
    assert found.report["length_m"] == pytest.approx(98, abs=1)
    assert end_error_m(found, true) < 1.0
    assert np.abs(deviations(found, true)[:, :2]).max() < 4
    assert any(note.startswith("Assumed: the sensor turns") for note in found.report["notes"])


@pytest.mark.parametrize("rate_rad_s", [0.0, 0.15])
def test_errors_of_a_narrow_radar_are_in_its_covariance(rate_rad_s):
    """Its returns do not observe rotations, so that bends have the prior's errors: 0.15 rad/s are two deviations."""
    points, doppler_mps, times_s, true = road(1, rate_rad_s, scans=24)
    found = radarsdf.odometry(points, doppler_mps=doppler_mps, times_s=times_s)
    assert found.report["segments"] == 1
    assert np.abs(deviations(found, true)).max() < 4
    if rate_rad_s == 0:
        assert end_error_m(found, true) < 0.5


def test_a_radar_without_elevation_has_a_prior_of_small_climbs():
    points, doppler_mps, times_s, true = road(2, elevation_deg=0.0, scans=18)
    assert all((scan[:, 2] == 0).all() for scan in points)
    found = radarsdf.odometry(points, doppler_mps=doppler_mps, times_s=times_s)
    assert "18 of 18 scans" in found.report["notes"][0]
    assert end_error_m(found, true) < 0.5
    assert np.abs(deviations(found, true)[:, :2]).max() < 4


def test_errors_name_the_missing_measurements():
    points, doppler_mps, times_s, _ = road(4, speed_mps=10.0, scans=12)
    with pytest.raises(ValueError, match="how the sensor turned") as refused:
        radarsdf.odometry(points, doppler_mps=doppler_mps, times_s=times_s)
    assert "Give a gyroscope" in str(refused.value)
    assert "doppler_mps" not in str(refused.value)
    rng = np.random.default_rng(5)
    doppler_mps = [rng.uniform(-20, 20, len(scan)) for scan in points]
    with pytest.raises(ValueError, match="how the sensor moved") as refused:
        radarsdf.odometry(points, doppler_mps=doppler_mps, times_s=times_s)
    assert "Give their Doppler" not in str(refused.value)
    assert "0 of 12 scans agree on a velocity of the sensor" in str(refused.value)
