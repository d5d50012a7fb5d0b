# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Safetensors files with a checksum of each array."""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from os import PathLike
from typing import Any

import numpy as np
from safetensors import safe_open
from safetensors.torch import save
from torch import Tensor

# CRC-32 finds each error of up to 32 bits in a row, and misses one of 4e9 others. One core reads 3.4 GB/s with it, with
# SHA-256 1.5 and blake2b 0.6; maps load at 0.06 to 0.12 GB/s, of which checksums take 4 to 8 %.
_CHECKSUM = "crc32"


def tensor_bytes(tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> bytes:
    """A safetensors file with checksums of its arrays and of `metadata`."""
    whole = {name: tensor.contiguous() for name, tensor in tensors.items()}
    checksums = {f"{_CHECKSUM} {name}": _checksum_of(tensor) for name, tensor in whole.items()}
    described = {**metadata, **checksums}
    return save(whole, described | {_CHECKSUM: _checksum_of_metadata(described)})


class TensorFile:
    """An open safetensors file, as ``safetensors.safe_open`` opens it. Older files have no checksums."""

    def __init__(self, file: Any) -> None:
        self._file = file
        self.names: list[str] = list(file.keys())
        described: dict[str, str] = file.metadata() or {}
        self._checksums = {name: text for name, text in described.items() if name.startswith(_CHECKSUM)}
        if self._checksums and described.pop(_CHECKSUM, None) != _checksum_of_metadata(described):
            msg = "the header is damaged: its checksum differs"
            raise ValueError(msg)
        self.metadata = {name: text for name, text in described.items() if name not in self._checksums}
        """What :func:`tensor_bytes` was given."""

    def array(self, name: str) -> Any:
        """An array of this name: a view of the file. Raises a ValueError if it is damaged."""
        array = self._file.get_tensor(name)
        if self._checksums and self._checksums.get(f"{_CHECKSUM} {name}") != _checksum_of(array):
            msg = f"{name} is damaged: its checksum differs"
            raise ValueError(msg)
        return array


@contextmanager
def open_tensors(path: str | PathLike[str], framework: str = "pt") -> Iterator[TensorFile]:
    """A safetensors file whose arrays, of this `framework`, are read as they are asked for."""
    with safe_open(path, framework=framework) as file:
        yield TensorFile(file)


def _checksum_of(array: Any) -> str:
    numbers: Any = np.asarray(array)
    return f"{zlib.crc32(numbers, zlib.crc32(f'{numbers.dtype} {numbers.shape}'.encode())):08x}"


def _checksum_of_metadata(metadata: Mapping[str, str]) -> str:
    return f"{zlib.crc32(json.dumps(metadata, sort_keys=True).encode()):08x}"
