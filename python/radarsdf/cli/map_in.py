# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Maps on the command line: in one file or in tiles, for every command that reads one."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from radarsdf.cli.saying import complain

if TYPE_CHECKING:
    from radarsdf.map.map import Map

MAP_SUFFIX = ".safetensors"
"""By which the file of a map is known from a mesh."""
MAP = f"a map: {MAP_SUFFIX} of radarsdf fit, or the folder of radarsdf tiles"


def add_map(parser: argparse.ArgumentParser) -> None:
    """Add the argument that :func:`load_map` reads."""
    parser.add_argument("map", type=Path, help=MAP)


def is_map(path: Path) -> bool:
    """Whether a path is to be read as a map, and not as a mesh."""
    return path.is_dir() or path.suffix == MAP_SUFFIX


def load_map(path: Path) -> Map:
    """Read a map. Tiles that are missing are said on standard error."""
    from radarsdf.tiles.tiled_map import lacking, load

    radar_map = load(path)
    if tiles := lacking(radar_map):
        complain(f"radarsdf: {path} lacks {tiles}: radarsdf tiles status {path} says why")
    return radar_map
