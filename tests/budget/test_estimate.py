# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Estimates of memory hold, and what does not fit is refused before it is begun."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest
import radarsdf
from radarsdf import FitConfig
from radarsdf.budget import estimate as budget
from radarsdf.cli import main
from radarsdf.io.npz import write_scans
from radarsdf.io.scans import Scans
from radarsdf.returns.rays import prepare

from bench.growth.street import street
from bench.stress.memory import peak_of_a_fit

LINUX = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
QUICK = FitConfig(training={"sdf_iterations": 6, "intensity_iterations": 6, "batch_size": 512})


@LINUX
@pytest.mark.parametrize(
    ("count", "with_intensities", "changes"),
    [(10_000, True, {}), (100_000, True, {}), (25_000, False, {"encoding": {"kind": "octree"}})],
)
def test_the_peak_is_within_half_as_much_again(count, with_intensities, changes):
    estimate, peak = peak_of_a_fit(count, with_intensities, changes, [sys.executable])
    assert 1 / 1.5 < estimate.peak_memory_bytes / peak < 1.5


@pytest.mark.parametrize(
    "changes", [{}, {"leaf_size_m": 0.4, "encoding": {"num_levels": 4}}, {"encoding": {"kind": "octree"}}]
)
def test_counts_are_those_of_the_fit(changes):
    scans = street(20_000)
    points, poses = scans.points, scans.poses
    config = QUICK.override(returns={"drop_ghosts": False}, encoding={"bridge_cells": 0}).override(**changes)
    estimate = radarsdf.estimate(points, poses, config=config)
    report = radarsdf.fit(points, poses, config=config, progress=False).report
    assert estimate.returns == report["returns_used"]
    assert estimate.iterations == report["iterations"]
    assert estimate.leaf_cells == pytest.approx(report["leaf_cells"], rel=0.02)
    assert estimate.vertices == pytest.approx(report["vertices"], rel=0.02)


def test_a_sample_tells_about_as_much(monkeypatch):
    scans = street(50_000)
    points, poses = scans.points, scans.poses
    counts = [radarsdf.estimate(points, poses)]
    monkeypatch.setattr(budget, "_SAMPLE", 5_000)
    counts.append(radarsdf.estimate(points, poses))
    for name in ("leaf_cells", "vertices"):
        whole, sampled = (getattr(c, name) for c in counts)
        assert whole != sampled
        assert sampled == pytest.approx(whole, rel=0.4)


def test_a_fit_beyond_the_budget_is_refused_before_anything_is_allocated(scene, monkeypatch):
    config = QUICK.override(max_memory_bytes=40_000_000)
    monkeypatch.setattr("radarsdf.fitting.steps.SurfaceReturns.of", lambda *_: pytest.fail("began"))
    with pytest.raises(
        MemoryError, match=r"about 0\.\d\d GB for \d+ leaf cells and 9000 returns, of 0\.04: use larger"
    ):
        radarsdf.fit(scene.points, scene.poses, scene.intensities, config=config)


def test_what_fits_is_not_counted(scene, monkeypatch):
    monkeypatch.setattr(budget, "estimate_rays", lambda *_: pytest.fail("counted"))
    radarsdf.fit(scene.points, scene.poses, config=QUICK.override(max_memory_bytes=10**11))
    with pytest.raises(pytest.fail.Exception):
        radarsdf.fit(scene.points, scene.poses, config=QUICK.override(max_memory_bytes=10**8))


def test_the_quick_bound_is_one(scene):
    for changes in (
        {},
        {"encoding": {"kind": "octree"}},
        {"leaf_size_m": 0.05, "sampling": {"near_band_cells": 20.0}},
    ):
        config = QUICK.override(**changes)
        rays = prepare(scene.points, scene.poses)
        estimate = budget.estimate_rays(rays, config)
        # Just enough for the estimate: then the bound, being above it, must not be what decides.
        for spare, refused in ((1, True), (0, False)):
            tight = config.override(max_memory_bytes=estimate.peak_memory_bytes - spare)
            if refused:
                with pytest.raises(MemoryError):
                    budget.check_fit(rays, tight)
            else:
                budget.check_fit(rays, tight)


def test_a_mesh_beyond_the_budget_is_refused(scene):
    radar_map = radarsdf.fit(scene.points, scene.poses, config=FitConfig.quick(max_memory_bytes=10**9))
    radar_map.mesh(0.1)
    with pytest.raises(
        MemoryError, match=r"voxels of 0\.005 m would take about \d+\.\d\d GB, of 1\.00: use larger"
    ):
        radar_map.mesh(0.005)


class TestAvailable:
    @staticmethod
    def tree(root, groups, **files):
        (root / "proc/self").mkdir(parents=True)
        (root / "proc/meminfo").write_text("MemTotal: 9000 kB\nMemAvailable: 5000 kB\n")
        (root / "proc/self/cgroup").write_text(groups)
        for name, content in files.items():
            path = root / "sys/fs/cgroup" / name.replace("__", "/")
            path.parent.mkdir(parents=True, exist_ok=True)
            path.with_name(path.name.replace("memory_", "memory.")).write_text(content)

    def test_of_the_system(self, tmp_path):
        self.tree(tmp_path, "0::/\n", memory_max="max\n", memory_current="7")
        assert budget.available_bytes(tmp_path) == 5000 * 1024

    def test_of_a_control_group(self, tmp_path):
        files = {"a__b__memory_max": "3000000", "a__b__memory_current": "1000000"}
        self.tree(tmp_path, "0::/a/b\n", **files, a__b__memory_stat="anon 5\ninactive_file 200000\n")
        assert budget.available_bytes(tmp_path) == 2_200_000

    def test_of_a_control_group_of_the_first_version(self, tmp_path):
        files = {"memory__memory_limit_in_bytes": "3000000", "memory__memory_usage_in_bytes": "1000000"}
        self.tree(tmp_path, "4:cpu:/x\n3:memory:/x\n", **files, memory__memory_stat="inactive_file 0\n")
        assert budget.available_bytes(tmp_path) == 2_000_000

    def test_nobody_says(self, tmp_path):
        assert budget.available_bytes(tmp_path) is None


def test_a_dry_run_prints_and_writes_nothing(scene, tmp_path, capsys, monkeypatch):
    write_scans(tmp_path / "scans.npz", Scans(scene.points, scene.poses, scene.intensities, None))
    monkeypatch.setattr("radarsdf.fit", lambda *_, **__: pytest.fail("a fit"))
    assert main(["fit", str(tmp_path / "scans.npz"), "--dry-run"]) == 0
    assert "9000 returns, about" in capsys.readouterr().out
    assert [p.name for p in tmp_path.iterdir()] == ["scans.npz"]


def test_the_command_says_it_in_one_line(scene, tmp_path, capsys):
    write_scans(tmp_path / "scans.npz", Scans(scene.points, scene.poses, scene.intensities, None))
    words = [
        "fit",
        str(tmp_path / "scans.npz"),
        "-o",
        str(tmp_path / "map.safetensors"),
        "--set",
        "max_memory_bytes=1000",
    ]
    assert main(words) == 1
    assert capsys.readouterr().err.count("\n") == 1
    assert not (tmp_path / "map.safetensors").exists()


@LINUX
def test_memory_does_not_grow_with_the_fits():
    code = """
from bench.stress.memory import memory_of_fits
found = memory_of_fits(48)  # what freed memory the allocator keeps varies by ten megabytes in the first of them
assert max(found[32:]) - max(found[4:32]) < 5, found
"""
    # With an arena for each thread, as by default, one more of ten megabytes may be begun in any fit.
    environment = os.environ | {"MALLOC_ARENA_MAX": "1"}
    subprocess.run([sys.executable, "-c", code], check=True, env=environment)


def test_estimates_of_nothing_are_the_errors_of_a_fit():
    with pytest.raises(ValueError, match="no scans"):
        radarsdf.estimate([], np.zeros((0, 4, 4)))
