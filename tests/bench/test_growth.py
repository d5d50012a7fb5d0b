# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The street is what it says, and a table of growth has each row, or why there is none."""

from __future__ import annotations

import json

import numpy as np
import pytest
from radarsdf import FitConfig, RadarMap, fit

from bench.growth import __main__ as command
from bench.growth import fits
from bench.growth.street import street


@pytest.mark.parametrize(
    ("count", "size_m", "frames"), [(1000, 50.0, 5), (20_001, 50.0, 5), (1000, 500.0, 50)]
)
def test_a_street_has_its_returns_and_its_length(count, size_m, frames):
    scans = street(count, size_m)
    assert sum(map(len, scans.points)) == sum(map(len, scans.intensities)) == count
    assert len(scans.points) == len(scans.poses) == frames
    assert {a.dtype for a in (*scans.points, *scans.intensities, scans.hits)} == {np.dtype(np.float32)}
    assert 0 < scans.poses[:, 0, 3].min() < scans.poses[:, 0, 3].max() < size_m
    x, y, z = scans.hits.T
    on = np.stack([np.abs(z), np.abs(np.abs(y) - 25), np.abs(x), np.abs(x - size_m)])
    assert on.min(0).max() < 1e-2
    assert (on < 1e-2).any(1)[: 4 if size_m == 50 else 2].all()  # all surfaces are hit
    range_m = np.linalg.norm(scans.hits - scans.hit_sensors, axis=1)
    assert np.abs(scans.hit_intensities - (100 - 40 * np.log10(range_m))).max() < 6.01


def test_most_returns_lie_on_the_street():
    scans = street(20_000, 200.0)
    world = np.concatenate(
        [points + pose[:3, 3] for points, pose in zip(scans.points, scans.poses, strict=True)]
    )
    off_m = np.minimum(np.abs(world[:, 2]), np.abs(np.abs(world[:, 1]) - 25))
    off_m = np.minimum(off_m, np.minimum(np.abs(world[:, 0]), np.abs(world[:, 0] - 200)))
    assert 0.7 < (off_m < 1).mean() < 0.97  # ghosts and clutter are not on it


def test_quick_fits_give_a_table(tmp_path, capsys):
    command.main(["fits", "--quick", "--out", str(tmp_path)])
    values = json.loads((tmp_path / "growth_fits.json").read_text())
    geometry, both = values["rows"]
    assert geometry["right"] > 0.8
    assert both["mae"] < 3
    assert geometry["peak_mb"] > geometry["before_mb"]
    assert geometry["training_s"] < geometry["wall_s"]
    assert "python -m bench.growth" in values["command"]
    table = (tmp_path / "growth_fits.md").read_text(encoding="utf-8")
    assert table == capsys.readouterr().out
    assert table.count("\n") == 4


def test_refined_poses_give_a_table(tmp_path, capsys):
    command.main(["poses", "--quick", "--out", str(tmp_path)])
    (row,) = json.loads((tmp_path / "growth_poses.json").read_text())["rows"]
    assert row["found_deg"] < row["given_deg"]
    assert row["returns"] > 1000 * row["scans"]
    assert row["peak_mb"] > 0
    assert "| 40 |" in capsys.readouterr().out


def test_a_row_that_fails_says_why(tmp_path, capsys):
    with pytest.raises(SystemExit, match="2 of 2 rows failed"):
        command.main(["fits", "--quick", "--returns", "0", "--out", str(tmp_path)])
    assert "ValueError" in capsys.readouterr().out


def test_a_map_of_another_street_is_refused():
    scans = street(10_000, 50.0)
    config = FitConfig(
        training={"sdf_iterations": 60, "intensity_iterations": 1}, networks={"reflectance": "network"}
    )
    points = [-scan for scan in scans.points]
    radar_map = fit(points, scans.poses, scans.intensities, config=config, progress=False)
    assert isinstance(radar_map, RadarMap)
    with pytest.raises(RuntimeError, match=r"signs|intensity"):
        fits._errors(radar_map, scans)


def test_cases_vary_one_thing_at_a_time():
    some = fits.cases(quick=False, returns=[], sizes_m=[], threads=[], every=False)
    assert {(case["returns"], case["size_m"]) for case in some} == {
        (10**4, 500), (10**5, 500), (10**6, 500), (10**7, 500), (10**6, 50), (10**6, 5000)
    }  # fmt: skip
    assert len(some) == 6 * 4
    all_ = fits.cases(quick=False, returns=[], sizes_m=[], threads=[1], every=True)
    assert len(all_) == 4 * 3 * 2
