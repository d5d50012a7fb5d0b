"""The command line: ``radarsdf COMMAND``.

`commands` lists them, `app` runs one and prints its error, `options` and `results` are shared; the other modules are the
commands. They import PyTorch, NumPy and trimesh only when a command runs, so help is immediate.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from radarsdf.cli.options import overview


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command, by default of ``sys.argv``, and return the exit status. An error is printed as one line on standard error.

    The status is 0 on success, 1 if the command failed or a check found an error, 2 if the command line is wrong, 130 if
    Ctrl-C stopped it.
    """
    words = sys.argv[1:] if arguments is None else list(arguments)
    if words in ([], ["--help"], ["-h"]):
        print(overview())
        return 0

    from radarsdf.cli.app import run

    return run(words)
