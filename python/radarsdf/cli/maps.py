"""``radarsdf mesh``, ``eval`` and ``render``: outputs of a map, and its errors."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from radarsdf import evaluation
from radarsdf.checks import check
from radarsdf.cli.inputs import is_map, load_map, mesh_limits, scans_if, split
from radarsdf.cli.options import refuse_if
from radarsdf.cli.results import Results
from radarsdf.evaluation import KNNIntensity, format_metrics, intensity_metrics
from radarsdf.io.bag_messages import is_bag
from radarsdf.io.clouds import write_cloud
from radarsdf.io.files import check_outputs, check_regular_file, checked_suffix
from radarsdf.io.meshes import MESH_SUFFIXES, read_ground_truth, read_mesh, write_mesh
from radarsdf.io.npz import arrays_of, write_scans
from radarsdf.io.poses import Trajectory, pose_matrices_of, read_poses
from radarsdf.map.map import Map
from radarsdf.map.threshold import Threshold
from radarsdf.map.view import View, scans_of_views
from radarsdf.render import picture
from radarsdf.render.figures import save_view_picture
from radarsdf.returns.moving import rays_as_measured
from radarsdf.scans import Notes, Scans
from radarsdf.tiles.tiled_map import predicted

_VIEW_SUFFIXES = (".npz", ".ply", ".png")
_MAX_PICTURES = 20


def mesh(given: Namespace, results: Results) -> None:
    """Extract the mesh, write it, and draw a picture if asked for."""
    out, drawing = given.out, given.picture
    checked_suffix(out, MESH_SUFFIXES, "meshes")
    check_outputs([out, drawing], [given.map])
    wanted = mesh_limits(given) | {"box": given.box, "viewpoint": given.viewpoint}
    found = load_map(given.map).mesh(given.voxel, **wanted, progress=results.progress)
    check(len(found.faces), f"{given.map} has no surface here: nothing written")
    write_mesh(out, found)
    results.add_mesh(out, len(found.vertices), len(found.faces), Threshold.of_mesh(found.metadata))
    if drawing is not None:
        picture.save_picture(drawing, found, scalar=found.vertex_attributes.get("intensity"))
        results.add(f"picture written to {drawing}", picture=drawing)


def evaluate(given: Namespace, results: Results) -> None:
    """Print the errors of the surface, the intensities, or both."""
    mesh_file, truth, holdout = given.what, given.scans, given.holdout
    radar_map = load_map(mesh_file) if is_map(mesh_file) else None
    if radar_map is None:
        check_regular_file(mesh_file)
    has_poses = truth.suffix.lower() == ".npz" and arrays_of(truth, ["poses"])
    are_scans = given.poses is not None or truth.is_dir() or is_bag(truth) or has_poses
    scans = scans_if(are_scans, given)
    lacking = holdout is not None and (radar_map is None or scans is None)
    refuse_if(lacking, f"--holdout {holdout} needs a map and scans, not {mesh_file} and {truth}")
    ground_truth = scans.ground_truth if scans is not None else read_ground_truth(truth)
    places = "lidar_points or ground_truth in an .npz file, lidar.pcd or lidar.ply in a folder"
    what = f"{truth} has no lidar points: {places}; --holdout N evaluates intensities"
    check(ground_truth is not None or holdout is not None, what)
    if ground_truth is not None:
        if radar_map is None:
            found = read_mesh(mesh_file)
        else:
            found = radar_map.mesh(given.voxel, **mesh_limits(given), progress=results.progress)
        metrics = evaluation.surface_metrics(found, ground_truth, box=given.box, samples=given.samples)
        results.add(evaluation.format_metrics(metrics), surface=metrics)
    if radar_map is not None and scans is not None:
        known, held_out = split(scans, holdout)
        if held_out is not None:
            add_intensity_errors(results, radar_map, held_out, known)


def add_intensity_errors(results: Results, radar_map: Map, test: Scans, train: Scans) -> None:
    """Add the intensity errors on held-out scans, and those of a kNN baseline fitted to the other scans."""
    if not radar_map.has_intensity or test.intensities is None:
        return
    every_ray, known = (rays_as_measured(scans, radar_map.config) for scans in (test, train))
    tested, known = (rays.select(rays.with_intensity) for rays in (every_ray, known))
    inside, found = predicted(radar_map, tested)
    left_out = len(every_ray) - len(inside)
    line = f"{left_out} of {len(every_ray)} held-out returns are skipped: outliers, or in no tile"
    results.add(line if left_out else None, not_compared=left_out)
    (x, sensors), measured = inside.in_world(), inside.intensities
    assert measured is not None
    assert known.intensities is not None
    errors = intensity_metrics(found, measured)
    results.add("held-out " + format_metrics(errors), held_out=errors)
    knn = KNNIntensity.chosen(*known.in_world(), known.intensities, known.scans)
    metrics = intensity_metrics(knn.predict(x, sensors), measured)
    line = f"kNN      {format_metrics(metrics)}, {knn.k} of {knn.candidates} neighbours"
    results.add(line, knn=metrics | {"neighbours": knn.k, "candidates": knn.candidates})


def render(given: Namespace, results: Results) -> None:
    """Predict scans and write them."""
    out, suffix = given.out, given.out.suffix.lower()
    refuse_if(suffix not in _VIEW_SUFFIXES, f"{out}: a view can be written as {', '.join(_VIEW_SUFFIXES)}")
    refuse_if(given.seed < 0, f"--seed must be at least 0, not {given.seed}")

    poses = np.concatenate([_poses(words) for words in given.pose])
    too_many = suffix == ".png" and len(poses) > _MAX_PICTURES
    refuse_if(too_many, f"a picture holds at most {_MAX_PICTURES} poses, not {len(poses)}: write .npz")
    check_outputs([out], [given.map])
    radar_map = load_map(given.map)
    rng = np.random.default_rng(given.seed)
    options = {"returns": given.returns, "noise": given.noise, "seed": rng}
    views: Iterable[View] = (radar_map.render(pose, **options) for pose in poses)
    if suffix == ".png":
        views = list(views)  # a picture shows the whole view; other formats need only the returns
    scans = scans_of_views(view for view in views if len(view))
    check(len(scans), f"{given.map} has no surface visible from there: nothing written")
    if suffix == ".npz":
        write_scans(out, scans)
    elif suffix == ".ply":
        write_cloud(out, scans)
    else:
        save_view_picture(out, list(views))
    count = sum(map(len, scans.points))
    results.add_file(f"{count} returns of {len(scans)} scans", out, returns=count, scans=len(scans))


def _poses(words: list[str]) -> NDArray[np.float64]:
    """T_world_sensor (F, 4, 4) from one ``--pose``: numbers, or the name of a file."""
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        path = Path(" ".join(words))
        got: Any = read_poses(path, Notes(str(path)))
        poses = got.poses(got.times_s) if isinstance(got, Trajectory) else getattr(got, "matrices", got)
        return np.asarray(poses[np.isfinite(poses).all(axis=(1, 2))])
    refuse_if(len(numbers) not in (3, 7), "--pose takes x y z, x y z qx qy qz qw, or a file")
    return pose_matrices_of(np.array([numbers if len(numbers) == 7 else [*numbers, 0, 0, 0, 1]]))
