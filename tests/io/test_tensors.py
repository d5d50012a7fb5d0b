# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Damage inside the arrays of a file is found by checksums, in files of every kind that the package writes for itself."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
import radarsdf
from radarsdf import LiveMap
from radarsdf.fitting.checkpoint import Checkpoint
from radarsdf.map.storage import load_contents
from radarsdf.tiles.plan import Plan, map_path

from .. import samples
from ..conftest import ground_and_wall
from ..tiles.conftest import CONFIG


@pytest.fixture(scope="module")
def scene():
    return ground_and_wall(scans=3, returns_per_scan=300)


def written_map(_, folder):
    path = folder / "map.safetensors"
    path.write_bytes(samples.maps()[0])
    return path, radarsdf.load


def written_checkpoint(_, folder):
    path = folder / "state"
    path.write_bytes(samples.checkpoints()[0])
    training, fit = samples.training(), samples.fit_of_checkpoints()
    return path, lambda path: Checkpoint(path, *fit).resume(training)


def written_tile(scene, folder):
    scans = radarsdf.io.Scans(scene.points, scene.poses)
    radarsdf.fit_tiles(scans, folder / "city", config=CONFIG, progress=False)
    plan = Plan.load(folder / "city")
    return map_path(folder / "city", plan.tiles[0]), load_contents


def written_live_state(scene, folder):
    live = LiveMap()
    for points, pose in zip(scene.points, scene.poses, strict=True):
        live.integrate(points, pose)
    live.save(folder / "live.npz")
    return folder / "live.npz", LiveMap.load


def places(data):
    """First and last byte of the arrays: of a safetensors file all that follow the header, of a zip those of the points."""
    if data[:2] != b"PK":
        return 8 + int.from_bytes(data[:8], "little"), len(data)
    first = data.index(b"\n", data.index(b"points.npy")) + 1  # after the header of the array
    return first, first + 3 * 900 * 4


@pytest.mark.parametrize("write", [written_map, written_checkpoint, written_tile, written_live_state])
def test_a_flipped_bit_is_found(scene, tmp_path, write):
    path, read = write(scene, tmp_path)
    data = path.read_bytes()
    read(path)
    rng = np.random.default_rng(0)
    for at in rng.integers(*places(data), 40):
        damaged = bytearray(data)
        damaged[at] ^= 1 << int(rng.integers(8))
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match=re.escape(str(path))):
            read(path)


def test_files_without_checksums_are_read(tmp_path):
    path, read = written_map(None, tmp_path)
    data = path.read_bytes()
    size = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + size])
    old = {name: text for name, text in header["__metadata__"].items() if "crc32" not in name}
    assert set(old) == {"format", "format_version", "units", "description"}
    text = json.dumps(header | {"__metadata__": old}).encode()
    path.write_bytes(len(text).to_bytes(8, "little") + text + data[8 + size :])
    read(path)
