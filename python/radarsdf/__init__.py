# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""From 3D radar scans with known poses to a surface and a reflectance map, on a CPU.

Each public name is imported from its module when it is first used, so ``import radarsdf`` alone is fast: it imports
neither PyTorch nor NumPy.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from radarsdf import evaluation, io, simulate
    from radarsdf.budget.estimate import Estimate, estimate
    from radarsdf.checking.check import check
    from radarsdf.checking.finding import Finding
    from radarsdf.config import FitConfig
    from radarsdf.fitting.fit import fit
    from radarsdf.fitting.stopping import Diverged, Interrupted
    from radarsdf.map.isosurface import marching_cubes
    from radarsdf.map.radar_map import RadarMap
    from radarsdf.tiles.any_map import load
    from radarsdf.tiles.fit_tiles import fit_tiles
    from radarsdf.tiles.tiled_map import TiledMap

    __version__: str

__all__ = [
    "Diverged",
    "Estimate",
    "Finding",
    "FitConfig",
    "Interrupted",
    "RadarMap",
    "TiledMap",
    "check",
    "estimate",
    "evaluation",
    "fit",
    "fit_tiles",
    "io",
    "load",
    "marching_cubes",
    "simulate",
]

_PACKAGES = (
    "budget",
    "checking",
    "evaluation",
    "field",
    "fitting",
    "io",
    "map",
    "render",
    "returns",
    "simulate",
    "tiles",
)
_MODULES = {
    "Diverged": "radarsdf.fitting.stopping",
    "Estimate": "radarsdf.budget.estimate",
    "Finding": "radarsdf.checking.finding",
    "FitConfig": "radarsdf.config",
    "Interrupted": "radarsdf.fitting.stopping",
    "RadarMap": "radarsdf.map.radar_map",
    "check": "radarsdf.checking.check",
    "estimate": "radarsdf.budget.estimate",
    "TiledMap": "radarsdf.tiles.tiled_map",
    "fit": "radarsdf.fitting.fit",
    "fit_tiles": "radarsdf.tiles.fit_tiles",
    "load": "radarsdf.tiles.any_map",
    "marching_cubes": "radarsdf.map.isosurface",
} | {name: f"radarsdf.{name}" for name in _PACKAGES}
"""The module of each name that is imported when it is first used."""

if not TYPE_CHECKING:  # type checkers use the imports above, and report every other name

    def __getattr__(name: str) -> object:
        """Import a name when it is first used."""
        if name == "__version__":
            globals()[name] = _version()
            return globals()[name]
        if name not in _MODULES:
            msg = f"module {__name__!r} has no attribute {name!r}"
            raise AttributeError(msg)
        module = import_module(_MODULES[name])
        value = module if name in _PACKAGES else getattr(module, name)
        globals()[name] = value  # the next use does not come here
        return value

    def __dir__() -> list[str]:
        return sorted({*globals(), *_MODULES, "__version__"})

    def _version() -> str:
        from importlib.metadata import PackageNotFoundError, version  # noqa: PLC0415 - takes as long as the package

        try:
            return version("radarsdf")
        except PackageNotFoundError:  # the sources on PYTHONPATH, not installed
            return import_module("radarsdf.versions").versions()["radarsdf"]
