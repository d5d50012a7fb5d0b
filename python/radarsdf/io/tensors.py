# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The one way in which safetensors files are opened."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike
from typing import Any

from safetensors import safe_open

from radarsdf.io.files import in_utf8


@contextmanager
def open_tensors(path: str | PathLike[str], framework: str = "pt") -> Iterator[Any]:
    """A safetensors file, whose tensors are read as they are asked for: see ``safetensors.safe_open``.

    Yields
    ------
    file
        Its tensors are views of the file.

    Raises
    ------
    SafetensorError
        If it is no such file, or cut off.
    OSError
        If it cannot be read.
    """
    with in_utf8(path) as readable, safe_open(readable, framework=framework) as file:
        yield file
