# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""``radarsdf mesh``: from a map to a triangle mesh."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from radarsdf.cli.map_in import add_map, load_map
from radarsdf.cli.options import add_box, add_json, add_quiet, add_surface, box_of, limits_of, progress_of
from radarsdf.cli.results import Results

if TYPE_CHECKING:
    import numpy as np
    import trimesh
    from numpy.typing import NDArray


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    add_map(parser)
    parser.add_argument(
        "-o", "--out", type=Path, required=True, help="the mesh to write: .ply, .obj, .stl, .glb"
    )
    add_surface(parser)
    add_box(parser)
    parser.add_argument(
        "--viewpoint",
        type=float,
        nargs=3,
        metavar=("X", "Y", "Z"),
        help="colour the mesh by the intensity seen from here: world frame, m",
    )
    parser.add_argument("--picture", type=Path, metavar="PNG", help="also draw the mesh as a picture")
    add_quiet(parser)
    add_json(parser)


def run(options: argparse.Namespace) -> None:
    """Extract the mesh, write it, draw it."""
    from radarsdf.io.files import check_outputs
    from radarsdf.io.meshes import check_mesh_path, write_mesh
    from radarsdf.render.picture import save_picture

    check_mesh_path(options.out)
    check_outputs([options.out, options.picture], [options.map])
    radar_map = load_map(options.map)
    mesh = radar_map.mesh(
        options.voxel,
        box=box_of(options),
        viewpoint=options.viewpoint,
        **limits_of(options),
        progress=progress_of(options),
    )
    if len(mesh.faces) == 0:
        msg = f"{options.map} has no surface here: nothing written"
        raise ValueError(msg)
    origin = write_mesh(options.out, mesh)
    results = Results(options)
    say_mesh(results, mesh, options.out, origin)
    results.add_threshold(mesh.metadata)
    if options.picture:
        save_picture(options.picture, mesh, scalar=mesh.vertex_attributes.get("intensity"))
        results.add(f"picture written to {options.picture}", picture=options.picture)
    results.end()


def say_mesh(results: Results, mesh: trimesh.Trimesh, path: Path, origin: NDArray[np.float64] | None) -> None:
    """Say what was written, and where its origin is, if it has one of its own."""
    from radarsdf.io.files import origin_path

    vertices, triangles = len(mesh.vertices), len(mesh.faces)
    results.add(
        f"{vertices} vertices and {triangles} triangles written to {path}",
        vertices=vertices,
        triangles=triangles,
        out=path,
        origin=origin,
    )
    if origin is not None:
        results.add(f"in a local frame, whose origin is in {origin_path(path)}")
