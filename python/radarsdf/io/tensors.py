"""Safetensors files whose arrays are read on demand."""

import json
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import cached_property
from typing import Any

from safetensors import safe_open
from safetensors.torch import save
from torch import Tensor

from radarsdf.checks import AnyPath, check

_CHECKSUMS = "crc32"  # key of the metadata: CRC-32 of each tensor by name, and of the other metadata as ""


def tensor_bytes(tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> bytes:
    """Encode tensors as a safetensors file with checksums."""
    tensors = {name: tensor.contiguous() for name, tensor in tensors.items()}
    checksums = {"": _metadata_checksum(metadata)}
    checksums |= {name: _checksum(tensor.numpy()) for name, tensor in tensors.items()}
    return save(tensors, {**metadata, _CHECKSUMS: json.dumps(checksums)})


def _metadata_checksum(metadata: Mapping[str, str]) -> int:
    return zlib.crc32(json.dumps(metadata, sort_keys=True).encode())


def _checksum(array: Any) -> int:
    seed = zlib.crc32(f"{array.dtype} {tuple(array.shape)}".encode())
    return zlib.crc32(array.reshape(-1).view("u1"), seed)


class TensorFile:
    """An open safetensors file that reads arrays on demand."""

    def __init__(self, file: Any) -> None:
        self._file = file
        self.names: list[str] = list(file.keys())
        self.metadata: dict[str, str] = file.metadata() or {}
        self._stated = self.metadata.pop(_CHECKSUMS, "{}")

    @cached_property
    def checksums(self) -> dict[str, int]:
        """CRC-32 by name of the array. Raises a ValueError if the metadata or the names differ from those written."""
        found: dict[str, int] = json.loads(self._stated)
        named = isinstance(found, dict) and set(found) == {"", *self.names}
        whole = named and found[""] == _metadata_checksum(self.metadata)
        check(whole, "the checksum of its metadata is wrong")
        return found

    def array(self, name: str) -> Any:
        """Return an array as a view of the file. Raise a ValueError if its checksum is wrong."""
        expected = self.checksums[name]
        array = self._file.get_tensor(name)
        found = _checksum(array.numpy() if isinstance(array, Tensor) else array)
        check(found == expected, f"the checksum of {name} is wrong")
        return array


@contextmanager
def open_tensors(path: AnyPath, framework: str = "pt") -> Iterator[TensorFile]:
    with safe_open(path, framework=framework) as file:
        yield TensorFile(file)
