# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Versions, compiler, instruction set and threads: what a bug report or a page about a map needs."""

from __future__ import annotations

import platform

import torch

import radarsdf.threads  # noqa: F401 - warns of an unknown RADARSDF_ISA
from radarsdf import _core


def versions() -> dict[str, str]:
    """Each part and its version, in words."""
    openmp = _core.openmp_version()
    return {
        "radarsdf": _core.__version__,
        "python": f"{platform.python_version()} on {platform.platform()}",
        "torch": f"{torch.__version__}, {torch.get_num_threads()} threads",
        "compiler": _core.compiler(),
        "openmp": f"{openmp}, {_core.num_threads()} threads" if openmp else "none: the core is serial",
        "instruction set": f"{_core.instruction_set()} of {', '.join(_core.available_instruction_sets())}",
    }
