# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Libraries that only some uses need, and what to install where one is missing."""

from __future__ import annotations

import importlib
from typing import Any

REQUIREMENTS = {
    "distributed": "distributed>=2024.8",
    "laspy": "laspy[lazrs]>=2.5",
    "matplotlib": "matplotlib>=3.7",
    "rosbags": "rosbags>=0.11",
    "viser": "viser>=1.1",
}
"""What pip is asked for, by module: the extras of `pyproject.toml`. An extra by name, such as ``radarsdf[view]``, needs a
release in pip's index, or a clone."""


def require(*modules: str, what: str) -> Any:
    """Import libraries that may not be installed, and return the last one.

    Parameters
    ----------
    *modules : str
        Names in `REQUIREMENTS`, or modules of these libraries.
    what : str
        What needs them, with its verb, such as "the viewer needs".

    Raises
    ------
    ImportError
        If one is missing. The message names all that are, and the command that installs them.
    """
    missing: list[str] = []
    found: Any = None
    for name in modules:
        try:
            found = importlib.import_module(name)
        except ImportError:
            missing.append(name.partition(".")[0])
    if missing:
        wanted = " ".join(f'"{REQUIREMENTS[name]}"' for name in missing)
        msg = f"{what} {' and '.join(missing)}: pip install {wanted}"
        raise ImportError(msg)
    return found
