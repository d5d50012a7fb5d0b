# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The commands: where their functions are, and their help in one line."""

from __future__ import annotations

COMMANDS = {
    "Start here": {
        "demo": ("fits.demo", "Simulate a drive, fit a map to it, and compare the map with the truth."),
        "check": ("scans.check", "Report what is wrong with scans and poses, before a fit."),
        "fit": ("fits.fit", "Fit a map to scans."),
        "mesh": ("maps.mesh", "Extract the surface of a map as a triangle mesh."),
    },
    "Poses, recordings and large maps": {
        "poses": ("scans.poses", "Refine the poses of scans by their returns, or find them from the radar alone."),
        "live": ("live.live", "Replay a recording into a map that grows, and report how it keeps up."),
        "tiles": ("tiles", "Fit a map that does not fit into memory, in tiles, here or on a cluster."),
    },
    "Uses of a map": {
        "view": ("pages.view", "Show a map in the browser, with a sensor that can be dragged."),
        "report": ("pages.report", "Write a page about a map: pictures, errors, plots, settings."),
        "eval": ("maps.evaluate", "Print the errors of a mesh or a map."),
        "render": ("maps.render", "Predict the scan that the radar would get from other poses."),
        "compare": ("uses.compare", "Report what appeared, is gone, moved or changed its reflectance between two maps."),
        "grid": ("uses.grid", "Write occupied, free and unknown space for planners: OctoMap, map_server, costmap."),
    },
    "Files and settings": {
        "convert": ("scans.convert", "Write scans as one file or one point cloud, or a mesh in another format."),
        "config": ("fits.config", "Print every setting of a fit with its meaning, as a file for --config."),
        "info": ("maps.info", "Print versions and threads, for bug reports, and what a map holds."),
    },
}  # fmt: skip
"""Module and function, and help, of each command, by heading of the overview."""

TILE_STEPS = {
    "run": "Plan, fit and mesh in one go; the word run may be left out.",
    "plan": "Read the scans once, and write the rays of each tile.",
    "fit": "Fit the tiles of a plan; those that are done are kept.",
    "mesh": "Write the surface of all tiles as one mesh.",
    "status": "Name the tiles that are not done, and why: exit status 1.",
}
"""The steps of ``radarsdf tiles``, functions of the module `tiles`, and their help."""


def overview() -> str:
    """The help of ``radarsdf`` without a command."""
    lines = [
        "Usage: radarsdf COMMAND [OPTIONS]...",
        "",
        "From 3D radar scans to a surface and a reflectance map, on a CPU.",
    ]
    for heading, commands in COMMANDS.items():
        lines += ["", f"{heading}:", *(f"  {name:<9}{text}" for name, (_, text) in commands.items())]
    lines += [
        "",
        "radarsdf COMMAND --help lists the options of a command. Others: --version, --install-completion.",
    ]
    return "\n".join(lines)
