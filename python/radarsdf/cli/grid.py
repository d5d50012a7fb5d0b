# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""``radarsdf grid``: from a map to what planners read."""

from __future__ import annotations

import argparse
from pathlib import Path

from radarsdf.cli.map_in import add_map, load_map
from radarsdf.cli.options import add_box, add_json, box_of
from radarsdf.cli.results import Results


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    add_map(parser)
    parser.add_argument(
        "-o",
        "--out",
        type=Path,
        action="append",
        required=True,
        help="a file to write, may be repeated: .npz with all arrays, .ply of the voxels' centres, .bt for OctoMap, .yaml and .pgm for ROS's "
        "map_server",
    )
    parser.add_argument(
        "--voxel", type=float, default=0.2, metavar="M", help="edge length of a voxel, m; default: 0.2"
    )
    add_box(parser)
    parser.add_argument(
        "--heights",
        type=float,
        nargs=2,
        default=(0.3, 2.0),
        metavar=("LOW", "HIGH"),
        help="of the .yaml: what is between these heights above the ground, m; default: 0.3 2.0",
    )
    parser.add_argument(
        "--distances", type=Path, metavar="NPZ", help="also write the Euclidean distance field of the grid"
    )
    parser.add_argument(
        "--costmap", type=Path, metavar="NPZ", help="also write heights, slopes, steps and costs for wheels"
    )
    parser.add_argument(
        "--picture", type=Path, metavar="PNG", help="also draw heights, costs and what is free"
    )
    add_json(parser)


def run(options: argparse.Namespace) -> None:
    """Make the grid, write its files, draw it."""
    from radarsdf.extras import require
    from radarsdf.grids.files import check_arrays_path, check_flat_path, check_grid_path
    from radarsdf.grids.grid import save_arrays
    from radarsdf.grids.occupancy import grid as grid_of
    from radarsdf.io.files import check_outputs

    flat = [path for path in options.out if path.suffix == ".yaml"]
    whole = [path for path in options.out if path.suffix != ".yaml"]
    for path in whole:
        check_grid_path(path)
    for path in flat:
        check_flat_path(path)
    arrays = [options.distances, options.costmap]
    for path in arrays:
        check_arrays_path(path)
    if options.picture:
        require("matplotlib", what="pictures need")
    outputs = [*options.out, *(path.with_suffix(".pgm") for path in flat), *arrays, options.picture]
    check_outputs(outputs, [options.map])
    radar_map = load_map(options.map)
    box = box_of(options)
    grid = grid_of(radar_map, radar_map.extent if box is None else box, options.voxel)
    low, high = options.heights
    for path in whole:
        grid.save(path)
    for path in flat:
        grid.flat(low, high).save(path)
    if options.distances:
        save_arrays(options.distances, grid, grid.distances())
    if options.costmap:
        save_arrays(options.costmap, grid, grid.costmap())
    results = Results(options)
    shares = {name: float(getattr(grid, name).mean()) for name in ("occupied", "free", "unknown")}
    x, y, z = grid.shape
    results.add(
        f"{x} x {y} x {z} voxels of {grid.voxel_size:g} m from {grid.origin[0]:.2f} {grid.origin[1]:.2f} {grid.origin[2]:.2f}: "
        + ", ".join(f"{100 * share:.1f} % {name}" for name, share in shares.items()),
        shape=grid.shape,
        origin=grid.origin,
        voxel_size=grid.voxel_size,
        **shares,
    )
    if options.picture:
        from radarsdf.render.figures import save_grid_picture

        save_grid_picture(options.picture, grid, low, high)
    for path in outputs:
        if path is not None:
            results.add(f"{path} written")
    results.add(out=[path for path in outputs if path is not None])
    results.end()
