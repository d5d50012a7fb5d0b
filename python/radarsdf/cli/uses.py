# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""``radarsdf compare`` and ``grid``: changes between two maps, and space for planners."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from radarsdf.cli.options import Address, Box, Recording, corners_of, is_map
from radarsdf.cli.results import Results, load_map, until_stopped

if TYPE_CHECKING:
    from radarsdf.changes.changes import Region

_LISTED = 10  # regions, the largest first


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
    later = load_map(recording.scans) if is_map(recording.scans) else recording.read()
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

    out: A file to write, may be repeated: .npz with all arrays, .bt for OctoMap, .yaml and .pgm for ROS's map_server.
    voxel: Edge length of a voxel, m.
    heights: Range of heights above the ground that the .yaml map covers, m.
    distances: Also write the Euclidean distance field of the grid, as .npz.
    costmap: Also write heights, slopes, steps and costs for wheels, as .npz.
    picture: Also draw heights, costs and free space, as .png.
    """
    from radarsdf.extras import require
    from radarsdf.grids.files import check_suffix
    from radarsdf.grids.grid import save_arrays
    from radarsdf.grids.occupancy import grid as grid_of
    from radarsdf.io.files import check_outputs
    from radarsdf.render.figures import save_grid_picture

    flat = [path for path in out if path.suffix == ".yaml"]
    whole = [path for path in out if path.suffix != ".yaml"]
    for path in whole:
        check_suffix(path, ".npz", ".bt", ".yaml")
    for arrays_path in (distances, costmap):
        if arrays_path is not None:
            check_suffix(arrays_path, ".npz")
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
