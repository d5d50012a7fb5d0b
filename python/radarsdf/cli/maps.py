"""Commands that use a map: ``mesh``, ``eval``, ``render``, ``view``, ``report``, ``compare`` and ``grid``."""

import webbrowser
from argparse import Namespace
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

import radarsdf
from radarsdf.arrays import Floats, NDArray
from radarsdf.changes.changes import compare as compare_maps
from radarsdf.checks import check
from radarsdf.cli import Results
from radarsdf.cli.inputs import check_picture, inputs_of, is_map, load_map, mesh_limits, scans_if, split
from radarsdf.cli.options import refuse_if
from radarsdf.cli.scans import add_scans, located, unposed_scans
from radarsdf.evaluation import KNNIntensity, format_metrics, intensity_metrics, surface_metrics
from radarsdf.grids.grid import DISTANCE_SUFFIXES, save_arrays
from radarsdf.grids.occupancy import grid as grid_of
from radarsdf.io.bag_messages import is_bag
from radarsdf.io.files import check_outputs, check_regular_file, checked_suffix
from radarsdf.io.meshes import MESH_SUFFIXES, read_ground_truth, read_mesh, write_mesh
from radarsdf.io.npz import arrays_of
from radarsdf.io.poses import Trajectory, pose_matrices_of, read_poses
from radarsdf.map.map import Map
from radarsdf.map.threshold import Threshold
from radarsdf.map.view import View
from radarsdf.render import picture
from radarsdf.render.figures import save_grid_picture, save_view_picture
from radarsdf.report.writing import Subject, require_extras, write_changes_report, write_report
from radarsdf.returns.moving import rays_as_measured
from radarsdf.scans import Notes, Scans, scans_in_memory
from radarsdf.tiles.tiled_map import predicted
from radarsdf.view.pages import ChangesView, Viewer
from radarsdf.view.serving import has_display, page_port, wait

_VIEW_SUFFIXES = (".npz", ".ply", ".png")
_MAX_PICTURES = 20
_LISTED = 10  # regions, largest first


def mesh(given: Namespace, results: Results) -> None:
    out, drawing = given.out, given.picture
    checked_suffix(out, MESH_SUFFIXES, "meshes")
    check_outputs([out, drawing], [given.map])
    check_picture(drawing)
    wanted = mesh_limits(given) | {"box": given.box, "viewpoint": given.viewpoint}
    found = load_map(given.map).mesh(given.voxel, **wanted, progress=results.progress)
    check(len(found.faces), f"{given.map} has no surface here: nothing written")
    write_mesh(out, found)
    results.add_mesh(out, len(found.vertices), len(found.faces), Threshold.of_mesh(found.metadata))
    if drawing is not None:
        picture.save_picture(drawing, found, scalar=found.vertex_attributes.get("intensity"))
        results.add_file("picture", drawing, "picture")


def evaluate(given: Namespace, results: Results) -> None:
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
        metrics = surface_metrics(found, ground_truth, box=given.box, samples=given.samples)
        results.add(format_metrics(metrics), surface=metrics)
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
    (x, sensors), measured = inside.in_world(), np.asarray(inside.intensities)
    errors = intensity_metrics(found, measured)
    results.add("held-out " + format_metrics(errors), held_out=errors)
    knn = KNNIntensity.chosen(*known.in_world(), np.asarray(known.intensities), known.scans)
    metrics = intensity_metrics(knn.predict(x, sensors), measured)
    line = f"kNN      {format_metrics(metrics)}, {knn.k} of {knn.candidates} neighbours"
    results.add(line, knn=metrics | {"neighbours": knn.k, "candidates": knn.candidates})


def render(given: Namespace, results: Results) -> None:
    out, suffix = given.out, given.out.suffix.lower()
    refuse_if(suffix not in _VIEW_SUFFIXES, f"{out}: a view can be written as {', '.join(_VIEW_SUFFIXES)}")
    refuse_if(given.seed < 0, f"--seed must be at least 0, not {given.seed}")

    poses = np.concatenate([_poses(words) for words in given.pose])
    too_many = suffix == ".png" and len(poses) > _MAX_PICTURES
    refuse_if(too_many, f"a picture holds at most {_MAX_PICTURES} poses, not {len(poses)}: write .npz")
    check_outputs([out], [given.map])
    radar_map = load_map(given.map)
    options = {"returns": given.returns, "noise": given.noise, "seed": np.random.default_rng(given.seed)}
    views: Iterable[View] = (radar_map.render(pose, **options) for pose in poses)
    if suffix == ".png":
        views = list(views)  # a picture shows the whole view; other formats need only the returns
    seen = [view.scan for view in views if len(view)]
    check(seen, f"{given.map} has no surface visible from there: nothing written")
    if suffix == ".png":
        save_view_picture(out, list(views))
    add_scans(results, out, scans_in_memory(seen))


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


def view(given: Namespace, results: Results) -> None:
    page_port(given.host, given.port)
    radar_map = load_map(given.map)
    scans, explained = _scans(given, radar_map, results)
    options = {"box": given.box, "progress": results.progress, "explained": explained}
    page = {"voxel_size": given.voxel, "host": given.host, "port": given.port}
    with Viewer(radar_map, scans, **page, **options, **mesh_limits(given)) as viewer, results.until_stopped():
        results.say(f"{len(viewer.surface.vertices)} vertices on {viewer.url}; Ctrl-C ends it")
        if has_display() if given.open is None else given.open:
            webbrowser.open(viewer.url)
        viewer.wait()


def report(given: Namespace, results: Results) -> None:
    lacking = given.holdout and not given.scans
    refuse_if(lacking, f"--holdout {given.holdout} needs the scans: name them after the map")

    require_extras()
    check_outputs([given.out], inputs_of(given))
    radar_map = load_map(given.map)
    scans = findings = held_out = None
    every_scan, explained = _scans(given, radar_map, results)
    if every_scan is not None:
        findings = radarsdf.check(every_scan, config=radar_map.config)
        scans, held_out = split(every_scan, given.holdout)
    options = {"voxel_size_m": given.voxel, "box": given.box, "limits": mesh_limits(given)}
    options["explained"] = None if given.holdout else explained
    name = given.map.absolute().name
    subject = Subject(radar_map, name, scans, held_out, findings, progress=results.progress, **options)
    add_report(results, given.out, subject)


def _scans(given: Namespace, radar_map: Map, results: Results) -> tuple[Scans | None, Floats | None]:
    if not given.locate:
        return scans_if(given.scans, given), None
    refuse_if(not given.scans, "--locate needs the scans: name them after the map")
    return located(radar_map, unposed_scans(given), results)


def add_report(results: Results, path: Path, subject: Subject) -> None:
    size = write_report(path, subject)
    results.add_file(f"report of {size / 1e6:.1f} MB", path, "report", report_bytes=size)


def compare(given: Namespace, results: Results) -> None:
    out, report = given.out, given.report
    checked_suffix(out, MESH_SUFFIXES, "meshes")
    check_outputs([out, report], inputs_of(given))
    if report is not None:
        require_extras()
    if given.view:
        page_port(given.host, given.port)
    scans = scans_if(not is_map(given.scans), given)
    later = load_map(given.scans) if scans is None else scans
    earlier = load_map(given.map)
    changes = compare_maps(earlier, later, align_frames=given.align, box=given.box)
    found = changes.report
    results.add(found["alignment"], alignment=found["alignment"], T_before_after=changes.T_before_after)
    results.add(found["reflectance"], reflectance=found["reflectance"])
    areas = ", ".join(f"{name} {area:.1f}" for name, area in found["areas_m2"].items())
    areas_m2 = {name: found[name] for name in ("areas_m2", "compared_m2")}
    results.add(f"of {found['compared_m2']:.0f} m2 that both observed, m2: {areas}", **areas_m2)
    regions = changes.regions(given.min_area)
    results.add(regions=[vars(region) for region in regions])
    rows = [["region", "m2", "x, m", "y, m", "z, m", "probability"]]
    for region in regions[:_LISTED]:
        numbers = (region.area_m2, *region.box.mean(axis=0), region.probability)
        rows.append([region.words, *(f"{number:.2f}" for number in numbers)])
    if regions:
        results.table(rows)
    edge_m = earlier.config.leaf_size_m
    if out is not None:
        changes.save(out)
        results.add_file("changes", out)
    if report is not None:
        names = given.map.absolute().name, given.scans.absolute().name
        write_changes_report(report, changes, names, edge_m, regions)
        results.add_file("report", report, "report")
    if given.view:
        page = ChangesView(changes, regions, edge_m, host=given.host, port=given.port)
        with page, results.until_stopped():
            results.say(f"changes on {page.url}; Ctrl-C ends it")
            wait()


def grid(given: Namespace, results: Results) -> None:
    out, heights = given.out, given.heights
    flat = [path for path in out if path.suffix.lower() == ".yaml"]
    for path in out:
        checked_suffix(path, (".npz", ".bt", ".yaml"), "grids")
    checked_suffix(given.distances, DISTANCE_SUFFIXES, "arrays of a grid")
    checked_suffix(given.costmap, (".npz",), "arrays of a grid")
    check_picture(given.picture)
    pgm = [path.with_suffix(".pgm") for path in flat]
    named = (*out, *pgm, given.distances, given.costmap, given.picture)
    outputs = [path for path in named if path is not None]
    check_outputs(outputs, [given.map])
    radar_map = load_map(given.map)
    found = grid_of(radar_map, radar_map.extent if given.box is None else given.box, given.voxel)
    for path in out:
        (found.flat(*heights) if path in flat else found).save(path)
    if given.distances is not None:
        save_arrays(given.distances, found, found.distances())
    if given.costmap is not None:
        save_arrays(given.costmap, found, found.costmap())
    if given.picture is not None:
        save_grid_picture(given.picture, found, *heights)
    shares = {name: float(getattr(found, name).mean()) for name in ("occupied", "free", "unknown")}
    size = " x ".join(map(str, found.shape))
    origin = " ".join(f"{coordinate:.2f}" for coordinate in found.origin)
    words = ", ".join(f"{100 * share:.1f} % {name}" for name, share in shares.items())
    values = {"shape": found.shape, "origin": found.origin, "voxel_size": found.voxel_size}
    results.add(f"{size} voxels of {found.voxel_size:g} m from {origin}: {words}", **values, **shares)
    results.add(f"grid written to {', '.join(map(str, outputs))}", out=outputs)
