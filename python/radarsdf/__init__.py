"""From 3D radar scans with known poses to a surface and a reflectance map, on a CPU.

``__init__.pyi`` lists the public names, imported at their first use: ``import radarsdf`` alone loads neither PyTorch nor NumPy.
"""

from importlib import import_module

with open(f"{__file__}i", encoding="utf-8") as _stub:  # noqa: PTH123 - pathlib takes as long to import as all of this
    _LINES = [line.split() for line in _stub if line.startswith("from .")]  # from MODULE import NAME as NAME
_MODULES = {words[3]: words[1] for words in _LINES}

__all__ = list(_MODULES)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]


def __getattr__(name: str) -> object:
    if name == "__version__":
        from importlib.metadata import PackageNotFoundError, version  # noqa: PLC0415 - takes as long as the package

        try:
            found: object = version("radarsdf")
        except PackageNotFoundError:  # run from sources on PYTHONPATH, not installed
            found = import_module("radarsdf._core").__version__
    elif (module := _MODULES.get(name)) is None:
        msg = f"module {__name__!r} has no attribute {name!r}"
        raise AttributeError(msg)
    elif module == ".":
        return import_module(f".{name}", __name__)
    else:
        found = getattr(import_module(module, __name__), name)
    globals()[name] = found  # cached for later accesses
    return found
