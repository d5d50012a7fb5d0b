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

    `what` needs them, such as "the viewer needs". An ImportError names one that is missing and the command to install all.
    """
    try:
        return [importlib.import_module(name) for name in modules][-1]
    except ImportError as error:
        names = [name for name in (one.partition(".")[0] for one in modules) if name in REQUIREMENTS]
        wanted = " ".join(f'"{REQUIREMENTS[name]}"' for name in names)
        msg = f"{what} {' and '.join(names)}: pip install {wanted}"
        raise ImportError(msg) from error
