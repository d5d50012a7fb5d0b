"""Drives through places visited again, and the verdicts on poses found there."""

import numpy as np
import pytest
from radarsdf.simulate import hugin

from bench.localisation import judged, sums
from scenes.revisits import SYMMETRIC, another_day


def test_another_day_is_beside_the_first_and_reverse_turns_the_radar():
    first = hugin(seed=1, frames=6)
    day, back = (another_day(first, 1, reverse=reverse) for reverse in (False, True))
    aside_m = np.linalg.norm(day.poses[:, None, :2, 3] - first.poses[None, :, :2, 3], axis=2).min(axis=1)
    assert (aside_m > 0.3).all()
    assert 0.8 < len(day.scene.solids) / len(first.scene.solids) < 1
    np.testing.assert_allclose(back.poses[::-1, :3, 3], day.poses[:, :3, 3])
    np.testing.assert_allclose(back.poses[::-1, :2, :2], -day.poses[:, :2, :2], atol=1e-9)


@pytest.mark.parametrize("kind", SYMMETRIC)
def test_symmetric_places_look_alike(kind):
    """The distances to all surfaces are equal at poses that differ."""
    scene = SYMMETRIC[kind](seed=2, frames=1).scene
    x = np.random.default_rng(0).uniform([-5, -2, 0], [5, 2, 3], (50, 3))
    moved = {"court": x[:, [1, 0, 2]] * [-1, 1, 1], "tube": x + [7, 0, 0]}.get(kind)
    if moved is None:
        pitch = np.diff(np.unique([one.base[0] for one in scene.solids[:-1]]))[0]
        moved = x + [pitch, 0, 0]
    np.testing.assert_allclose(scene.signed_distance(moved), scene.signed_distance(x), atol=1e-9)


def test_verdicts_and_their_sums():
    true = np.tile(np.eye(4), (5, 1, 1))
    near, far, lost = true.copy(), true.copy(), np.full((5, 4, 4), np.nan)
    near[:, 0, 3], far[:, 0, 3], near[0] = 0.1, 0.6, np.nan
    judgements = [judged(poses, true) for poses in (near, far, lost)]
    assert [one["verdict"] for one in judgements] == ["found", "wrong", "refused"]
    assert judgements[0]["located"] == 0.8
    (row,) = sums([{"method": "a", "case": "day", "place": "unique"} | one for one in judgements])
    assert (row["found"], row["wrong"], row["refused"], row["median_m"]) == (1, 1, 1, pytest.approx(0.1))
