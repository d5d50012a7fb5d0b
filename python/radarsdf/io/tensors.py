"""Safetensors files whose arrays are read on demand."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from os import PathLike
from typing import Any

from safetensors import safe_open
from safetensors.torch import save
from torch import Tensor


def tensor_bytes(tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> bytes:
    """Encode tensors as a safetensors file."""
    return save({name: tensor.contiguous() for name, tensor in tensors.items()}, dict(metadata))


class TensorFile:
    """An open safetensors file that reads arrays on demand."""

    def __init__(self, file: Any) -> None:
        self._file = file
        self.names: list[str] = list(file.keys())
        self.metadata: dict[str, str] = file.metadata() or {}

    def array(self, name: str) -> Any:
        """Return an array as a view of the file."""
        return self._file.get_tensor(name)


@contextmanager
def open_tensors(path: str | PathLike[str], framework: str = "pt") -> Iterator[TensorFile]:
    """Open a safetensors file with arrays of this `framework`."""
    with safe_open(path, framework=framework) as file:
        yield TensorFile(file)
