# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Tiles of scans whose poses drift or are missing."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
import radarsdf
from radarsdf.evaluation import trajectory_metrics
from radarsdf.io import Scans
from radarsdf.io.npz import write_scans
from radarsdf.poses import windows
from radarsdf.tiles import drive_poses
from radarsdf.tiles.drive_poses import TRAJECTORY, DrivePoses
from radarsdf.tiles.fit_tiles import plan_tiles
from radarsdf.tiles.plan import PLAN, Plan

from ..poses.drift import drifting_drive
from .conftest import CONFIG

GRID = {"tile_size": 25.6, "halo": 6.4, "config": CONFIG}


@pytest.fixture(scope="module")
def drive():
    """Poses of it drift."""
    return drifting_drive()[0]


@pytest.fixture(scope="module")
def true():
    return drifting_drive()[1]


@pytest.fixture(scope="module")
def folder(drive, tmp_path_factory):
    """The plan of refined poses, made in two windows."""
    out = tmp_path_factory.mktemp("refined") / "city"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(windows, "_SCANS", 30)
        plan_tiles(drive, out, refine=True, **GRID)
    return out


def test_the_plan_is_made_of_refined_poses(true, drive, folder):
    posed = DrivePoses.load(folder).posed
    before, after = (trajectory_metrics(poses, true)["absolute_m"] for poses in (drive.poses, posed.poses))
    assert after < 0.4 * before
    assert posed.way["improved"]
    sigma_m, sigma_rad = posed.sigmas  # settings of the maps
    returns = Plan.load(folder).config.returns
    assert (returns.pose_sigma_m, returns.pose_sigma_rad) == (sigma_m, sigma_rad)
    table = np.loadtxt(folder / TRAJECTORY)  # for other programs
    np.testing.assert_allclose(table[:, 0], drive.times_s)
    np.testing.assert_allclose(table[:, 1:4], posed.poses[:, :3, 3], atol=1e-8)
    other = Scans(drive.points, posed.poses, doppler_mps=drive.doppler_mps)
    same = plan_tiles(other, folder.parent / "of_refined", **(GRID | {"config": posed.config(CONFIG)}))
    assert same.tiles == Plan.load(folder).tiles
    for rays in folder.glob("tiles/*/rays.bin"):
        assert rays.read_bytes() == (folder.parent / "of_refined" / rays.relative_to(folder)).read_bytes()


def test_a_second_call_has_the_same_poses(drive, folder, tmp_path, monkeypatch):
    out = tmp_path / "city"
    shutil.copytree(folder, out)
    monkeypatch.setattr(drive_poses, "refine_in_windows", lambda *_: pytest.fail("refined again"))
    plan = plan_tiles(drive, out, refine=True, **GRID)
    (out / PLAN).unlink()  # as if it had been killed after the refinement
    again = plan_tiles(drive, out, refine=True, **GRID)
    assert again.digest == plan.digest == Plan.load(folder).digest


def test_a_plan_that_is_there_is_compared_in_one_pass(drive, folder):
    passes = []

    class Counted:
        def __iter__(self):
            passes.append(len(passes))
            yield from drive

    assert plan_tiles(Counted(), folder, refine=True, **GRID).digest == Plan.load(folder).digest
    assert passes == [0]


def test_other_scans_or_settings_are_refused(drive, folder):
    with pytest.raises(ValueError, match="another plan: scans differ"):
        plan_tiles(drive.select(np.arange(40)), folder, refine=True, **GRID)
    with pytest.raises(ValueError, match="another plan: seed"):
        plan_tiles(drive, folder, refine=True, **(GRID | {"config": CONFIG.override(seed=1)}))
    with pytest.raises(ValueError, match="of poses that were refined or found"):
        plan_tiles(drive, folder, **GRID)
    with pytest.raises(ValueError, match="can be read again"):
        plan_tiles(iter(drive), folder, refine=True, **GRID)


def test_a_map_says_how_its_poses_were_made(drive, folder, tmp_path):
    out = tmp_path / "city"
    shutil.copytree(folder, out)
    city = radarsdf.fit_tiles(drive, out, refine=True, progress=False, **GRID)
    assert city.missing == {}
    assert "sharper map in 2 of 2 windows" in city.report["poses"]["verdict"]
    assert len(city.report["poses"]["after"]) == len(drive)


def test_scans_without_poses_get_some(true, drive, tmp_path):
    some = drive.select(np.arange(24))
    path, out = tmp_path / "scans", tmp_path / "city"
    path.mkdir()
    for scan, speeds, time_s in zip(some.points, some.doppler_mps, some.times_s, strict=True):
        table = np.column_stack([scan, speeds])
        np.savetxt(path / f"{time_s:.3f}.csv", table, delimiter=",", header="x,y,z,doppler", comments="")
    plan_tiles(path, out, **GRID)
    assert trajectory_metrics(DrivePoses.load(out).posed.poses, true[:24])["absolute_m"] < 0.05
    # The same poses, whether they are missing or not used.
    write_scans(tmp_path / "drive.npz", some)
    plan_tiles(tmp_path / "drive.npz", tmp_path / "found", find=True, **GRID)
    found = [DrivePoses.load(folder).posed.poses for folder in (out, tmp_path / "found")]
    np.testing.assert_allclose(*found, atol=1e-3)
