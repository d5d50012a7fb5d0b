# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Scans of other formats on the command line: a folder of point clouds with a file of poses, fields and mountings."""

from __future__ import annotations

import argparse

import numpy as np
import pytest
import radarsdf
from radarsdf.cli.scans_in import add_scans, scans_of, words_of
from radarsdf.io.npz import read_scans
from scipy.spatial.transform import Rotation

from .calls import FAST, call, refusal


@pytest.fixture
def folder(scans_file, tmp_path):
    """The scans as point clouds in text files, and their poses as a file in TUM format."""
    scans = read_scans(scans_file)
    (tmp_path / "clouds").mkdir()
    lines = []
    for i, (points, pose, power) in enumerate(zip(scans.points, scans.poses, scans.intensities, strict=True)):
        np.savetxt(
            tmp_path / "clouds" / f"{100 + i}.0.csv",
            np.column_stack([points, power]),
            delimiter=",",
            header="x,y,z,echo",
            comments="",
        )
        numbers = [100 + i, *pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat()]
        lines.append(" ".join(f"{number:.9f}" for number in numbers))
    (tmp_path / "poses.tum").write_text("\n".join(lines) + "\n")
    return tmp_path


def fit_of(folder, *words):
    out = folder / "map.safetensors"
    assert call("fit", folder / "clouds", folder / "poses.tum", "-o", out, *FAST, *words) == 0
    return radarsdf.load(out)


def test_a_folder_with_a_file_of_poses(folder, scans_file):
    radar_map = fit_of(folder, "--field", "intensity=echo")
    expected = read_scans(scans_file)
    assert radar_map.report["returns"] == sum(map(len, expected.points))
    assert radar_map.intensity_scale.high == pytest.approx(
        max(v.max() for v in expected.intensities), rel=1e-6
    )
    lattice = radar_map.config.lattice
    origin = lattice.position(lattice.nearest_block(expected.poses[:, :3, 3].mean(axis=0)))
    np.testing.assert_allclose(radar_map.origin, origin, atol=1e-6)


def test_a_mounting_moves_the_sensor(folder):
    mounting = np.eye(4)
    mounting[:3, 3] = [0.0, 0.0, 6.4]
    np.savetxt(folder / "mounting.txt", mounting)
    plain, moved = fit_of(folder), fit_of(folder, "--extrinsic", folder / "mounting.txt")
    np.testing.assert_allclose(moved.origin - plain.origin, [0, 0, 6.4], atol=1e-6)


def test_poses_behind_an_option(folder, capsys):
    out = folder / "map.safetensors"
    words = [folder / "clouds", "--field", "intensity=echo", folder / "poses.tum", "--dry-run"]
    assert call("fit", *words) == 0
    assert capsys.readouterr().out.startswith("9000 returns")
    assert not out.exists()


def test_poses_that_are_missing(folder, capsys):
    (folder / "poses.tum").unlink()  # which would be found beside the folder
    for i in range(3, 6):  # fewer scans are placed in less time
        (folder / "clouds" / f"{100 + i}.0.csv").unlink()
    said = refusal(capsys, folder, "fit", folder / "clouds", "-o", folder / "map.safetensors")
    assert f"{folder / 'clouds'} has no poses" in said


def test_several_topics_of_a_bag(tmp_path):
    pytest.importorskip("rosbags", reason="the extra ros is not installed")
    from tests.io.bag_writing import BagWriter  # noqa: PLC0415 - it takes rosbags

    with BagWriter(tmp_path / "a.bag", "ros1") as bag:
        for time_s in (100.0, 100.1, 100.2):
            bag.write("/odom", bag.odometry(time_s, np.eye(4), child="radar"), time_s)
            for topic in ("/front", "/rear", "/lidar"):
                bag.write(topic, bag.cloud2(time_s, {"x": [1.0], "y": [2.0], "z": [3.0]}), time_s)
    words = [tmp_path / "a.bag", "--topic", "/front", "--topic", "/rear"]
    assert call("convert", *words, "-o", tmp_path / "b.npz") == 0
    assert len(read_scans(tmp_path / "b.npz")) == 6


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--field", "intensity"], "--field takes ROLE=NAME, not 'intensity'"),
        (["--field", "intensity=nothing"], "nothing"),
        (["--extrinsic", "poses.tum"], "poses.tum is no extrinsic: that is a 4 x 4 matrix"),
    ],
)
def test_words_that_are_wrong(folder, capsys, words, said):
    words = [folder / word if word.endswith(".tum") else word for word in words]
    arguments = ["fit", folder / "clouds", folder / "poses.tum", "-o", folder / "map.safetensors", *words]
    assert said in refusal(capsys, folder, *arguments)


def test_options_are_the_parameters_of_read(tmp_path):
    (tmp_path / "scans").mkdir()
    for i in range(4):
        np.array([[9, 5 + i, 1, 2], [9, 6 + i, 2, 3]], "<f4").tofile(
            tmp_path / "scans" / f"{100 + 2 * i}.0.bin"
        )
    (tmp_path / "poses.tum").write_text("".join(f"{100 + 4 * i} {i} 0 0 0 0 0 1\n" for i in range(3)))
    words = [tmp_path / "scans", tmp_path / "poses.tum", "--columns", "power,x,y,z"]
    for more, count in (([], 2), (["--max-gap", "5"], 4)):
        parser = argparse.ArgumentParser()
        add_scans(parser)
        options = parser.parse_args([str(word) for word in (*words, *more)])
        scans = scans_of(options)
        assert len(scans) == count
        np.testing.assert_array_equal(scans.points[0], [[5, 1, 2], [6, 2, 3]])
        assert parser.parse_args(words_of(options)) == options
    for more in (["--stamps", "record"], ["--world-frame", "map"]):
        with pytest.raises(ValueError, match=f"no bag: {more[0][2:].replace('-', '_')}"):
            scans_of(parser.parse_args([str(word) for word in (*words, *more)]))
