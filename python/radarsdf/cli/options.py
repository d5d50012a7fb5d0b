# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Options that several commands share, and what they stand for."""

from __future__ import annotations

import argparse
import ast
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from radarsdf import FitConfig


def add_fit_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that :func:`config_of` reads, and ``--quiet``."""
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
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="change a setting of FitConfig; may be repeated",
    )
    add_quiet(parser)


def config_of(options: argparse.Namespace) -> FitConfig:
    """The configuration: the chosen preset with the changes of ``--set``."""
    from radarsdf import FitConfig

    changes = dict(_setting(text) for text in options.set)
    base = FitConfig.paper() if options.paper else FitConfig.quick() if options.quick else FitConfig()
    return FitConfig.from_dict(base.to_dict() | changes)


def _setting(text: str) -> tuple[str, Any]:
    """Name and value of one ``NAME=VALUE``. A value that is not a Python literal, such as octree, is a string."""
    name, equals, value = text.partition("=")
    if not equals:
        msg = f"--set takes NAME=VALUE, not {text!r}"
        raise ValueError(msg)
    try:
        return name, ast.literal_eval(value)
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError):
        return name, value


def add_quiet(parser: argparse.ArgumentParser) -> None:
    """Add the option that :func:`progress_of` reads."""
    parser.add_argument("--quiet", action="store_true", help="show no progress bar")


def progress_of(options: argparse.Namespace) -> bool | None:
    """The argument ``progress`` of a fit or a mesh. None: a bar if standard error is a terminal."""
    return False if options.quiet else None


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
