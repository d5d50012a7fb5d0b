# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The command line: ``radarsdf COMMAND``.

`app` has the typer application, `options` what several commands share, `results` how they print. The other modules are
the commands. They import PyTorch, NumPy and trimesh only while a command runs, so help and usage errors are immediate.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

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


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command. An error is printed as one line on standard error.

    Parameters
    ----------
    arguments
        The words after ``radarsdf``. None: those of this process.

    Returns
    -------
    int
        The exit status: 0 if the command succeeded, 1 if it failed or a check found an error, 2 if the command line is
        wrong, 130 if Ctrl-C stopped it.
    """
    words = sys.argv[1:] if arguments is None else list(arguments)
    if words in ([], ["--help"], ["-h"]):  # to import typer would take three times as long
        print(_overview())
        return 0

    from radarsdf.cli.app import run

    return run(words)


def _overview() -> str:
    lines = [
        "Usage: radarsdf COMMAND [OPTIONS]...",
        "",
        "From 3D radar scans to a surface and a reflectance map, on a CPU.",
    ]
    for panel, commands in COMMANDS.items():
        lines += ["", f"{panel}:", *(f"  {name:<9}{text}" for name, text in commands.items())]
    lines += ["", "radarsdf COMMAND --help lists the options of a command; --version, --install-completion."]
    return "\n".join(lines)
