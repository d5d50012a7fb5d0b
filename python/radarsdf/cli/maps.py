# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""``radarsdf info``, ``mesh``, ``eval`` and ``render``: what a map holds, and how good it is."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from radarsdf.cli.app import is_number, refuse_if
from radarsdf.cli.options import Box, Recording, Surface, corners_of, is_map
from radarsdf.cli.results import Results, add_intensity_errors, counted, load_map, split

if TYPE_CHECKING:
    from collections.abc import Iterable

    import numpy as np
    from numpy.typing import NDArray

    from radarsdf.map.map import Map
    from radarsdf.map.view import View

_VIEW_SUFFIXES = (".npz", ".ply", ".png")
_MAX_PICTURES = 20


def info(map_path: Path | None = None, *, results: Results) -> None:
    """Print one row for each part.

    map_path: Also report what is in this map: .safetensors of radarsdf fit, or the folder of radarsdf tiles.
    """
    from radarsdf.versions import versions

    radar_map = None if map_path is None else load_map(map_path)
    rows = versions()
    results.add(**{name.replace(" ", "_"): value for name, value in rows.items()})
    if radar_map is not None:
        rows |= _add_map(results, radar_map)
    results.table(rows.items())


def _add_map(results: Results, radar_map: Map) -> dict[str, str]:
    """Add what a map holds, and return it in words."""
    report, scale, range_m = radar_map.report, radar_map.intensity_scale, radar_map.sensor.range_m
    made_of = {name: report[name] for name in ("scans", "returns") if name in report}
    missing = {name: report[name] for name in ("missing_tiles",) if report.get(name)}
    lower, upper = radar_map.extent
    values: dict[str, Any] = {
        "map": repr(radar_map),
        "extent": [lower, upper],
        "bytes": radar_map.file_bytes,
        "leaf_cells": radar_map.num_cells,
        "leaf_size_m": radar_map.config.leaf_size_m,
        "origin": radar_map.origin,
        "range_m": range_m,
        "intensities": None if scale is None else (scale.low, scale.high),
        "rough_share": radar_map.rough_share,
    }
    results.add(**values, **made_of, **missing)
    edges = " x ".join(f"{edge:.1f}" for edge in upper - lower)
    corners = " to ".join("({:.1f}, {:.1f}, {:.1f})".format(*corner) for corner in (lower, upper))
    return {
        "map": repr(radar_map),
        "made of": ", ".join(f"{count} {name}" for name, count in made_of.items()),
        "extent": f"{edges} m, from {corners} m",
        "size": f"{radar_map.file_bytes / 1e6:.1f} MB",
        "leaf cells": f"{radar_map.num_cells} of {radar_map.config.leaf_size_m:g} m",
        "origin": "({:.2f}, {:.2f}, {:.2f}) m".format(*radar_map.origin),
        "ranges": "{:.1f} to {:.1f} m".format(*range_m),
        "intensities": "none" if scale is None else f"{scale.low:g} to {scale.high:g}",
        "clutter ratio": f"{radar_map.rough_share:.0%}",
        **{name.replace("_", " "): ", ".join(tiles) for name, tiles in missing.items()},
    }


def mesh(
    map_path: Path,
    *,
    out: Path,
    box: Box = None,
    viewpoint: tuple[float, float, float] | None = None,
    picture: Path | None = None,
    surface: Surface,
    results: Results,
) -> None:
    """Extract the mesh, write it, draw it.

    out: The mesh to write: .ply, .obj, .stl, .glb.
    viewpoint: Colour the mesh by the intensity seen from here: x y z, world frame, m.
    picture: Also draw the mesh, as .png.
    """
    from radarsdf.io.files import check_outputs
    from radarsdf.io.meshes import check_mesh_path, write_mesh
    from radarsdf.render.picture import save_picture

    check_mesh_path(out)
    check_outputs([out, picture], [map_path])
    found = load_map(map_path).mesh(
        surface.voxel,
        box=corners_of(box),
        viewpoint=viewpoint,
        **surface.limits,
        progress=results.progress,
    )
    if len(found.faces) == 0:
        msg = f"{map_path} has no surface here: nothing written"
        raise ValueError(msg)
    origin = write_mesh(out, found)
    results.add_mesh(found, out, origin)
    results.add_threshold(found.metadata)
    if picture is not None:
        save_picture(picture, found, scalar=found.vertex_attributes.get("intensity"))
        results.add(f"picture written to {picture}", picture=picture)


def evaluate(
    what: Path,
    recording: Recording,
    *,
    holdout: int | None = None,
    samples: int = 10_000_000,
    box: Box = None,
    surface: Surface,
    results: Results,
) -> None:
    """Print the errors of the surface, the intensities, or both.

    what: A mesh, or a map: .safetensors of radarsdf fit, or the folder of radarsdf tiles.
    scans: The truth: lidar points (.ply, .pcd, .las, .laz, .npy, .npz, .csv, .xyz, .txt, .bin), a surface (.ply, .obj, .off,
        .stl, .glb), or scans with lidar points: .npz of radarsdf, a folder of point clouds, a ROS bag, a data set.
    samples: Number of points sampled on the mesh.
    """
    from radarsdf import evaluation
    from radarsdf.io.files import check_regular_file
    from radarsdf.io.meshes import read_ground_truth, read_mesh

    radar_map = load_map(what) if is_map(what) else None
    if radar_map is None:
        check_regular_file(what)
    truth = recording.scans
    scans = recording.read() if recording.poses is not None or _holds_scans(truth) else None
    lacking = holdout is not None and (radar_map is None or scans is None)
    refuse_if(lacking, f"--holdout {holdout} needs a map and scans, not {what} and {truth}")
    ground_truth = scans.ground_truth if scans is not None else read_ground_truth(truth)
    if ground_truth is None and holdout is None:
        msg = (
            f"{truth} has no lidar points: lidar_points in an .npz file, lidar.pcd or lidar.ply in a folder; "
            "--holdout N evaluates intensities"
        )
        raise ValueError(msg)
    if ground_truth is not None:
        if radar_map is None:
            found = read_mesh(what)
        else:
            found = radar_map.mesh(surface.voxel, **surface.limits, progress=results.progress)
        metrics = evaluation.surface_metrics(found, ground_truth, box=corners_of(box), samples=samples)
        results.add(evaluation.format_metrics(metrics), surface=metrics)
    if radar_map is not None and scans is not None:
        known, held_out = split(scans, holdout)
        if held_out is not None:
            add_intensity_errors(results, radar_map, held_out, known)


def _holds_scans(path: Path) -> bool:
    """Whether the truth is scans, and not a file of points or a surface."""
    from radarsdf.io.bag_messages import is_bag
    from radarsdf.io.npz import holds_scans

    return path.is_dir() or is_bag(path) or (path.suffix.lower() == ".npz" and holds_scans(path))


def render(
    map_path: Path,
    *,
    pose: list[str],
    out: Path,
    returns: float | None = None,
    noise: bool = False,
    seed: int = 0,
    results: Results,
) -> None:
    """Predict the scans, and write them.

    pose: Where the sensor is, world frame: x y z, m, or x y z qx qy qz qw, or a file of poses as for radarsdf fit; may be
        repeated.
    out: What to write: .npz, scans as radarsdf fit takes them; .ply, points in the world frame; .png, a picture.
    returns: Number of returns in a scan; default: what the sensor of the map gives.
    noise: Add the noise of the sensor.
    seed: Seed of the noise.
    """
    import numpy as np

    from radarsdf.io.cloud_writing import write_cloud
    from radarsdf.io.files import check_outputs
    from radarsdf.io.npz import write_scans
    from radarsdf.map.view import scans_of_views
    from radarsdf.memory import check_views
    from radarsdf.render.figures import save_view_picture

    suffix = out.suffix.lower()
    refuse_if(suffix not in _VIEW_SUFFIXES, f"{out}: a view can be written as {', '.join(_VIEW_SUFFIXES)}")
    refuse_if(seed < 0, f"--seed must be at least 0, not {seed}")
    poses = np.concatenate([_poses(text) for text in pose])
    too_many = suffix == ".png" and len(poses) > _MAX_PICTURES
    refuse_if(too_many, f"a picture holds at most {_MAX_PICTURES} poses, not {len(poses)}: write .npz")
    check_outputs([out], [map_path])
    radar_map = load_map(map_path)
    rng = np.random.default_rng(seed)
    wanted = radar_map.sensor.returns_per_scan if returns is None else returns
    # There are about as many patches as cells, and each has one return at most.
    check_views(None, returns=len(poses) * min(wanted, radar_map.num_cells))
    views: Iterable[View] = (radar_map.render(T, returns=returns, noise=noise, seed=rng) for T in poses)
    if suffix == ".png":
        views = list(views)  # a picture shows all of a view; of others, the returns are kept alone
    scans = scans_of_views(view for view in views if len(view))
    if not len(scans):
        msg = f"{map_path} has no surface that the sensor sees from {counted(len(poses), 'pose')}: nothing written"
        raise ValueError(msg)
    if suffix == ".npz":
        write_scans(out, scans)
    elif suffix == ".ply":
        write_cloud(out, scans)
    else:
        save_view_picture(out, list(views))
    empty = f", {len(poses) - len(scans)} of them without any" if len(scans) < len(poses) else ""
    count = sum(map(len, scans.points))
    results.add(
        f"{count} returns of {counted(len(poses), 'scan')} written to {out}{empty}",
        returns=count,
        scans=len(poses),
        scans_without_returns=len(poses) - len(scans),
        out=out,
    )


def _poses(text: str) -> NDArray[np.float64]:
    """T_world_sensor (F, 4, 4) of one ``--pose``: numbers, or the name of a file."""
    import numpy as np
    from scipy.spatial.transform import Rotation

    words = text.split()
    if not words or not is_number(words[0]):
        return _poses_of_file(Path(text))
    usable = len(words) in (3, 7) and all(map(is_number, words))
    refuse_if(not usable, f"--pose takes x y z, x y z qx qy qz qw, or a file, not {text!r:.60}")
    numbers = [float(word) for word in words]
    quaternion = numbers[3:] or [0.0, 0.0, 0.0, 1.0]
    length = float(np.linalg.norm(quaternion))
    refuse_if(not abs(length - 1) < 0.01, f"the quaternion of --pose must have length 1, not {length:.3g}")
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(quaternion).as_matrix()
    pose[:3, 3] = numbers[:3]
    return pose[None]


def _poses_of_file(path: Path) -> NDArray[np.float64]:
    import numpy as np

    from radarsdf.io.poses import Trajectory, read_poses
    from radarsdf.io.scans import Notes

    found = read_poses(path, Notes(str(path)))
    if isinstance(found, Trajectory):
        return found.poses(found.times_s)
    assert isinstance(found, np.ndarray)  # files have no poses of another kind
    return found[np.isfinite(found).all(axis=(1, 2))]
