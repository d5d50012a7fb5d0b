# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""``radarsdf eval``: the errors of a surface against lidar points, and of intensities against held-out scans."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from radarsdf.cli.options import add_box, box_of
from radarsdf.cli.saying import say

if TYPE_CHECKING:
    import numpy as np
    import trimesh
    from numpy.typing import NDArray


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.add_argument("what", type=Path, help="a mesh, or a map (.safetensors)")
    parser.add_argument("truth", type=Path, help="lidar points (.ply, .npy, .xyz, .csv), or scans (.npz)")
    parser.add_argument(
        "--holdout",
        type=int,
        metavar="N",
        help="also print the intensity errors on the scans that radarsdf fit --holdout N left out",
    )
    add_box(parser)
    parser.add_argument(
        "--samples",
        type=int,
        default=10_000_000,
        help="number of points sampled on the mesh; default: 10000000",
    )


def run(options: argparse.Namespace) -> None:
    """Print the errors of the surface, the intensities, or both."""
    import radarsdf
    from radarsdf.cli.held_out import print_intensity_errors
    from radarsdf.evaluation import format_metrics, holdout, surface_metrics
    from radarsdf.io.scans import read_scans

    radar_map = radarsdf.load(options.what) if options.what.suffix == ".safetensors" else None
    if options.holdout is not None and (radar_map is None or options.truth.suffix != ".npz"):
        msg = "--holdout needs a map and scans"
        raise ValueError(msg)
    scans = read_scans(options.truth) if options.truth.suffix == ".npz" else None
    ground_truth = scans.ground_truth if scans else read_points(options.truth)
    if ground_truth is None and options.holdout is None:
        msg = f"{options.truth} has no lidar_points; --holdout N evaluates intensities"
        raise ValueError(msg)
    if ground_truth is not None:
        mesh = radar_map.mesh() if radar_map else read_mesh(options.what)
        metrics = surface_metrics(mesh, ground_truth, box=box_of(options), samples=options.samples)
        say(format_metrics(metrics))
    if options.holdout is not None and radar_map is not None and scans is not None:
        train, test = holdout(len(scans.points), options.holdout)
        print_intensity_errors(radar_map, scans.select(test), scans.select(train))


def read_points(path: Path) -> NDArray[np.float64]:
    """Read a point cloud, or the vertices of a mesh.

    Parameters
    ----------
    path
        ``.npy``; ``.xyz``, ``.txt`` or ``.csv``, whose first three columns count; or a format of trimesh.

    Returns
    -------
    (N, 3) float64
        The points. The shape of an array in a ``.npy`` file is not checked.

    Raises
    ------
    ValueError
        If the file is damaged, or has several geometries.
    OSError
        If the file cannot be opened.
    """
    import numpy as np

    from radarsdf.checks import real_array
    from radarsdf.interrupts import whole_import

    with _refusing_damage(path):
        if path.suffix == ".npy":
            return real_array(np.load(path, allow_pickle=False), "points")
        if path.suffix in (".xyz", ".txt", ".csv"):
            delimiter = "," if path.suffix == ".csv" else None
            return np.loadtxt(path, delimiter=delimiter, ndmin=2)[:, :3]
    with whole_import():
        import trimesh
    with _refusing_damage(path):
        vertices = getattr(trimesh.load(path, process=False), "vertices", None)
    if vertices is None:  # a scene of several geometries
        msg = f"{path} is not one cloud or mesh"
        raise ValueError(msg)
    return real_array(vertices, "vertices")


def read_mesh(path: Path) -> trimesh.Trimesh:
    """Read a triangle mesh.

    Parameters
    ----------
    path
        A file of a format that trimesh reads.

    Returns
    -------
    trimesh.Trimesh
        The mesh with all its vertices: none are merged.

    Raises
    ------
    ValueError
        If the file is damaged, or is not one mesh.
    OSError
        If the file cannot be opened.
    """
    import numpy as np

    from radarsdf.interrupts import whole_import

    with whole_import():
        import trimesh
    with _refusing_damage(path):
        mesh = trimesh.load_mesh(path, process=False)
    if isinstance(mesh, trimesh.Trimesh) and np.ndim(mesh.faces) == 2:
        return mesh
    msg = f"{path} is not one mesh"
    raise ValueError(msg)


@contextmanager
def _refusing_damage(path: Path) -> Iterator[None]:
    """Turn any error of another library into a ValueError that names the file. An OSError names it already."""
    try:
        yield
    except OSError:
        raise
    except Exception as error:
        msg = f"{path} cannot be read: {error}"
        raise ValueError(msg) from error
