# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The commands and their help in one line."""

from __future__ import annotations

COMMANDS = {
    "Start here": {
        "demo": "Simulate a drive, fit a map to it, and compare the map with the truth.",
        "check": "Report what is wrong with scans and poses, before a fit.",
        "fit": "Fit a map to scans.",
        "mesh": "Extract the surface of a map as a triangle mesh.",
    },
    "Poses, recordings and large maps": {
        "poses": "Refine the poses of scans by their returns, or find them from the radar alone.",
        "live": "Replay a recording into a map that grows, and report how it keeps up.",
        "tiles": "Fit a map that does not fit into memory, in tiles, here or on a cluster.",
    },
    "Uses of a map": {
        "view": "Show a map in the browser, with a sensor that can be dragged.",
        "report": "Write a page about a map: pictures, errors, plots, settings.",
        "eval": "Print the errors of a mesh or a map.",
        "render": "Predict the scan that the radar would get from other poses.",
        "compare": "Report what appeared, is gone, moved or changed its reflectance between two maps.",
        "grid": "Write occupied, free and unknown space for planners: OctoMap, map_server, costmap.",
    },
    "Files and settings": {
        "convert": "Write scans as one file or one point cloud, or a mesh in another format.",
        "config": "Print every setting of a fit with its meaning, as a file for --config.",
        "info": "Print versions and threads, for bug reports, and what a map holds.",
    },
}
"""The commands by panel of the help, with their help in one line."""


def overview() -> str:
    """The help of ``radarsdf`` without a command."""
    lines = [
        "Usage: radarsdf COMMAND [OPTIONS]...",
        "",
        "From 3D radar scans to a surface and a reflectance map, on a CPU.",
    ]
    for panel, commands in COMMANDS.items():
        lines += ["", f"{panel}:", *(f"  {name:<9}{text}" for name, text in commands.items())]
    lines += [
        "",
        "radarsdf COMMAND --help lists the options of a command. Others: --version, --install-completion.",
    ]
    return "\n".join(lines)
