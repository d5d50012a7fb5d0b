# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The table of kinds: F-scores of all methods, and confidence beside the truth."""

from __future__ import annotations

import pytest

from bench.paper.kinds import table

from .test_paper import peers, run

__all__ = ["peers"]


@pytest.mark.usefixtures("peers")
def test_each_kind_has_scores_and_a_calibration(tmp_path):
    written, values = run(tmp_path, "kinds", "wall", "--peers", "BPA", "Poisson", "--repetitions", "1")
    ball, _, *judged = values["rows"]
    assert 0 <= ball["f_score_all"] <= 1
    assert "- wall, Poisson: Open3D is not here" in written
    assert [row["method"] for row in judged] == ["radarsdf, confidence", "radarsdf, quick, confidence"]
    for row in judged:
        assert row["num_points"] > 1000
        assert 0 < row["true_share"] < 1
        assert row["auc"] > 0.5


def test_a_mean_is_over_kinds_that_all_methods_have():
    def row(scene, method, score):
        return {"scene": scene, "method": method, "repetition": 0, "f_score_all": score}

    rows = [row("hall", "A", 0.5), row("hall", "B", 0.7), row("yard", "A", 0.7), row("yard", "B", 0.8)]
    mean = "| mean of kinds | 60.0 | **75.0** |"
    assert mean in " ".join(table(rows).split())
    rows += [row("forest", "A", 0.1), {"scene": "forest", "method": "B", "why_not": "it crashed"}]
    found = table(rows)
    assert mean in " ".join(found.split())
    assert "- forest, B: it crashed" in found
