"""``radarsdf fit`` and ``demo``: the map, the printed report, and failures to write."""

import re

import numpy as np
import pytest
import radarsdf
import trimesh
from radarsdf.checking.doppler import velocity_of_poses
from radarsdf.io import Scans, write_scans

from ..conftest import pose
from .calls import FAST, QUICK, call, files, refusal, values


def test_the_map_uses_the_given_scans_and_settings(map_file):
    radar_map = radarsdf.load(map_file)
    assert radar_map.has_intensity
    assert radar_map.report["returns"] == 4 * 1500  # scans 0 and 3 of six are held out
    assert (radar_map.config.training.sdf_iterations, radar_map.config.training.batch_size) == (40, 1024)


def test_geometry_only_combines_with_a_preset(scans_file, tmp_path, capsys):
    path = tmp_path / "map.safetensors"
    assert call("fit", scans_file, "-o", path, "--geometry-only", "--holdout", 3, *QUICK) == 0
    printed = capsys.readouterr().out.splitlines()
    assert printed[0].startswith("6000 of 6000 returns in 4 scans")
    assert printed[-1] == f"next: radarsdf mesh {path} -o {path.with_suffix('.ply')} --voxel 0.2"
    radar_map = radarsdf.load(path)
    assert not radar_map.has_intensity
    assert radar_map.config == radarsdf.FitConfig.quick()


@pytest.mark.parametrize("options", [[], ["--geometry-only"]])
def test_radars_of_a_rig_are_placed_by_their_mountings(scene, tmp_path, options, capsys):
    mountings = {"front": pose([1.0, 0, 0.5]), "rear": pose([-1.0, 0.2, 0], np.pi)}
    labels = ["front", "rear"] * 3
    body = [T @ np.linalg.inv(mountings[label]) for T, label in zip(scene.poses, labels, strict=True)]
    rig = Scans(scene.points, np.stack(body), scene.intensities, sensors=labels, T_body_sensor=mountings)
    write_scans(tmp_path / "rig.npz", rig)
    assert call("fit", tmp_path / "rig.npz", "-o", tmp_path / "map.safetensors", *QUICK, *options) == 0
    radar_map = radarsdf.load(tmp_path / "map.safetensors")
    assert radar_map.has_intensity == (not options)
    distances = radar_map.sdf(np.concatenate([scan.world_points for scan in rig]))
    assert np.nanmedian(np.abs(distances)) < 0.1
    estimated = values(capsys, "fit", tmp_path / "rig.npz", "--dry-run", *options)
    write_scans(tmp_path / "one.npz", Scans(scene.points, scene.poses, scene.intensities))
    assert estimated == values(capsys, "fit", tmp_path / "one.npz", "--dry-run", *options)


def test_text_and_json_reports_of_a_fit_agree(tmp_path, capsys):
    scans = radarsdf.simulate.wall(frames=6)
    rng = np.random.default_rng(0)
    doppler = []
    velocities = velocity_of_poses(scans.poses, 0.1 * np.arange(6))
    for points, velocity in zip(scans.points, velocities, strict=True):
        away = points / np.linalg.norm(points, axis=1, keepdims=True)
        doppler.append(-away @ velocity + 3.0 * (rng.random(len(points)) < 0.1))
    intensities = [np.where(np.arange(len(scan)) % 100, scan, -9999) for scan in scans.intensities]
    path = tmp_path / "scans.npz"
    write_scans(path, Scans(scans.points, scans.poses, intensities, doppler_mps=doppler))
    words = ["fit", path, "-o", tmp_path / "map.safetensors", *FAST]
    assert call(*words) == 0
    printed = capsys.readouterr().out
    found = values(capsys, *words)
    used, returns, scans_used = map(int, re.match(r"(\d+) of (\d+) returns in (\d+) scans", printed).groups())
    assert (used, returns, scans_used) == (found["returns_used"], found["returns"], found["scans"])
    assert f"{found['moving']} move according to their Doppler" in printed
    assert 0.08 * returns < found["moving"] < 0.12 * returns
    assert f"{found['intensity_outliers']} intensities are outliers" in printed
    assert f"sdf loss {found['losses']['sdf']:.3g}" in printed
    dry = values(capsys, "fit", path, "--dry-run")
    assert dry["returns"] < found["returns"]  # only those within the ranges
    assert dry["peak_memory_bytes"] > 0


def test_the_checkpoint_is_used_and_removed(scans_file, tmp_path, capsys):
    state, out = tmp_path / "state", tmp_path / "map.safetensors"
    state.write_bytes(b"no state of a fit")
    words = ["fit", scans_file, "-o", out, "--checkpoint", state, *FAST]
    assert str(state) in refusal(capsys, tmp_path, *words)
    state.unlink()
    assert call(*words) == 0
    assert files(tmp_path) == ["map.safetensors"]


def test_errors_of_a_fit_exit_with_one_line(scans_file, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "garbage.npz").write_bytes(b"\x93 nothing \x00\xff")
    out = ["-o", "map.safetensors"]
    for words, named in (
        (["absent.npz", *out], "absent.npz"),
        (["garbage.npz", *out], "garbage.npz"),
        ([scans_file, "-o", "absent/map.safetensors"], "absent"),
        ([scans_file, *out, "--set", "training.learning_rate=1e30", *FAST], "learning rate"),
        ([scans_file, *out, "--topic", "/radar"], "topic"),
        ([scans_file, *out, "--field", "intensity=Power"], "Power"),
        ([scans_file, *out, "--checkpoint", "map.safetensors"], "same file"),
        ([scans_file, *out, "--report", "map.safetensors"], "same file"),
    ):
        assert named in refusal(capsys, tmp_path, "fit", *words)


def test_the_map_of_an_interrupted_fit_is_written(scans_file, tmp_path, monkeypatch, capsys):
    fit = radarsdf.fit

    def interrupted(*scans, **settings):
        raise radarsdf.Interrupted(fit(*scans, **settings))

    monkeypatch.setattr(radarsdf, "fit", interrupted)
    out = tmp_path / "map.safetensors"
    assert call("fit", scans_file, "-o", out, *QUICK) == 130
    said = capsys.readouterr().err
    assert said.startswith("error: interrupted")
    assert str(out) in said
    radarsdf.load(out)


def test_the_demo_writes_everything_and_prints_the_errors(tmp_path, capsys):
    out = tmp_path / "demo"
    assert call("demo", "--frames", 4, "--out", out, "--voxel", 0.2, *FAST) == 0
    printed = capsys.readouterr()
    assert files(out) == ["map.safetensors", "mesh.ply", "picture.png", "scans.npz"]
    for word in ("accuracy", "completion", "F-score", "held-out intensity error", "kNN      intensity error"):
        assert word in printed.out
    assert printed.err == ""
    assert len(trimesh.load_mesh(out / "mesh.ply", process=False).faces) > 0
    assert (out / "picture.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("screen", [True, False])
def test_the_demo_opens_the_viewer_if_interactive(screen, tmp_path, monkeypatch):
    pytest.importorskip("viser", reason="the extra view is not installed")
    calls = []
    monkeypatch.setattr("radarsdf.view.serving.has_display", lambda: screen)
    monkeypatch.setattr("radarsdf.cli.maps.view", lambda *_, **__: calls.append(1))
    monkeypatch.setattr("sys.stdout.isatty", lambda: True, raising=False)
    words = ["--scene", "wall", "--frames", 2, "-o", tmp_path, "--voxel", 0.4]
    assert call("demo", *words, *QUICK[:2]) == 0
    assert len(calls) == screen
