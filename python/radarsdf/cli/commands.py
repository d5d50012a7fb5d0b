"""Table of commands: arguments, and one line of help."""

from __future__ import annotations

COMMANDS = {
    "Start here": {
        "demo": ("", "Simulate a drive, fit a map to it, and compare the map with the truth."),
        "check": ("SCANS [POSES]", "Find mistakes in scans and poses before a fit."),
        "fit": ("SCANS [POSES] -o MAP", "Fit a map to scans."),
        "mesh": ("MAP -o MESH", "Extract the surface of a map as a triangle mesh."),
    },
    "Poses, recordings and large maps": {
        "poses": ("SCANS [POSES] -o POSES", "Refine the poses of scans, or estimate them from the radar alone."),
        "calibrate": ("SCANS [POSES] [-o MOUNTINGS]", "Estimate how several radars are mounted, and their time offsets."),
        "live": ("SCANS [POSES]", "Replay a recording into a growing map, and report whether it keeps up."),
        "tiles": ("SCANS [POSES] -o FOLDER", "Fit a map larger than memory in tiles, locally or on a cluster."),
    },
    "Uses of a map": {
        "view": ("MAP [SCANS [POSES]]", "Show a map in the browser, with a draggable sensor."),
        "report": ("MAP [SCANS [POSES]] -o PAGE", "Write a page about a map: pictures, errors, plots, settings."),
        "eval": ("MAP|MESH TRUTH [POSES]", "Print the errors of a mesh or a map."),
        "render": ("MAP --pose X Y Z -o VIEW", "Predict the scan that the radar would get from other poses."),
        "compare": ("MAP LATER [POSES]", "Report what appeared, disappeared, moved or changed its reflectance."),
        "grid": ("MAP -o GRID", "Write occupied, free and unknown space for planners: OctoMap, map_server, costmap."),
    },
    "Files and settings": {
        "convert": ("SCANS [POSES] -o FILE", "Write scans as one file or one point cloud, or a mesh in another format."),
        "config": ("", "Print every setting of a fit with its meaning, as a TOML file for --config."),
        "info": ("[MAP]", "Print versions and threads for bug reports, and the contents of a map."),
    },
}  # fmt: skip
"""Arguments and help of each command, by heading of the overview."""

TILE_STEPS = {
    "run": ("SCANS [POSES] -o FOLDER", "Plan, fit and mesh in one go; run is the default step."),
    "plan": ("SCANS [POSES] -o FOLDER", "Read the scans once, and write the rays of each tile."),
    "fit": ("FOLDER", "Fit the tiles of a plan; finished ones are kept."),
    "mesh": ("FOLDER", "Write the surface of all tiles as one mesh."),
    "status": ("FOLDER", "List unfinished tiles with the reasons; exit status 1 if there are any."),
}
"""Arguments and help of each step of ``radarsdf tiles``."""


def overview() -> str:
    """Format the help of ``radarsdf`` without a command."""
    lists = "\n\n".join(f"{heading}:\n{_rows(commands)}" for heading, commands in COMMANDS.items())
    return f"""\
Usage: radarsdf COMMAND [OPTIONS]...

From 3D radar scans to a surface and a reflectance map, on a CPU.

{lists}

radarsdf COMMAND --help lists the options of a command; radarsdf --version prints the version."""


def steps() -> str:
    return f"""\
Usage: radarsdf tiles [STEP] [OPTIONS]...

{_rows(TILE_STEPS)}

radarsdf tiles STEP --help lists the options of a step."""


def _rows(commands: dict[str, tuple[str, str]]) -> str:
    return "\n".join(f"  {name:<11}{text}" for name, (_, text) in commands.items())
