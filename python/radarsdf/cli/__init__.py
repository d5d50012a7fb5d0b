# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The command line: ``radarsdf COMMAND``.

`commands` lists them, `app` makes a typer application of their functions, `options` has what several of them share,
`results` how they print; the other modules are the commands. They import PyTorch, NumPy and trimesh only while a command
runs, so help and usage errors are immediate.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

from radarsdf.cli.commands import overview


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
    completes = "_RADARSDF_COMPLETE" in os.environ  # a shell asks for words, and gives none
    if words in ([], ["--help"], ["-h"]) and not completes:  # to import typer would take three times as long
        print(overview())
        return 0

    from radarsdf.cli.app import run

    return run(words)
