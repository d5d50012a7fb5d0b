"""Table of commands: module, arguments, and one line of help."""

from __future__ import annotations

COMMANDS = {
    "Start here": {
        "demo": ("fits", "", "Simulate a drive, fit a map to it, and compare the map with the truth."),
        "check": ("scans", "SCANS [POSES]", "Find mistakes in scans and poses before a fit."),
        "fit": ("fits", "SCANS [POSES] -o MAP", "Fit a map to scans."),
        "mesh": ("maps", "MAP -o MESH", "Extract the surface of a map as a triangle mesh."),
    },
    "Poses, recordings and large maps": {
        "poses": ("scans", "SCANS [POSES] -o POSES", "Refine the poses of scans, or estimate them from the radar alone."),
        "live": ("live", "SCANS [POSES]", "Replay a recording into a growing map, and report whether it keeps up."),
        "tiles": ("tiles", "SCANS [POSES] -o FOLDER", "Fit a map larger than memory in tiles, locally or on a cluster."),
    },
    "Uses of a map": {
        "view": ("pages", "MAP [SCANS [POSES]]", "Show a map in the browser, with a draggable sensor."),
        "report": ("pages", "MAP [SCANS [POSES]] -o PAGE", "Write a page about a map: pictures, errors, plots, settings."),
        "eval": ("maps", "MAP|MESH TRUTH [POSES]", "Print the errors of a mesh or a map."),
        "render": ("maps", "MAP --pose X Y Z -o VIEW", "Predict the scan that the radar would get from other poses."),
        "compare": ("uses", "MAP LATER [POSES]", "Report what appeared, disappeared, moved or changed its reflectance."),
        "grid": ("uses", "MAP -o GRID", "Write occupied, free and unknown space for planners: OctoMap, map_server, costmap."),
    },
    "Files and settings": {
        "convert": ("scans", "SCANS [POSES] -o FILE", "Write scans as one file or one point cloud, or a mesh in another format."),
        "config": ("settings", "", "Print every setting of a fit with its meaning, as a TOML file for --config."),
        "info": ("info", "[MAP]", "Print versions and threads for bug reports, and the contents of a map."),
    },
}  # fmt: skip
"""Module, arguments and help of each command, by heading of the overview."""

TILE_STEPS = {
    "run": (
        "tiles",
        "SCANS [POSES] -o FOLDER",
        "Plan, fit and mesh in one go; run is the default step.",
    ),
    "plan": ("tiles", "SCANS [POSES] -o FOLDER", "Read the scans once, and write the rays of each tile."),
    "fit": ("tiles", "FOLDER", "Fit the tiles of a plan; finished ones are kept."),
    "mesh": ("tiles", "FOLDER", "Write the surface of all tiles as one mesh."),
    "status": ("tiles", "FOLDER", "List unfinished tiles with the reasons; exit status 1 if there are any."),
}
"""Module, arguments and help of each step of ``radarsdf tiles``."""


def overview() -> str:
    """Format the help of ``radarsdf`` without a command."""
    lines = [
        "Usage: radarsdf COMMAND [OPTIONS]...",
        "",
        "From 3D radar scans to a surface and a reflectance map, on a CPU.",
    ]
    for heading, commands in COMMANDS.items():
        lines += ["", f"{heading}:", *(f"  {name:<9}{text}" for name, (_, _, text) in commands.items())]
    lines += [
        "",
        "radarsdf COMMAND --help lists the options of a command, radarsdf --version prints the version.",
    ]
    return "\n".join(lines)


def steps() -> str:
    """Format the help of ``radarsdf tiles``."""
    rows = [f"  {step:<9}{text}" for step, (_, _, text) in TILE_STEPS.items()]
    return "\n".join(
        [
            "Usage: radarsdf tiles [STEP] [OPTIONS]...",
            "",
            *rows,
            "",
            "radarsdf tiles STEP --help lists the options of a step.",
        ]
    )
