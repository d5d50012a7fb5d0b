"""Returns that move are left out, and only these: velocities by Doppler, folded or not measured."""

import numpy as np
import pytest
import radarsdf
from radarsdf import FitConfig
from radarsdf.checking.doppler import velocity_of_poses
from radarsdf.returns.moving import (
    folding_interval_mps,
    moving_returns,
    sensor_velocity,
    static_rays,
    without_filler,
)
from radarsdf.scans import Scans

from tests.conftest import recorded_scans

QUICK = {"training": {"sdf_iterations": 3, "intensity_iterations": 3}}


@pytest.fixture(scope="module")
def drive():
    """Scans with Doppler, and masks of the tenth of returns that move."""
    scans = radarsdf.simulate.wall(frames=12)
    velocities = velocity_of_poses(scans.poses, 0.1 * np.arange(12))
    rng = np.random.default_rng(0)
    doppler, moves = [], []
    for points, velocity in zip(scans.points, velocities, strict=True):
        moving = rng.random(len(points)) < 0.1
        away = points / np.linalg.norm(points, axis=1, keepdims=True)
        doppler.append(-away @ velocity + rng.normal(0, 0.04, len(points)) + 3.0 * moving)
        moves.append(moving)
    return scans, doppler, moves


def static(points, doppler, intensities=None):
    poses = np.tile(np.eye(4), (len(points), 1, 1))
    return static_rays(points, poses, intensities, doppler, None, FitConfig(returns={"min_range_m": 0}))


def test_moving_returns_are_found(drive):
    scans, doppler, moves = drive
    for sign in (1, -1):  # the sign differs between sensors
        masks, why_none = moving_returns(scans.points, [sign * values for values in doppler])
        assert why_none is None
        found_moving, true = np.concatenate(masks), np.concatenate(moves)
        assert found_moving[true].mean() > 0.99
        assert found_moving[~true].mean() < 0.01
        assert static(scans.points, [sign * values for values in doppler])[1] == found_moving.sum()


def test_a_fit_excludes_and_counts_moving_returns(drive):
    scans, doppler, _ = drive
    rays, expected, _ = static(scans.points, doppler)
    for given in (
        {"points": Scans(scans.points, scans.poses, scans.intensities, doppler_mps=doppler)},
        {
            "points": scans.points,
            "poses": scans.poses,
            "intensities": scans.intensities,
            "doppler_mps": doppler,
        },
    ):
        report = radarsdf.fit(**given, config=FitConfig(**QUICK), progress=False).report
        assert report["moving"] == expected
        assert report["returns"] == sum(map(len, scans.points))
        kept = report["returns_used"] + report["ghosts"]
        assert kept == report["returns"] - expected - (rays.ranges_m < 2.5).sum()
    config = FitConfig(**QUICK, returns={"drop_moving": False})
    kept_all = radarsdf.fit(scans.points, scans.poses, doppler_mps=doppler, config=config, progress=False)
    assert kept_all.report["moving"] == 0


def test_half_of_the_scans_must_agree_on_a_velocity(drive):
    scans, doppler, _ = drive
    rng = np.random.default_rng(2)
    noise = [rng.uniform(-20, 20, len(v)) for v in doppler]
    expected, _ = moving_returns(scans.points, doppler)
    found, why_none = moving_returns(scans.points, doppler[:6] + noise[6:])
    assert why_none is None
    for mask, agreeing in zip(found[:6], expected, strict=False):
        np.testing.assert_array_equal(mask, agreeing)
    assert not np.concatenate(found[6:]).any()
    # Scans of less than ten returns do not count.
    points = [*scans.points[:11], scans.points[11][:9]]
    assert moving_returns(points, [*doppler[:6], *noise[6:11], doppler[11][:9]])[1] is None
    _, *lost = static(scans.points, doppler[:5] + noise[5:])
    assert lost == [0, "only 5 of 12 scans agree on a velocity of the sensor"]


def test_inconsistent_doppler_excludes_no_returns(drive):
    scans, doppler, _ = drive
    rng = np.random.default_rng(1)
    noise = [rng.uniform(-20, 20, len(v)) for v in doppler]
    # Half of the returns have lost their Doppler, and would all be classified as moving.
    mostly = [np.where(rng.random(len(v)) < 0.5, v, 37.0 + rng.uniform(-20, 20, len(v))) for v in doppler]
    for values, why in ((noise, "scans agree on a velocity"), (mostly, "of the returns disagree")):
        _, moving, why_none = static(scans.points, values)
        assert moving == 0
        assert why in why_none
        report = radarsdf.fit(
            scans.points, scans.poses, doppler_mps=values, config=FitConfig(**QUICK), progress=False
        ).report
        assert any(line.startswith("leaving out what moves: ") for line in report["skipped"])


def test_intensities_stay_with_their_returns(drive):
    scans, doppler, _ = drive
    rays, _, _ = static(scans.points, doppler, scans.intensities)
    masks, _ = moving_returns(scans.points, doppler)
    kept = [values[~mask] for values, mask in zip(scans.intensities, masks, strict=True)]
    np.testing.assert_array_equal(rays.intensities, np.concatenate(kept))


@pytest.mark.parametrize("name", ["r0009_0024", "r0057_0068", "r0133_0142", "r0144_0167", "r0309_0320"])
def test_moving_returns_of_recorded_drives_agree_with_their_flags(name):
    with np.load(recorded_scans(name)) as file:
        rows = [np.flatnonzero(file["frame"] == i) for i in range(len(file["poses"]))]
        points, doppler, flags_of = ([file[k][r] for r in rows] for k in ("points", "doppler", "static"))
    masks, why_none = moving_returns(points, doppler)
    wrong = np.concatenate(
        [found_moving == flags for found_moving, flags in zip(masks, flags_of, strict=True)]
    )
    assert why_none is None
    assert wrong.mean() < 0.1


@pytest.fixture
def directions():
    return [np.random.default_rng(k).normal(size=(80, 3)) for k in range(5)]


def speeds_of(directions, velocity_mps, step_mps):
    return [step_mps * np.round(-d @ velocity_mps / np.linalg.norm(d, axis=1) / step_mps) for d in directions]


@pytest.mark.parametrize("filler", [0.0, -128.0])
@pytest.mark.parametrize("share", [0.3, 0.6, 1.0])
def test_placeholder_values_are_excluded(directions, filler, share):
    rng = np.random.default_rng(9)
    speeds = speeds_of(directions, np.array([8.0, 1.0, 0.0]), 1e-3)
    filled = [np.where(rng.random(len(v)) < share, filler, v) for v in speeds]
    found, note = without_filler(directions, filled)
    counted = np.mean(np.concatenate(filled) == filler)
    share = f"{counted:.0%} of the Doppler values are {filler:g} m/s"
    assert note == f"{share}: they were not measured, and are left out"
    for v, measured, given in zip(found, speeds, filled, strict=True):
        np.testing.assert_array_equal(v, np.where(given == filler, np.nan, measured))


@pytest.mark.parametrize("velocity_mps", [(0.0, 0.0, 0.0), (0.1, 0.0, 0.0)])
def test_equal_speeds_of_a_slow_sensor_are_kept(directions, velocity_mps):
    rng = np.random.default_rng(9)
    speeds = speeds_of(directions, np.array(velocity_mps), 0.125)
    speeds = [np.where(rng.random(len(v)) < 0.2, rng.uniform(-5, 5, len(v)), v) for v in speeds]
    found, note = without_filler(directions, speeds)
    assert note is None
    for v, given in zip(found, speeds, strict=True):
        np.testing.assert_array_equal(v, given)


def test_a_velocity_is_the_least_squares_solution_of_inliers(directions):
    rng = np.random.default_rng(3)
    true = np.array([8.0, -2.0, 0.5])
    x = directions[0] * [1, 1, 0.2]
    away = -x / np.linalg.norm(x, axis=1)[:, None]
    speeds = away @ true + rng.normal(0, 0.04, 80) + 3.0 * (np.arange(80) < 16)
    speeds[70] = np.nan
    x[71] = 0
    found = sensor_velocity(x, speeds)
    np.testing.assert_array_equal(found.static, (np.arange(80) >= 16) & ~np.isin(np.arange(80), [70, 71]))
    a, b = away[found.static], speeds[found.static]
    solution, squares, *_ = np.linalg.lstsq(a, b)
    np.testing.assert_allclose(found.velocity_mps, solution, atol=1e-5)
    variance = squares[0] / (len(a) - 3)
    np.testing.assert_allclose(found.covariance, variance * np.linalg.inv(a.T @ a), rtol=1e-3)
    # Ten returns determine a velocity; nine do not, nor ten if seven of them move.
    few = np.flatnonzero(found.static)[:10]
    assert sensor_velocity(x[few], speeds[few]).found
    assert not sensor_velocity(x[few[:9]], speeds[few[:9]]).found
    assert not sensor_velocity(x[few], speeds[few] + np.r_[np.zeros(3), 5.0 * 1.7 ** np.arange(7)]).found


def test_an_unobserved_component_is_zero_with_a_deviation_of_100_mps(directions):
    x = directions[0] * [1, 1, 0]
    speeds = -x @ [8.0, -2.0, 5.0] / np.linalg.norm(x, axis=1) + np.random.default_rng(4).normal(0, 0.04, 80)
    found = sensor_velocity(x, speeds)
    assert found.velocity_mps[2] == 0
    assert np.sqrt(found.covariance[2, 2]) == pytest.approx(100, rel=0.3)


STEPS = 0.1 * np.arange(-100, 100)  # -10 to 9.9 m/s, each once


@pytest.mark.parametrize(
    ("speeds", "interval_mps"),
    [
        (STEPS, 20.0),
        (STEPS + 1.0, 20.0),  # -9 to 10.9: about as far from 0
        (STEPS + 1.2, None),  # -8.8 to 11.1
        (STEPS - 1.3, None),
        (STEPS + 11, None),
        (np.r_[STEPS, np.nan, np.inf], 20.0),
        (STEPS[50:149], None),  # 99
        (STEPS[50:150], 10.0),
        (np.repeat(np.arange(-5.0, 6), 20), 10.0),  # too coarse to be steps
        (np.r_[STEPS[::199], np.linspace(-8, 8, 998)], None),  # a thousandth at each end
        (np.r_[np.repeat(STEPS[::199], 2), np.linspace(-8, 8, 996)], 19.9),  # two: the interval is filled
        (np.r_[np.repeat(STEPS[:1], 100), np.linspace(-9, 8, 899), 9.9], None),
    ],
)
def test_speeds_that_fill_an_interval_are_folded_into_it(speeds, interval_mps):
    found = folding_interval_mps([speeds[:70], speeds[70:]])
    assert found == (None if interval_mps is None else pytest.approx(interval_mps, abs=0.02))
