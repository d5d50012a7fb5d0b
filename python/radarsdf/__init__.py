# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""From 3D radar scans with known poses to a surface and a reflectance map, on a CPU."""

import importlib
from types import ModuleType
from typing import TYPE_CHECKING

import torch  # noqa: F401 - before the compiled core, which then shares PyTorch's OpenMP runtime

from radarsdf.budget.estimate import Estimate, estimate
from radarsdf.config import FitConfig
from radarsdf.fitting.fit import fit
from radarsdf.fitting.stopping import Diverged, Interrupted
from radarsdf.map.isosurface import marching_cubes
from radarsdf.map.radar_map import RadarMap, load

if TYPE_CHECKING:
    from radarsdf import evaluation, simulate

__all__ = [
    "Diverged",
    "Estimate",
    "FitConfig",
    "Interrupted",
    "RadarMap",
    "estimate",
    "evaluation",
    "fit",
    "load",
    "marching_cubes",
    "simulate",
]


def __getattr__(name: str) -> ModuleType:
    # Parts that a fit does not need, and SciPy with them, are imported when first asked for: they would be most of
    # what `import radarsdf` costs beyond importing torch.
    if name in ("evaluation", "simulate"):
        return importlib.import_module(f"radarsdf.{name}")
    msg = f"module 'radarsdf' has no attribute {name!r}"
    raise AttributeError(msg)
