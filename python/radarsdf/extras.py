"""Optional dependencies, and how to install missing ones."""

import importlib
from typing import Any

REQUIREMENTS = {
    "cyclonedds": "cyclonedds>=11",
    "distributed": "distributed>=2024.8",
    "foxglove": "foxglove-sdk>=0.30",
    "laspy": "laspy[lazrs]>=2.5",
    "matplotlib": "matplotlib>=3.7",
    "rerun": "rerun-sdk>=0.24",
    "rosbags": "rosbags>=0.11",
    "viser": "viser>=1.1",
}
"""Requirements for pip by module: the extras of `pyproject.toml`, which need a release in pip's index."""


def require(*modules: str, what: str) -> Any:
    """Import libraries and return the last one. `what`, such as "the viewer needs", begins the ImportError for missing ones."""
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
