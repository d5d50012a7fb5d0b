# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Measures of predicted scans, on scans that differ by what is known."""

from __future__ import annotations

import numpy as np
import pytest
import radarsdf
from radarsdf import FitConfig

from bench.paper.novel_views import errors, replayed, returns_of, table
from bench.paper.scenes import Scene
from tests.conftest import pose

from .test_paper import run

LINE = np.column_stack([np.arange(10, 20, 1.0), np.zeros((10, 2))])
VALUES = np.arange(10.0)


def scene(points, poses, intensities=None):
    return Scene("made", points, np.stack(poses), intensities, min_range_m=2.0, max_range_m=30.0)


def test_the_same_scan_has_no_errors():
    assert errors((LINE, VALUES), (LINE, VALUES)) == {
        "returns": 10, "chamfer_m": 0.0, "explained": 1.0, "confirmed": 1.0, "intensity": 0.0,
    }  # fmt: skip


def test_a_scan_moved_across_by_less_and_by_more_than_explains():
    near = errors((LINE + [0, 0.2, 0], VALUES + 3), (LINE, VALUES))
    assert near["chamfer_m"] == pytest.approx(0.2)
    assert near["explained"] == near["confirmed"] == 1
    assert near["intensity"] == pytest.approx(3)
    far = errors((LINE + [0, 0, 0.4], VALUES), (LINE, VALUES))
    assert far["chamfer_m"] == pytest.approx(0.4)
    assert far["explained"] == far["confirmed"] == 0
    assert np.isnan(far["intensity"])


def test_explained_and_confirmed_are_shares_of_the_measured_and_of_the_predicted():
    # Three of ten are predicted, and two more where nothing is.
    predicted = np.concatenate([LINE[:3], LINE[:2] + [0, 50, 0]])
    values = np.concatenate([VALUES[:3] + [1, 0, -5], [9, 9]])
    found = errors((predicted, values), (LINE, VALUES))
    assert found["returns"] == 5
    assert found["explained"] == pytest.approx(0.3)
    assert found["confirmed"] == pytest.approx(0.6)
    assert found["intensity"] == pytest.approx(2)
    # 28 m from the seven others to the third, and 100 m from the two.
    assert found["chamfer_m"] == pytest.approx((28 / 10 + 100 / 5) / 2)


def test_a_view_without_returns_explains_nothing():
    found = errors((np.zeros((0, 3)), np.zeros(0)), (LINE, VALUES))
    assert (found["returns"], found["explained"]) == (0, 0)
    assert np.isnan([found["chamfer_m"], found["confirmed"], found["intensity"]]).all()


def test_the_nearest_scan_is_replayed_where_it_lay_in_the_world():
    target = np.array([[12.0, 5.0, 1.0]])
    poses = [pose([0, 0, 0]), pose([3, 1, 0], 0.4), pose([50, 0, 0])]
    points = [((target - T[:3, 3]) @ T[:3, :3]).astype(np.float32) for T in poses]
    train = scene(
        [points[0] + 1, points[1], points[2] + 1], poses, [np.array([n], np.float32) for n in range(3)]
    )
    asked = pose([4, 2, 0.5], -0.3)
    seen, values = replayed(train, asked)
    np.testing.assert_allclose(seen @ asked[:3, :3].T + asked[:3, 3], target, atol=1e-5)
    assert values.tolist() == [1.0]


def test_only_returns_within_the_ranges_of_the_scene_count():
    given = scene([np.array([[1.9, 0, 0], [2.1, 0, 0], [0, 29, 0], [0, 0, 31]], np.float32)], [np.eye(4)])
    points, values = returns_of(given, 0)
    np.testing.assert_allclose(points, [[2.1, 0, 0], [0, 29, 0]], atol=1e-6)
    assert np.isnan(values).all()


def test_a_scene_gives_a_row_for_the_replay_and_for_each_view(tmp_path, monkeypatch):
    def quick_fit(train, _config):
        return radarsdf.fit(
            train.points, train.poses, train.intensities, config=FitConfig.quick(), progress=False
        )

    monkeypatch.setattr("bench.paper.novel_views.fit", quick_fit)
    written, values = run(tmp_path, "novel-views", "wall", "--meshes")
    rows = {row["method"]: row for row in values["rows"]}
    assert list(rows) == ["replay", "view × 1", "view × 2", "view × 4"]
    returns = [row["returns"] for row in rows.values()]
    assert returns[1] < returns[2] < returns[3]
    assert all(0.5 < row["explained"] <= 1 for row in rows.values())
    assert written.count("| wall") == 4
    assert [path.suffix for path in (tmp_path / "meshes").iterdir()] == [".png"]


def test_a_scene_without_returns_says_so():
    line = table([{"scene": "made", "base": "quick", "why_not": "no returns"}]).splitlines()[-1]
    assert "no returns" in line
    assert line.count("–") == 5
