# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Positions as users give them to a map, and answers of the same kind."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from radarsdf.checks import real_array


def as_positions(x: Any, rows: int | None = None) -> tuple[Tensor, Callable[[Tensor], Any]]:
    """`x` as a tensor (N, 3), world, m, and a function that gives results the kind and precision of `x`.

    With `rows`, a single position (3,) is repeated so many times.

    Raises
    ------
    TypeError, ValueError
        If `x` is not (N, 3) real numbers on the CPU.
    """
    is_tensor = isinstance(x, Tensor)
    if is_tensor and (x.device.type != "cpu" or x.layout != torch.strided):
        msg = f"positions must be a dense tensor on the CPU, not {x.layout} on {x.device}"
        raise TypeError(msg)
    # Read-only arrays are copied, because PyTorch warns of them.
    world = (
        x.detach()
        if is_tensor
        else torch.from_numpy(np.require(real_array(x, "positions"), requirements=["C", "W"]))
    )
    dtype = x.dtype if is_tensor else getattr(x, "dtype", None)
    if rows is not None and world.shape == (3,):
        world = world.expand(rows, 3)
    if world.is_complex():
        msg = "positions must be real numbers"
        raise TypeError(msg)
    if world.ndim != 2 or world.shape[1] != 3 or (rows is not None and len(world) != rows):
        msg = f"positions must have shape (N, 3), not {tuple(world.shape)}"
        raise ValueError(msg)

    def answer(result: Tensor) -> Any:
        if result.dtype != torch.bool:
            keep_double = dtype in (torch.float64, np.dtype(np.float64), None)
            result = result.double() if keep_double else result.float()
        return result if is_tensor else result.numpy()

    return world, answer
