"""``radarsdf compare`` and ``grid``: changes between two maps, and occupancy for planners."""

from __future__ import annotations

from argparse import Namespace

from radarsdf.changes.compare import compare as compare_maps
from radarsdf.cli.inputs import check_address, inputs_of, is_map, load_map, scans_if
from radarsdf.cli.results import Results, until_stopped
from radarsdf.extras import require
from radarsdf.grids.grid import save_arrays
from radarsdf.grids.occupancy import grid as grid_of
from radarsdf.io.files import check_outputs, checked_suffix
from radarsdf.io.meshes import MESH_SUFFIXES
from radarsdf.render.figures import save_grid_picture
from radarsdf.report.writing import require_extras, write_changes_report
from radarsdf.view.pages import ChangesView
from radarsdf.view.serving import url_of, wait

_LISTED = 10  # regions, largest first


def compare(given: Namespace, results: Results) -> None:
    """Compare two maps, write coloured surfaces, report changes."""
    out, report = given.out, given.report
    if out is not None:
        checked_suffix(out, MESH_SUFFIXES, "meshes")
    check_outputs([out, report], inputs_of(given))
    if report is not None:
        require_extras()
    if given.view:
        check_address(given)
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
        results.add(f"{out} written", out=out)
    if report is not None:
        names = given.map.absolute().name, given.scans.absolute().name
        write_changes_report(report, changes, names, edge_m, regions)
        results.add(f"{report} written", report=report)
    if given.view:
        results.end()
        with ChangesView(changes, regions, edge_m, host=given.host, port=given.port) as page:
            print(f"changes on {url_of(page.host, page.port)}; Ctrl-C ends it", flush=True)
            until_stopped(wait)


def grid(given: Namespace, results: Results) -> None:
    """Build the grid, write its files, and draw a picture if asked for."""
    out, heights = given.out, given.heights
    flat = [path for path in out if path.suffix.lower() == ".yaml"]
    for path in out:
        checked_suffix(path, (".npz", ".bt", ".yaml"), "grids")
    for arrays_path in filter(None, (given.distances, given.costmap)):
        checked_suffix(arrays_path, (".npz",), "arrays of a grid")
    if given.picture is not None:
        require("matplotlib", what="pictures need")
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
    results.add(f"wrote {', '.join(map(str, outputs))}", out=outputs)
