"""``radarsdf config`` and ``info``, and the settings of other commands."""

import ast
import platform
from argparse import Namespace
from typing import Any

from radarsdf.cli import Results
from radarsdf.cli.options import refuse_if
from radarsdf.config.fit_config import FitConfig, read_toml, to_toml


def config(given: Namespace, results: Results) -> None:
    results.add(to_toml(load_config(given)).rstrip("\n"))


def load_config(given: Namespace) -> FitConfig:
    """Build the configuration: a preset, then the settings of a file, then single settings."""
    refuse_if(given.paper and given.quick, "--paper and --quick are two presets: leave out one of them")
    config = FitConfig.paper() if given.paper else FitConfig.quick() if given.quick else FitConfig()
    if given.config is not None:
        config = config.override(**read_toml(given.config))
    for text in given.set or ():
        config = config.override(**_setting_of(text))
    return config


def _setting_of(text: str) -> dict[str, Any]:
    """Parse one ``NAME=VALUE`` or ``GROUP.NAME=VALUE``. A value that is not a Python literal, such as octree, is a string."""
    path, equals, value = text.partition("=")
    refuse_if(not equals, f"--set takes NAME=VALUE, not {text!r:.50}")
    group, dot, name = path.partition(".")
    try:
        read = ast.literal_eval(value)
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError):
        read = {"true": True, "false": False}.get(value, value)  # as in TOML
    return {group: {name: read}} if dot else {path: read}


def info(given: Namespace, results: Results) -> None:
    import torch

    from radarsdf import core

    openmp = core.openmp_version()
    rows: dict[str, Any] = {
        "radarsdf": core.__version__,
        "python": f"{platform.python_version()} on {platform.platform()}",
        "torch": f"{torch.__version__}, {torch.get_num_threads()} threads",
        "compiler": core.compiler(),
        "openmp": f"{openmp}, {core.num_threads()} threads" if openmp else "none: the core is serial",
        "instruction_set": f"{core.instruction_set()} of {', '.join(core.available_instruction_sets())}",
    }
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
