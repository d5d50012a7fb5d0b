"""Estimates of memory, size and time hold, and impossible fits are rejected before the work."""

import sys

import pytest
import radarsdf
from radarsdf import FitConfig
from radarsdf.cli import main
from radarsdf.fitting import estimate
from radarsdf.fitting.estimate import Schedule
from radarsdf.io.npz import write_scans
from radarsdf.returns.rays import prepare
from radarsdf.scans import Scans

from bench.estimates import peak_of_a_fit

LINUX = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
SHORT = FitConfig(training={"sdf_iterations": 6, "intensity_iterations": 6, "batch_size": 512})
NORMALS = {"networks": {"normals": True}, "training": {"sdf_iterations": 4, "intensity_iterations": 5}}


@LINUX
@pytest.mark.parametrize(
    ("count", "with_intensities", "changes"),
    [
        (50_000, True, {}),
        (12_000, True, FitConfig.quick().to_dict()),
        (12_000, True, NORMALS | {"num_threads": 4}),
    ],
)
def test_the_peak_is_within_a_factor_of_two(count, with_intensities, changes):
    found, peak = peak_of_a_fit(count, with_intensities, changes)
    assert 1 / 2 < found.peak_memory_bytes / peak < 2


@pytest.mark.parametrize(
    "config",
    [FitConfig(), FitConfig.quick(leaf_size_m=0.1), FitConfig(encoding={"kind": "octree"})],
    ids=["default", "quick", "octree"],
)
@pytest.mark.parametrize("scene", ["hugin", "wall"])
def test_sizes_are_within_a_factor_of_two(scene, config):
    scans = getattr(radarsdf.simulate, scene)(frames=6, seed=5)
    config = config.override(training={"sdf_iterations": 1, "batch_size": 16})
    found = radarsdf.estimate(scans.points, scans.poses, config=config)
    report = radarsdf.fit(scans.points, scans.poses, config=config, progress=False).report
    assert found.returns == report["returns_used"] + report["ghosts"]
    assert found.iterations == report["iterations"]
    assert 1 / 2 < found.leaf_cells / report["leaf_cells"] < 2
    assert 1 / 2 < found.vertices / report["vertices"] < 2


def test_a_fit_beyond_the_budget_is_rejected_before_allocation(scene, monkeypatch):
    config = SHORT.override(max_memory_bytes=30_000_000)
    monkeypatch.setattr("radarsdf.fitting.fit.SurfaceReturns.of", lambda *_: pytest.fail("began"))
    with pytest.raises(MemoryError, match=r"0\.03 GB .*9000 returns"):
        radarsdf.fit(scene.points, scene.poses, scene.intensities, config=config)


def test_the_quick_bound_is_an_upper_bound(scene):
    """With a budget just above the estimate, the larger bound must not decide."""
    rays = prepare(scene.points, scene.poses)
    for changes in ({}, {"encoding": {"kind": "octree"}}, {"leaf_size_m": 0.05}, {"train": False}):
        config = SHORT.override(**changes)
        enough = estimate.estimate_rays(rays, config).peak_memory_bytes
        estimate.check_fit(rays, config.override(max_memory_bytes=enough))
        with pytest.raises(MemoryError):
            estimate.check_fit(rays, config.override(max_memory_bytes=enough - 1))


def test_a_dry_run_prints_and_writes_nothing(scene, tmp_path, capsys, monkeypatch):
    write_scans(tmp_path / "scans.npz", Scans(scene.points, scene.poses, scene.intensities, None))
    monkeypatch.setattr("radarsdf.fit", lambda *_, **__: pytest.fail("a fit"))
    assert main(["fit", str(tmp_path / "scans.npz"), "--dry-run"]) == 0
    assert "9000 returns, about" in capsys.readouterr().out
    assert [p.name for p in tmp_path.iterdir()] == ["scans.npz"]


def skipped_of(config, with_intensity):
    sizes = {"returns": 500_000, "with_intensity": with_intensity}
    labelled = [sizes["returns"]] * with_intensity
    schedule = Schedule.of(config, surface_returns=sizes["returns"], vertices=10**9, labelled=labelled)
    found = estimate.skipped_parts(config, schedule, cells=10**6, rows=10**6, **sizes)
    return schedule, dict(found)


def test_skipped_parts_of_a_fit_have_an_estimated_time():
    parts = {
        "default": ["40% of the samples"],
        "quick": ["training of the surface", "the search for ghosts", "free space", "the intensity network"],
        "paper": ["free space"],
    }
    for preset, expected in parts.items():
        config = FitConfig() if preset == "default" else getattr(FitConfig, preset)()
        saved_s = skipped_of(config, with_intensity=True)[1]
        assert len(saved_s) == len(expected)
        for words, start in zip(saved_s, expected, strict=True):
            assert words.startswith(start)
            untimed = start in ("free space", "the search for ghosts")
            assert saved_s[words] is None if untimed else saved_s[words] > 0
