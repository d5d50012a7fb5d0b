"""`radarsdf poses`, and fits of scans with refined or missing poses."""

import numpy as np
import pytest
import radarsdf
from radarsdf.io.npz import read_scans, write_scans
from radarsdf.scans import Scans
from radarsdf.simulate import drifted

from ..poses.drift import first, measured, position_error_m
from ..poses.test_odometry import errors
from .calls import call, refusal, values

FRAMES = 24
FEW = 12  # to locate


@pytest.fixture(scope="module")
def drive():
    """The first scans of a drive."""
    return measured(first(radarsdf.simulate.oculii, FRAMES, seed=62, frames=120))


@pytest.fixture
def drifted_file(drive, tmp_path):
    """Scans with drifting poses."""
    path = tmp_path / "drive.npz"
    write_scans(path, drive.with_poses(drifted(drive.poses, 0.05, 0.004, 1)))
    return path


@pytest.fixture
def unposed(drive, tmp_path):
    """A folder of scans with Doppler and times, and no poses."""
    folder = tmp_path / "scans"
    folder.mkdir()
    for scan in drive:
        table = np.column_stack([scan.points, scan.doppler_mps])
        path = folder / f"{100 + scan.time_s:.3f}.csv"
        np.savetxt(path, table, delimiter=",", header="x,y,z,doppler", comments="")
    return folder


def test_drifting_poses_are_refined(drive, drifted_file, tmp_path, capsys):
    pytest.importorskip("matplotlib", reason="the extra plot is not installed")
    out, picture = tmp_path / "mended.npz", tmp_path / "way.png"
    assert call("poses", drifted_file, "-o", out, "--picture", picture) == 0
    said = capsys.readouterr().out
    assert "The refined poses make a sharper map" in said
    assert "they moved by" in said
    given, mended = read_scans(drifted_file), read_scans(out)
    assert errors(mended.poses, drive.poses)[0] < 0.5 * errors(given.poses, drive.poses)[0]
    for one, other in zip(given.points, mended.points, strict=True):
        np.testing.assert_array_equal(one, other)
    assert picture.read_bytes()[:4] == b"\x89PNG"


def test_poses_are_estimated_for_scans_without_poses(drive, unposed, tmp_path, capsys):
    out = tmp_path / "poses.tum"
    said = values(capsys, "poses", unposed, "-o", out)
    assert said["poses"]["segments"] == 1
    scans = radarsdf.io.read(unposed, out)
    assert errors(scans.poses, drive.poses)[0] < 0.05
    again = ["--find", "-o", tmp_path / "again.tum"]
    assert "--find" in refusal(capsys, tmp_path, "poses", unposed, out, *again, status=2)


def test_a_fit_refines_the_poses(drive, drifted_file, tmp_path, capsys):
    plain, mended = (
        values(capsys, "fit", drifted_file, "-o", tmp_path / f"{i}.safetensors", "--quick", *words)
        for i, words in enumerate([(), ("--refine",)])
    )
    assert mended["improved"]
    assert "poses" not in plain
    maps = [radarsdf.load(tmp_path / f"{i}.safetensors") for i in range(2)]
    assert "poses" not in maps[0].report
    assert maps[1].report["poses"]["verdict"] == mended["poses"]["verdict"]
    sigmas_m = [m.config.returns.pose_sigma_m for m in maps]
    assert sigmas_m[0] == 0
    assert 0.001 < sigmas_m[1] < 0.1
    drift_m = position_error_m(read_scans(drifted_file).poses, drive.poses)
    assert mended["poses"]["moved_m"] == pytest.approx(drift_m, rel=0.9)


def test_segments_are_not_joined(drive, tmp_path, capsys):
    later = measured(radarsdf.simulate.wall(seed=63, frames=5))
    path, out = tmp_path / "two.npz", tmp_path / "poses.tum"
    poses, times_s = np.tile(np.eye(4), (FRAMES + 5, 1, 1)), np.r_[drive.times_s, later.times_s + 60]
    of_motion = {"doppler_mps": drive.doppler_mps + later.doppler_mps, "times_s": times_s}
    write_scans(path, Scans(drive.points + later.points, poses, **of_motion))
    assert call("poses", path, "--find", "-o", out) == 0
    said = capsys.readouterr().out
    assert f"the scans 0 to {FRAMES - 1} are used" in said
    assert len(out.read_text().splitlines()) == FRAMES


def test_outputs_are_checked_before_the_work(drive, drifted_file, tmp_path, capsys):
    path, out = tmp_path / "untimed.npz", tmp_path / "poses.tum"
    write_scans(path, Scans(drive.points, drive.poses))
    for words, named in (
        (["poses", drifted_file, "-o", tmp_path / "a.txt"], "a.txt"),
        (["poses", drifted_file, "-o", drifted_file], "same file"),
        (["poses", path, "-o", out], "needs times"),
        (["live", path, "--trajectory", out], "needs times"),
    ):
        assert named in refusal(capsys, tmp_path, *words)


def test_scans_are_located_in_a_map(drive, tmp_path, capsys):
    write_scans(tmp_path / "drive.npz", drive.select(range(FEW)))
    config = radarsdf.FitConfig.quick()
    radarsdf.fit(drive.points, drive.poses, config=config, progress=False).save(tmp_path / "map.safetensors")
    out = tmp_path / "found.tum"
    found = values(capsys, "locate", tmp_path / "map.safetensors", tmp_path / "drive.npz", "-o", out)
    assert found["found"] == FEW
    assert np.abs(np.loadtxt(out)[:, 1:4] - drive.poses[:FEW, :3, 3]).max() < 0.1
    page, there = tmp_path / "page.html", (tmp_path / "map.safetensors", tmp_path / "drive.npz")
    shown = values(capsys, "report", *there, "--locate", "-o", page)
    assert shown["found"] == FEW
    assert page.stat().st_size == shown["report_bytes"]
    assert "the map explains" in page.read_text()
    assert refusal(capsys, tmp_path, "report", there[0], "--locate", "-o", page, status=2)
    yaw_deg = np.degrees(np.arctan2(drive.poses[0, 1, 0], drive.poses[0, 0, 0]))
    near = ["--guess", *drive.poses[0, :3, 3]]
    assert call("locate", *there, "-o", out, *near, yaw_deg) == 0
    assert "guess" in refusal(capsys, tmp_path, "locate", *there, "-o", out, *near, yaw_deg + 180)


def test_sessions_are_joined_in_a_folder(drive, tmp_path, capsys):
    T = np.eye(4)
    T[:3, 3] = 50, -20, 1
    for name, part, world in (("a", slice(0, 16), np.eye(4)), ("b", slice(8, 24), T)):
        scans = Scans(drive.points[part], world @ drive.poses[part], times_s=drive.times_s[part])
        write_scans(tmp_path / f"{name}.npz", scans)
    found = values(capsys, "join", tmp_path / "a.npz", tmp_path / "b.npz", "-o", tmp_path / "joined")
    assert found["joined"] == ["a.npz", "b.npz"]
    joined = read_scans(tmp_path / "joined" / "b.npz")
    assert np.abs(joined.poses - drive.poses[8:24])[:, :3, 3].max() < 0.2
    assert refusal(capsys, tmp_path, "join", tmp_path / "a.npz", "-o", tmp_path / "other", status=2)
