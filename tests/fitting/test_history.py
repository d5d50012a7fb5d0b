# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The history of the losses, and the time that skipped parts would have taken."""

from __future__ import annotations

import numpy as np
import pytest
import radarsdf
from radarsdf import FitConfig
from radarsdf.fitting.schedule import Schedule
from radarsdf.fitting import history
from radarsdf.fitting.train import LossHistory
from radarsdf.fitting.skipped import skipped_parts

CONFIG = FitConfig(
    num_threads=1, training={"sdf_iterations": 30, "intensity_iterations": 50, "batch_size": 512}
)


def test_spans_have_the_means_of_all_iterations(monkeypatch):
    monkeypatch.setattr(history, "_MOST_SPANS", 4)
    losses = LossHistory({"sdf": 10, "intensity": 0})
    losses.start()
    for done in range(1, 11):
        losses.add({"sdf": float(done)}, {"sdf": done})
    found = losses.to_report()
    assert list(found) == ["sdf"]
    assert found["sdf"]["iterations"] == [3, 5, 8, 10]
    assert found["sdf"]["losses"] == [2.0, 4.5, 7.0, 9.5]
    assert found["sdf"]["seconds"] == sorted(found["sdf"]["seconds"])


def test_the_report_of_a_fit_has_both_losses(scene):
    radar_map = radarsdf.fit(scene.points, scene.poses, scene.intensities, config=CONFIG, progress=False)
    found = radar_map.report["loss_history"]
    assert found["sdf"]["iterations"] == list(range(1, 31))
    assert found["intensity"]["iterations"] == list(range(1, 51))
    assert found["sdf"]["losses"][-1] < 0.9 * found["sdf"]["losses"][0]
    assert found["intensity"]["losses"][-1] == radar_map.report["losses"]["intensity"]
    assert 0 < found["intensity"]["seconds"][-1] <= radar_map.report["training_s"]


def test_it_goes_on_where_a_stop_was():
    whole, stopped = (LossHistory({"sdf": 400}) for _ in range(2))
    for losses, first, last in ((whole, 0, 400), (stopped, 0, 150)):
        losses.start()
        for i in range(first, last):
            losses.add({"sdf": float(i)}, {"sdf": i + 1})
    resumed = LossHistory({"sdf": 400})
    resumed.restore({name: tensor.clone() for name, tensor in stopped.state().items()})
    resumed.start()
    for i in range(150, 400):
        resumed.add({"sdf": float(i)}, {"sdf": i + 1})
    ours, expected = resumed.to_report()["sdf"], whole.to_report()["sdf"]
    assert (ours["iterations"], ours["losses"]) == (expected["iterations"], expected["losses"])
    assert len(ours["losses"]) == 200
    assert (np.diff(ours["seconds"]) >= 0).all()


def skipped_of(config, with_intensity):
    size = {"returns": 500_000, "vertices": 10**9, "with_intensity": with_intensity}
    schedule = Schedule.of(config, surface_returns=size["returns"], **size)
    found = skipped_parts(
        config, schedule, returns=500_000, cells=10**6, rows=10**6, with_intensity=with_intensity, threads=1
    )
    return schedule, {part.words: part.seconds for part in found}


def test_samples_that_were_skipped_would_have_taken_their_share_of_the_time():
    found = {}
    for effort in (0.25, 0.5):
        schedule, saved_s = skipped_of(FitConfig(effort=effort), with_intensity=False)
        (seconds,) = (saved_s[words] for words in saved_s if "of the samples" in words)
        found[effort] = seconds / schedule.sdf_iterations
        assert schedule.passes == pytest.approx(0.6 * effort, rel=0.01)
    # Of each sample that was drawn, so many are missing.
    missing = {effort: 1 / (0.6 * effort) - 1 for effort in found}
    assert found[0.25] / found[0.5] == pytest.approx(missing[0.25] / missing[0.5], rel=0.02)


def test_each_part_that_was_skipped_has_a_time():
    _, saved_s = skipped_of(FitConfig(), with_intensity=True)
    assert [words.split(",")[0] for words in saved_s] == [
        "the normals",
        "the geometry feature",
        "40% of the samples: the others were enough",
        "in each iteration",
    ]
    _, saved_s = skipped_of(FitConfig(), with_intensity=False)
    assert next(iter(saved_s)).startswith("the intensity network")
    assert all(seconds > 0 for seconds in saved_s.values())
    assert skipped_of(FitConfig.paper(), with_intensity=True)[1] == {}


@pytest.mark.parametrize("setting", ["normals", "geometry_feature_dim"])
def test_what_is_used_is_not_skipped(scene, setting):
    value = {"normals": True, "geometry_feature_dim": 4}[setting]
    config = CONFIG.override(
        networks={setting: value}, training={"sdf_iterations": 2, "intensity_iterations": 2}
    )
    radar_map = radarsdf.fit(scene.points, scene.poses, scene.intensities, config=config, progress=False)
    name = {"normals": "the normals,", "geometry_feature_dim": "the geometry feature,"}[setting]
    assert not any(words.startswith(name) for words in radar_map.report["skipped"])
    assert len(radar_map.report["skipped"]) == len(radar_map.report["skipped_s"]) > 0
