# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""``radarsdf info``: what a bug report needs."""

from __future__ import annotations

import argparse
import platform

from radarsdf.cli.options import add_json
from radarsdf.cli.results import Results


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add_json(parser)


def run(options: argparse.Namespace) -> None:
    """Print one line for each part."""
    import torch

    import radarsdf.threads  # noqa: F401 - warns of an unknown RADARSDF_ISA
    from radarsdf import _core

    openmp = _core.openmp_version()
    rows = {
        "radarsdf": _core.__version__,
        "python": f"{platform.python_version()} on {platform.platform()}",
        "torch": f"{torch.__version__}, {torch.get_num_threads()} threads",
        "compiler": _core.compiler(),
        "openmp": f"{openmp}, {_core.num_threads()} threads" if openmp else "none: the core is serial",
        "instruction set": f"{_core.instruction_set()} of {', '.join(_core.available_instruction_sets())}",
    }
    results = Results(options)
    for name, value in rows.items():
        results.add(f"{name:<16}{value}", **{name.replace(" ", "_"): value})
    results.end()
