"""Imports of the package go from higher to lower layers, without cycles."""

import ast
import functools
import graphlib
from pathlib import Path

import radarsdf

ROOT = Path(radarsdf.__file__).parent
BASE = [
    "_core", "arrays", "checks", "core", "extras", "interrupts", "lattice", "memory", "products", "rig", "scans", "settings", "threads",
]  # fmt: skip
# From the lowest to the highest. A subpackage may import itself and those before it; `io` is below `map`, which saves itself.
METHOD = ["config", "returns", "field", "io", "map", "fitting"]
USES = ["poses", "checking", "live", "tiles", "grids", "changes", "evaluation", "simulate"]
EDGES = ["render", "view", "report", "cli"]
LEVEL = dict.fromkeys(BASE, 0) | {name: 1 + i for i, name in enumerate(METHOD + USES + EDGES)}


def modules():
    """Name of each module of the package, and its file. The front door, radarsdf itself, imports all."""
    for path in sorted(ROOT.rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        if name not in ("", "__main__"):
            yield name, path


def imports_of(path, name):
    """Imports of a module from the package, including those in functions and for the type checker."""
    package = name if path.name == "__init__.py" else name.rpartition(".")[0]
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                base = f"radarsdf.{package}" + (f".{base}" if base else "")
            names = [f"{base}.{alias.name}" for alias in node.names]
        else:
            continue
        yield from (found.removeprefix("radarsdf.") for found in names if found.startswith("radarsdf."))


@functools.cache
def graph():
    known = dict(modules())
    found = {}
    for name, path in known.items():
        uses = set()
        for target in imports_of(path, name):
            # `from radarsdf.returns.rays import Rays` names an object of a module, or a module of a package.
            parts = target.split(".")
            while parts and ".".join(parts) not in known:
                parts.pop()
            uses.add(".".join(parts) if parts else target.split(".")[0])
        found[name] = uses - {name}
    return found


def test_every_subpackage_is_known():
    assert {name.split(".")[0] for name, _ in modules()} | {"_core"} == set(LEVEL)


def test_one_module_imports_the_compiled_core():
    """It imports PyTorch before: with an OpenMP runtime each, both start their own threads."""
    assert [name for name, targets in graph().items() if "_core" in targets] == ["core"]


def test_imports_go_downwards():
    upwards = [
        f"{name} imports {target}"
        for name, targets in graph().items()
        for target in targets
        if target.split(".")[0] in LEVEL and LEVEL[target.split(".")[0]] > LEVEL[name.split(".")[0]]
    ]
    # Commands import the public package, as users do.
    assert upwards == []
    assert len(graph()["fitting.fit"]) > 5  # imports are found at all


def test_there_are_no_circles():
    graphlib.TopologicalSorter(graph()).prepare()  # a CycleError names the circle
