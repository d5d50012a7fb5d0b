# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""From 3D radar scans with known poses to a surface and a reflectance map, on a CPU.

Each public name is imported from its module when it is first used, so ``import radarsdf`` alone is fast: it imports
neither PyTorch nor NumPy. The names are in ``__init__.pyi``.
"""

import lazy_loader

_public, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> object:
    """Import a name when it is first used."""
    if name != "__version__":
        return _public(name)
    from importlib.metadata import PackageNotFoundError, version  # noqa: PLC0415 - takes as long as the package

    try:
        found = version("radarsdf")
    except PackageNotFoundError:  # the sources on PYTHONPATH, not installed
        from radarsdf.versions import versions  # noqa: PLC0415 - it imports the core

        found = versions()["radarsdf"]
    globals()[name] = found  # the next use does not come here
    return found
