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
"""What pip is asked for, by module: the extras of `pyproject.toml`, whose names need a release in pip's index."""


def require(*modules: str, what: str) -> Any:
    """Import libraries that may not be installed, and return the last one.

    `what` needs them, such as "the viewer needs". An ImportError names all that are missing, and the command to install.
    """
    missing: list[str] = []
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
