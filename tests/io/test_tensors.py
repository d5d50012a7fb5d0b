# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Damage inside the arrays of a file is found by checksums."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
import radarsdf
from radarsdf.fitting.checkpoint import Checkpoint

from .. import samples


def written_map(folder):
    path = folder / "map.safetensors"
    path.write_bytes(samples.maps()[0])
    return path, radarsdf.load


def written_checkpoint(folder):
    path = folder / "state"
    path.write_bytes(samples.checkpoints()[0])
    training, fit = samples.training(), samples.fit_of_checkpoints()
    return path, lambda path: Checkpoint(path, *fit).resume(training)


@pytest.mark.parametrize("write", [written_map, written_checkpoint])
def test_a_flipped_bit_is_found(tmp_path, write):
    path, read = write(tmp_path)
    data = path.read_bytes()
    read(path)
    rng = np.random.default_rng(0)
    for at in rng.integers(8 + int.from_bytes(data[:8], "little"), len(data), 30):
        damaged = bytearray(data)
        damaged[at] ^= 1 << int(rng.integers(8))
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match=re.escape(str(path))):
            read(path)


def test_files_without_checksums_are_read(tmp_path):
    path, read = written_map(tmp_path)
    data = path.read_bytes()
    size = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + size])
    old = {name: text for name, text in header["__metadata__"].items() if "crc32" not in name}
    assert set(old) == {"format", "format_version", "units", "description"}
    text = json.dumps(header | {"__metadata__": old}).encode()
    path.write_bytes(len(text).to_bytes(8, "little") + text + data[8 + size :])
    read(path)
