"""``radarsdf info``: versions, and what a map holds."""

from __future__ import annotations

import platform
from argparse import Namespace
from typing import Any

import torch

from radarsdf import _core
from radarsdf.cli.results import Results


def versions() -> dict[str, str]:
    """Version, compiler, instruction set and threads of each component."""
    openmp = _core.openmp_version()
    return {
        "radarsdf": _core.__version__,
        "python": f"{platform.python_version()} on {platform.platform()}",
        "torch": f"{torch.__version__}, {torch.get_num_threads()} threads",
        "compiler": _core.compiler(),
        "openmp": f"{openmp}, {_core.num_threads()} threads" if openmp else "none: the core is serial",
        "instruction set": f"{_core.instruction_set()} of {', '.join(_core.available_instruction_sets())}",
    }


def info(given: Namespace, results: Results) -> None:
    """Print one row per component."""
    rows: dict[str, Any] = {name.replace(" ", "_"): value for name, value in versions().items()}
    if given.map is not None:
        from radarsdf.cli.inputs import load_map

        radar_map = load_map(given.map)
        scale, report = radar_map.intensity_scale, radar_map.report
        rows |= {
            "map": repr(radar_map),
            **{name: report[name] for name in ("scans", "returns", "missing_tiles") if report.get(name)},
            "extent": radar_map.extent.round(2).tolist(),
            "bytes": radar_map.file_bytes,
            "leaf_cells": radar_map.num_cells,
            "leaf_size_m": radar_map.config.leaf_size_m,
            "origin": radar_map.origin.tolist(),
            "range_m": [round(float(range_m), 2) for range_m in radar_map.sensor.range_m],
            "intensities": None if scale is None else [scale.low, scale.high],
            "clutter_ratio": round(radar_map.clutter_ratio, 3),
        }
    results.add(**rows)
    results.table((name.replace("_", " "), str(value)) for name, value in rows.items())
