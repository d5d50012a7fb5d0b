# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Paths that are not UTF-8, as Linux allows them: what is written there is read."""

from __future__ import annotations

import os
import sys

import numpy as np
import pytest
import radarsdf
from radarsdf.fitting.checkpoint import Checkpoint
from radarsdf.io import read
from radarsdf.io.clouds.writing import write_cloud
from radarsdf.io.files import in_utf8
from radarsdf.io.meshes import read_mesh
from radarsdf.io.scans import Scans

from .. import samples
from . import readers

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="names are text elsewhere")


@pytest.fixture
def folder(tmp_path):
    path = tmp_path / os.fsdecode(b"\xff\xfe")
    path.mkdir()
    return path


def test_a_map(folder, sharp_map):
    path = folder / os.fsdecode(b"\xfe.safetensors")
    sharp_map.save(path)
    x = np.array([[12.0, 1.0, 0.1], [3.0, 0.0, 1.0]])
    np.testing.assert_array_equal(radarsdf.load(path).sdf(x), sharp_map.sdf(x))


def test_a_checkpoint(folder):
    path = folder / "state"
    path.write_bytes(samples.checkpoints()[0])
    training = samples.training()
    Checkpoint(path, *samples.fit_of_checkpoints()).resume(training)
    np.testing.assert_array_equal(
        *(state["field.cells.features"] for state in (training.state(), samples.training().state()))
    )


@pytest.mark.parametrize("kind", ["ros1", "sqlite3", "mcap"])
def test_a_bag(folder, kind):
    pytest.importorskip("rosbags", reason="the extra ros is not installed")
    path = folder / ("drive.bag" if kind == "ros1" else "drive")
    readers._bag(path, kind, 0)
    assert len(read(path, max_gap_s=1e12)) == 4


@pytest.mark.parametrize("suffix", [".ply", ".pcd", ".npy", ".csv", ".las", ".laz"])
def test_a_cloud(folder, suffix):
    if suffix in (".las", ".laz"):
        pytest.importorskip("laspy", reason="the extra las is not installed")
    scans = Scans([np.eye(3)], np.eye(4)[None])
    write_cloud(folder / f"cloud{suffix}", scans)
    (scan,) = read(folder / f"cloud{suffix}", [np.eye(4)])
    np.testing.assert_allclose(scan.points, np.eye(3), atol=1e-3)


def test_a_mesh(folder):
    (folder / "mesh.ply").write_bytes(samples.meshes()[1])
    assert len(read_mesh(folder / "mesh.ply").faces) == 12


def test_a_link_is_made_only_where_it_must_be_and_does_not_stay(folder, tmp_path):
    with in_utf8(tmp_path) as path:
        assert path == tmp_path
    (folder / "a.txt").write_text("a")
    with in_utf8(folder / "a.txt") as path:
        assert path.suffix == ".txt"
        assert path.read_text() == "a"
        os.fspath(path).encode()
    assert not path.parent.exists()
