"""`radarsdf poses`, and fits of scans with refined or missing poses."""

import numpy as np
import pytest
import radarsdf
from radarsdf.io.npz import read_scans, write_scans
from radarsdf.scans import Scans
from radarsdf.simulate import drifted, measured_motion

from ..poses.drift import first, position_error_m
from ..poses.test_odometry import errors
from .calls import call, refusal, values

FRAMES = 24
FEW = 12  # to locate


@pytest.fixture(scope="module")
def simulation():
    """The first scans of a drive."""
    return first(radarsdf.simulate.oculii, FRAMES, seed=62, frames=120)


@pytest.fixture(scope="module")
def drive(simulation):
    return Scans(simulation.points, simulation.poses, simulation.intensities)


@pytest.fixture(scope="module")
def motion(simulation):
    """Measurements of their motion."""
    return measured_motion(simulation)


@pytest.fixture
def drifted_file(drive, motion, tmp_path):
    """Scans with drifting poses."""
    path = tmp_path / "drive.npz"
    poses = drifted(drive.poses, 0.05, 0.004, 1)
    speeds = motion.doppler_mps
    write_scans(
        path, Scans(drive.points, poses, drive.intensities, doppler_mps=speeds, times_s=motion.times_s)
    )
    return path


@pytest.fixture
def unposed(drive, motion, tmp_path):
    """A folder of scans with Doppler and times, and no poses."""
    folder = tmp_path / "scans"
    folder.mkdir()
    for scan, speeds, time_s in zip(drive.points, motion.doppler_mps, motion.times_s, strict=True):
        table = np.column_stack([scan, speeds])
        np.savetxt(
            folder / f"{100 + time_s:.3f}.csv", table, delimiter=",", header="x,y,z,doppler", comments=""
        )
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
    assert mended["poses"]["moved_m"] == pytest.approx(
        position_error_m(read_scans(drifted_file).poses, drive.poses), rel=0.9
    )


def test_segments_are_not_joined(drive, motion, tmp_path, capsys):
    other = radarsdf.simulate.wall(seed=63, frames=5)
    later = measured_motion(other)
    path = tmp_path / "two.npz"
    write_scans(
        path,
        Scans(
            drive.points + other.points,
            np.tile(np.eye(4), (FRAMES + len(other.points), 1, 1)),
            doppler_mps=motion.doppler_mps + later.doppler_mps,
            times_s=np.r_[motion.times_s, later.times_s + 60],
        ),
    )
    out = tmp_path / "poses.tum"
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


def test_scans_are_located_in_a_map(drive, motion, tmp_path, capsys):
    scans = Scans(drive.points, drive.poses, doppler_mps=motion.doppler_mps, times_s=motion.times_s)
    write_scans(tmp_path / "drive.npz", scans.select(range(FEW)))
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


def test_sessions_are_joined_in_a_folder(drive, motion, tmp_path, capsys):
    T = np.eye(4)
    T[:3, 3] = 50, -20, 1
    for name, part, world in (("a", slice(0, 16), np.eye(4)), ("b", slice(8, 24), T)):
        times_s = motion.times_s[part]
        write_scans(
            tmp_path / f"{name}.npz", Scans(drive.points[part], world @ drive.poses[part], times_s=times_s)
        )
    found = values(capsys, "join", tmp_path / "a.npz", tmp_path / "b.npz", "-o", tmp_path / "joined")
    assert found["joined"] == ["a.npz", "b.npz"]
    joined = read_scans(tmp_path / "joined" / "b.npz")
    assert np.abs(joined.poses - drive.poses[8:24])[:, :3, 3].max() < 0.2
    assert refusal(capsys, tmp_path, "join", tmp_path / "a.npz", "-o", tmp_path / "other", status=2)
