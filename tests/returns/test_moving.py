# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Returns that move are left out of a fit, and only these."""

import numpy as np
import pytest
import radarsdf
from radarsdf import FitConfig
from radarsdf.checking.doppler import velocity_of_poses
from radarsdf.returns.moving import MovingReturns, StaticReturns
from radarsdf.scans import Scans

from tests.conftest import recorded_scans

QUICK = {"training": {"sdf_iterations": 3, "intensity_iterations": 3}}


@pytest.fixture(scope="module")
def drive():
    """Scans with Doppler, and which of their returns move: a tenth."""
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


def test_what_moves_is_found(drive):
    scans, doppler, moves = drive
    for sign in (1, -1):  # sensors differ in it
        found = MovingReturns.of(scans.points, [sign * values for values in doppler])
        assert found.why_none is None
        found_moving, true = np.concatenate(found.masks), np.concatenate(moves)
        assert found_moving[true].mean() > 0.99
        assert found_moving[~true].mean() < 0.01
        assert found.count == found_moving.sum()


def test_a_fit_leaves_moving_returns_out_and_counts_them(drive):
    scans, doppler, _ = drive
    expected = MovingReturns.of(scans.points, doppler).count
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
        assert kept == report["returns"] - expected - _too_near(scans, doppler)
    config = FitConfig(**QUICK, returns={"drop_moving": False})
    kept_all = radarsdf.fit(scans.points, scans.poses, doppler_mps=doppler, config=config, progress=False)
    assert kept_all.report["moving"] == 0


def test_half_of_the_scans_must_agree_on_a_velocity(drive):
    scans, doppler, _ = drive
    rng = np.random.default_rng(2)
    noise = [rng.uniform(-20, 20, len(v)) for v in doppler]
    expected = MovingReturns.of(scans.points, doppler).masks
    found = MovingReturns.of(scans.points, doppler[:6] + noise[6:])
    assert found.why_none is None
    for mask, agreeing in zip(found.masks[:6], expected, strict=False):
        np.testing.assert_array_equal(mask, agreeing)
    assert not np.concatenate(found.masks[6:]).any()
    # Scans of less than ten returns do not count.
    points = [*scans.points[:11], scans.points[11][:9]]
    assert MovingReturns.of(points, [*doppler[:6], *noise[6:11], doppler[11][:9]]).why_none is None
    lost = MovingReturns.of(scans.points, doppler[:5] + noise[5:])
    assert lost.count == 0
    assert lost.why_none == "only 5 of 12 scans agree on a velocity of the sensor"


def _too_near(scans, doppler):
    left = MovingReturns.of(scans.points, doppler).without(scans.points)
    return sum(int((np.linalg.norm(points, axis=1) < 2.5).sum()) for points in left)


def test_doppler_that_is_not_understood_leaves_nothing_out(drive):
    scans, doppler, _ = drive
    rng = np.random.default_rng(1)
    noise = [rng.uniform(-20, 20, len(v)) for v in doppler]
    # In half of the returns, what the sensor measured is lost: they would all seem to move.
    mostly = [np.where(rng.random(len(v)) < 0.5, v, 37.0 + rng.uniform(-20, 20, len(v))) for v in doppler]
    for values, why in ((noise, "scans agree on a velocity"), (mostly, "of the returns disagree")):
        found = MovingReturns.of(scans.points, values)
        assert found.count == 0
        assert why in found.why_none
        report = radarsdf.fit(
            scans.points, scans.poses, doppler_mps=values, config=FitConfig(**QUICK), progress=False
        ).report
        assert any(line.startswith("leaving out what moves: ") for line in report["skipped"])


def test_intensities_stay_with_their_returns(drive):
    scans, doppler, _ = drive
    static = StaticReturns.of(scans.points, scans.intensities, doppler, FitConfig().returns)
    kept = [~mask for mask in MovingReturns.of(scans.points, doppler).masks]
    for values, all_values, mask in zip(static.intensities, scans.intensities, kept, strict=True):
        np.testing.assert_array_equal(values, all_values[mask])


@pytest.mark.parametrize("name", ["r0009_0024", "r0057_0068", "r0133_0142", "r0144_0167", "r0309_0320"])
def test_moving_returns_of_recorded_drives_agree_with_their_flags(name):
    with np.load(recorded_scans(name)) as file:
        rows = [np.flatnonzero(file["frame"] == i) for i in range(len(file["poses"]))]
        points, doppler, static = ([file[k][r] for r in rows] for k in ("points", "doppler", "static"))
    found = MovingReturns.of(points, doppler)
    wrong = np.concatenate(
        [found_moving == flags for found_moving, flags in zip(found.masks, static, strict=True)]
    )
    assert found.why_none is None
    assert wrong.mean() < 0.1
