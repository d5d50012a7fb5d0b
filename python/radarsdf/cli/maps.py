# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""``radarsdf mesh``, ``eval``, ``render``, ``compare``, ``grid`` and ``info``: what is made of a map."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from typer.core import TyperCommand

from radarsdf.cli.app import command, refuse_if
from radarsdf.cli.options import MAP_SUFFIX, Address, Box, Recording, Surface, corners_of
from radarsdf.cli.results import Results, add_intensity_errors, counted, load_map, split, until_stopped
from radarsdf.cli.scans import add_mesh

if TYPE_CHECKING:
    from collections.abc import Iterable

    import numpy as np
    from numpy.typing import NDArray

    from radarsdf.changes.changes import Region
    from radarsdf.map.map import Map
    from radarsdf.map.view import View

_VIEW_SUFFIXES = (".npz", ".ply", ".png")
_MAX_PICTURES = 20
_LISTED = 10  # regions, the largest first


def _is_map(path: Path) -> bool:
    return path.is_dir() or path.suffix == MAP_SUFFIX


@command()
def info(map_path: Path | None = None, *, results: Results) -> None:
    """Print one row for each part.

    map_path: Also report what is in this map: .safetensors of radarsdf fit, or the folder of radarsdf tiles.
    """
    from radarsdf.versions import versions

    radar_map = None if map_path is None else load_map(map_path)
    rows = list(versions().items())
    results.add(**{name.replace(" ", "_"): value for name, value in rows})
    if radar_map is not None:
        rows += _add_map(results, radar_map)
    results.table(rows)


def _add_map(results: Results, radar_map: Map) -> list[tuple[str, str]]:
    """Add what a map holds, and return it in rows."""
    report, scale, range_m = radar_map.report, radar_map.intensity_scale, radar_map.sensor.range_m
    limits = None if scale is None else (scale.low, scale.high)
    made_of = {name: report[name] for name in ("scans", "returns") if name in report}
    missing = report.get("missing_tiles")
    lower, upper = radar_map.extent
    results.add(
        map=repr(radar_map),
        **made_of,
        extent=[lower, upper],
        bytes=radar_map.file_bytes,
        leaf_cells=radar_map.num_cells,
        leaf_size_m=radar_map.config.leaf_size_m,
        origin=radar_map.origin,
        range_m=range_m,
        intensities=limits,
        rough_share=radar_map.rough_share,
        **({"missing_tiles": missing} if missing else {}),
    )
    edges = " x ".join(f"{edge:.1f}" for edge in upper - lower)
    corners = " to ".join("({:.1f}, {:.1f}, {:.1f})".format(*corner) for corner in (lower, upper))
    return [
        ("map", repr(radar_map)),
        ("made of", ", ".join(f"{count} {name}" for name, count in made_of.items())),
        ("extent", f"{edges} m, from {corners} m"),
        ("size", f"{radar_map.file_bytes / 1e6:.1f} MB"),
        ("leaf cells", f"{radar_map.num_cells} of {radar_map.config.leaf_size_m:g} m"),
        ("origin", "({:.2f}, {:.2f}, {:.2f}) m".format(*radar_map.origin)),
        ("ranges", "{:.1f} to {:.1f} m".format(*range_m)),
        ("intensities", "none" if limits is None else "{:g} to {:g}".format(*limits)),
        ("clutter ratio", f"{radar_map.rough_share:.0%}"),
        *([("missing tiles", ", ".join(missing))] if missing else []),
    ]


@command()
def mesh(
    map_path: Path,
    *,
    out: Path,
    box: Box = None,
    viewpoint: tuple[float, float, float] | None = None,
    picture: Path | None = None,
    surface: Surface,
    quiet: bool = False,
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
        progress=False if quiet else None,
    )
    if len(found.faces) == 0:
        msg = f"{map_path} has no surface here: nothing written"
        raise ValueError(msg)
    origin = write_mesh(out, found)
    add_mesh(results, found, out, origin)
    results.add_threshold(found.metadata)
    if picture is not None:
        save_picture(picture, found, scalar=found.vertex_attributes.get("intensity"))
        results.add(f"picture written to {picture}", picture=picture)


@command()
def _eval(
    what: Path,
    recording: Recording,
    *,
    holdout: int | None = None,
    samples: int = 10_000_000,
    box: Box = None,
    surface: Surface,
    quiet: bool = False,
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

    radar_map = load_map(what) if _is_map(what) else None
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
            found = radar_map.mesh(surface.voxel, **surface.limits, progress=False if quiet else None)
        metrics = evaluation.surface_metrics(found, ground_truth, box=corners_of(box), samples=samples)
        results.add(evaluation.format_metrics(metrics), surface=metrics)
    if radar_map is not None and scans is not None:
        known, held_out = split(scans, holdout)
        if held_out is not None:
            add_intensity_errors(results, radar_map, held_out, known)


def _holds_scans(path: Path) -> bool:
    """Whether the truth is scans, and not a file of points or a surface."""
    from radarsdf.io.bags.reading import is_bag
    from radarsdf.io.npz import holds_scans

    return path.is_dir() or is_bag(path) or (path.suffix.lower() == ".npz" and holds_scans(path))


class _SeveralNumbers(TyperCommand):
    """Takes ``--pose 5 0 1.5`` for ``--pose "5 0 1.5"``: an option of click has a fixed number of words."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        joined: list[str] = []
        words = iter(args)
        in_pose = False
        for word in words:
            if in_pose and _is_number(word):
                joined[-1] += f" {word}"
                continue
            joined.append(word)
            in_pose = word == "--pose"
            if in_pose:
                joined.append(next(words, ""))
        return super().parse_args(ctx, joined)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


@command(cls=_SeveralNumbers)
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

    from radarsdf.io.clouds.writing import write_cloud
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
    if not words or not _is_number(words[0]):
        return _poses_of_file(Path(text))
    usable = len(words) in (3, 7) and all(map(_is_number, words))
    refuse_if(not usable, f"--pose takes x y z, x y z qx qy qz qw, or a file, not {text!r:.60}")
    numbers = [float(word) for word in words]
    pose = np.eye(4)
    pose[:3, 3] = numbers[:3]
    if len(numbers) == 7:
        length = float(np.linalg.norm(numbers[3:]))
        refuse_if(
            not abs(length - 1) < 0.01, f"the quaternion of --pose must have length 1, not {length:.3g}"
        )
        pose[:3, :3] = Rotation.from_quat(numbers[3:]).as_matrix()
    return pose[None]


def _poses_of_file(path: Path) -> NDArray[np.float64]:
    import numpy as np

    from radarsdf.io.poses.files import read_poses
    from radarsdf.io.poses.trajectory import Trajectory
    from radarsdf.io.scans import Notes

    found = read_poses(path, Notes(str(path)))
    if isinstance(found, Trajectory):
        return found.poses(found.times_s, max_gap_s=0.0)
    assert not hasattr(found, "pose_at")  # files have no poses of another kind
    return found[np.isfinite(found).all(axis=(1, 2))]


@command()
def compare(
    map_path: Path,
    recording: Recording,
    *,
    out: Path | None = None,
    report: Path | None = None,
    view: bool = False,
    align: bool = True,
    min_area: float = 0.1,
    box: Box = None,
    address: Address,
    results: Results,
) -> None:
    """Compare, write the surfaces, report what changed.

    scans: The later map, or later scans: .npz of radarsdf, a folder of point clouds, a ROS bag, or the folder of a data set.
    out: The file to write: a mesh in colours, such as changes.ply, or .npz with all arrays.
    report: Also write a page about what changed, such as changes.html.
    view: Show what changed in the browser at the end, until Ctrl-C.
    align: Move the later map as a whole if its surface is then nearer to the earlier one.
    min_area: Smallest region that is listed, m2.
    """
    from radarsdf.changes.compare import compare as compare_maps
    from radarsdf.io.files import check_outputs
    from radarsdf.io.meshes import check_mesh_path
    from radarsdf.report.changes import write_changes_report
    from radarsdf.report.page import require_extras

    if out is not None and out.suffix != ".npz":
        check_mesh_path(out)
    check_outputs([out, report], [map_path, *recording.inputs])
    if report is not None:
        require_extras()
    if view:
        address.check()
    later = load_map(recording.scans) if _is_map(recording.scans) else recording.read()
    earlier = load_map(map_path)
    changes = compare_maps(earlier, later, align_frames=align, box=corners_of(box))
    found = changes.report
    results.add(found["alignment"], alignment=found["alignment"], T_before_after=changes.T_before_after)
    results.add(found["reflectance"], reflectance=found["reflectance"])
    areas = ", ".join(f"{name} {area:.1f}" for name, area in found["areas_m2"].items())
    results.add(
        f"of {found['compared_m2']:.0f} m2 that both observed, m2: {areas}",
        areas_m2=found["areas_m2"],
        compared_m2=found["compared_m2"],
    )
    regions = changes.regions(min_area)
    results.add(regions=[vars(region) for region in regions])
    if regions:
        headings = ("region", "m2", "x, m", "y, m", "z, m", "probability")
        results.table(map(_region_row, regions[:_LISTED]), headings)
    if out is not None:
        changes.save(out)
        results.add(f"{out} written", out=out)
    edge_m = earlier.config.leaf_size_m
    if report is not None:
        names = map_path.absolute().name, recording.scans.absolute().name
        write_changes_report(report, changes, names, edge_m, regions)
        results.add(f"{report} written", report=report)
    if view:
        results.end()
        from radarsdf.view.pages import ChangesView
        from radarsdf.view.serving import url_of

        with ChangesView(changes, regions, edge_m, host=address.host, port=address.port) as page:
            typer.echo(f"what changed is on {url_of(page.host, page.port)}; Ctrl-C ends it")
            until_stopped(page)


def _region_row(region: Region) -> Sequence[str]:
    centre = (f"{x:.1f}" for x in region.box.mean(axis=0))
    return (region.words, f"{region.area_m2:.2f}", *centre, f"{region.probability:.2f}")


@command()
def grid(
    map_path: Path,
    *,
    out: list[Path],
    voxel: float = 0.2,
    box: Box = None,
    heights: tuple[float, float] = (0.3, 2.0),
    distances: Path | None = None,
    costmap: Path | None = None,
    picture: Path | None = None,
    results: Results,
) -> None:
    """Make the grid, write its files, draw it.

    out: A file to write, may be repeated: .npz with all arrays, .ply of the voxels' centres, .bt for OctoMap, .yaml and .pgm
        for ROS's map_server.
    voxel: Edge length of a voxel, m.
    heights: Of the .yaml: what is between these heights above the ground, m.
    distances: Also write the Euclidean distance field of the grid, as .npz.
    costmap: Also write heights, slopes, steps and costs for wheels, as .npz.
    picture: Also draw heights, costs and free space, as .png.
    """
    from radarsdf.extras import require
    from radarsdf.grids.files import check_arrays_path, check_flat_path, check_grid_path
    from radarsdf.grids.grid import save_arrays
    from radarsdf.grids.occupancy import grid as grid_of
    from radarsdf.io.files import check_outputs
    from radarsdf.render.figures import save_grid_picture

    flat = [path for path in out if path.suffix == ".yaml"]
    whole = [path for path in out if path.suffix != ".yaml"]
    for path in whole:
        check_grid_path(path)
    for path in flat:
        check_flat_path(path)
    for arrays_path in (distances, costmap):
        check_arrays_path(arrays_path)
    if picture is not None:
        require("matplotlib", what="pictures need")
    outputs = [*out, *(path.with_suffix(".pgm") for path in flat), distances, costmap, picture]
    check_outputs(outputs, [map_path])
    radar_map = load_map(map_path)
    corners = corners_of(box)
    found = grid_of(radar_map, radar_map.extent if corners is None else corners, voxel)
    low, high = heights
    for path in whole:
        found.save(path)
    for path in flat:
        found.flat(low, high).save(path)
    if distances is not None:
        save_arrays(distances, found, found.distances())
    if costmap is not None:
        save_arrays(costmap, found, found.costmap())
    if picture is not None:
        save_grid_picture(picture, found, low, high)
    shares = {name: float(getattr(found, name).mean()) for name in ("occupied", "free", "unknown")}
    size = " x ".join(map(str, found.shape))
    origin = " ".join(f"{coordinate:.2f}" for coordinate in found.origin)
    results.add(
        f"{size} voxels of {found.voxel_size:g} m from {origin}: "
        + ", ".join(f"{100 * share:.1f} % {name}" for name, share in shares.items()),
        shape=found.shape,
        origin=found.origin,
        voxel_size=found.voxel_size,
        **shares,
    )
    written = [path for path in outputs if path is not None]
    for path in written:
        results.add(f"{path} written")
    results.add(out=written)
