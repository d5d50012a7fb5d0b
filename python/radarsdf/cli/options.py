# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Options that several commands share, and what they stand for."""

from __future__ import annotations

import argparse
import ast
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from radarsdf import FitConfig


def add_fit_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that :func:`config_of` reads, and ``--quiet``."""
    add_config_options(parser)
    add_quiet(parser)


def add_config_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that :func:`config_of` reads."""
    presets = parser.add_mutually_exclusive_group()
    presets.add_argument(
        "--paper",
        action="store_true",
        help="use the published configuration: slower, for comparison",
    )
    presets.add_argument(
        "--quick",
        action="store_true",
        help="average distances instead of training the surface: less accurate, but done in under a second; "
        "mesh the map with --voxel 0.2",
    )
    parser.add_argument(
        "--config",
        type=Path,
        metavar="TOML",
        help="change the settings that this file has; radarsdf config prints all of them",
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="change one setting, such as leaf_size_m=0.3 or training.sdf_iterations=200; may be repeated",
    )


def config_of(options: argparse.Namespace) -> FitConfig:
    """The configuration: the chosen preset, then the changes of ``--config``, then those of ``--set``."""
    from radarsdf.config.fit_config import FitConfig
    from radarsdf.config.toml import read_toml

    config = FitConfig.paper() if options.paper else FitConfig.quick() if options.quick else FitConfig()
    if options.config is not None:
        config = config.override(**read_toml(options.config))
    for text in options.set:
        config = config.override(**setting_of(text))
    return config


def config_words(options: argparse.Namespace) -> list[str]:
    """The options that :func:`config_of` reads, as one would type them again."""
    words = [f"--{name}" for name in ("paper", "quick") if getattr(options, name)]
    words += [] if options.config is None else ["--config", str(options.config)]
    for text in options.set:
        words += ["--set", text]
    return words


def setting_of(text: str) -> dict[str, Any]:
    """One ``NAME=VALUE`` or ``GROUP.NAME=VALUE``. A value that is not a Python literal, such as octree, is a string."""
    path, equals, value = text.partition("=")
    if not equals:
        msg = f"--set takes NAME=VALUE, not {text!r:.50}"
        raise ValueError(msg)
    group, dot, name = path.partition(".")
    try:
        read = ast.literal_eval(value)
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError):
        read = {"true": True, "false": False}.get(value, value)  # as in TOML
    return {group: {name: read}} if dot else {path: read}


def add_quiet(parser: argparse.ArgumentParser) -> None:
    """Add the option that :func:`progress_of` reads."""
    parser.add_argument("--quiet", action="store_true", help="show no progress bar")


def progress_of(options: argparse.Namespace) -> bool | None:
    """The argument ``progress`` of a fit or a mesh. None: a bar if standard error is a terminal."""
    return False if options.quiet else None


def add_json(parser: argparse.ArgumentParser) -> None:
    """Add the option that :class:`radarsdf.cli.results.Results` reads."""
    parser.add_argument(
        "--json",
        action="store_true",
        help="print the results as one JSON object, lengths in m; progress and warnings go to standard error",
    )


def add_surface(parser: argparse.ArgumentParser) -> None:
    """Add ``--voxel``, and the options that :func:`limits_of` reads: those of every command that makes a mesh."""
    parser.add_argument(
        "--voxel", type=float, default=0.1, metavar="M", help="edge length of a voxel, m; default: 0.1"
    )
    parser.add_argument(
        "--min-confidence",
        type=float,
        metavar="C",
        help="leave out the surface whose confidence is below C, 0 to 1; default: that of the highest expected F-score",
    )
    parser.add_argument(
        "--max-uncertainty",
        type=float,
        metavar="M",
        help="leave out the surface whose standard error is above M, m; default: there is no limit",
    )
    parser.add_argument(
        "--min-component",
        type=int,
        metavar="N",
        help="leave out connected pieces of fewer triangles; default: 30, and fewer in voxels above 0.1 m",
    )


def limits_of(options: argparse.Namespace) -> dict[str, Any]:
    """What a mesh leaves out, as arguments of ``Map.mesh``."""
    return {
        "min_confidence": options.min_confidence,
        "max_uncertainty": options.max_uncertainty,
        "min_component_triangles": options.min_component,
    }


def add_box(parser: argparse.ArgumentParser) -> None:
    """Add the option that :func:`box_of` reads."""
    parser.add_argument(
        "--box",
        type=float,
        nargs=6,
        metavar=("X0", "Y0", "Z0", "X1", "Y1", "Z1"),
        help="use only the part between these two corners: lower, upper, world frame, m",
    )


def box_of(options: argparse.Namespace) -> list[list[float]] | None:
    """The lower and the upper corner, world frame, m. None: no box."""
    return None if options.box is None else [options.box[:3], options.box[3:]]


def add_address(parser: argparse.ArgumentParser) -> None:
    """Declare where a page is served: ``options.host`` and ``options.port``."""
    parser.add_argument(
        "--host",
        default="127.0.0.1",
        help="address to listen on; default: 127.0.0.1, which only this machine reaches; with 0.0.0.0 everyone who can reach "
        "the machine sees the map, by its address or its name",
    )
    parser.add_argument(
        "--port", type=int, metavar="N", help="port to listen on; default: 8080, or the next that is free"
    )


def check_address(options: argparse.Namespace) -> None:
    """Before any work: raises an ImportError if viser is missing, and an OSError if the address cannot be listened on."""
    from radarsdf.view.serving import free_port, require_viser

    require_viser()
    free_port(options.host, options.port or 0, exactly=True)
