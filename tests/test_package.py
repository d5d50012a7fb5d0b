# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The names of the package: complete, and imported only when they are used."""

from __future__ import annotations

import inspect
import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest
import radarsdf
from radarsdf import _core


def run(code):
    """Run code in a Python of its own, where nothing of the package is imported yet."""
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


def test_importing_the_package_imports_nothing_else():
    run(
        "import sys; before = set(sys.modules); import radarsdf; dir(radarsdf);"
        "new = {name.partition('.')[0] for name in set(sys.modules) - before};"
        "assert new - sys.stdlib_module_names == {'lazy_loader', 'radarsdf'}, new"
    )


def test_the_names_are_those_of_the_reference():
    """A name that goes, or one that comes without a word in the reference, is seen here."""
    pages = (Path(__file__).parents[1] / "docs/api").glob("*.md")
    named = set()
    for page in pages:
        module = ""
        for line in page.read_text(encoding="utf-8").splitlines():
            if found := re.match(r"\.\. currentmodule:: (\S+)", line):
                module = found[1]
            elif found := re.match(r"\.\. auto(?:class|function|exception):: (\w+)", line):
                named |= {found[1]} if module == "radarsdf" else set()
    assert named | {"evaluation", "io", "simulate"} == set(radarsdf.__all__)


def test_names_are_imported_when_they_are_used():
    run(
        "import radarsdf\n"
        "for name in radarsdf.__all__:\n"
        "    assert name not in vars(radarsdf) or name in ('io', 'simulate', 'evaluation'), name\n"
        "    assert getattr(radarsdf, name) is vars(radarsdf)[name]"
    )


def test_functions_are_not_hidden_by_packages_of_similar_names():
    assert inspect.isfunction(radarsdf.fit)
    assert inspect.isfunction(radarsdf.estimate)
    for name in ("fitting", "map", "simulate"):
        assert inspect.ismodule(import_module(f"radarsdf.{name}"))


def test_all_names_are_listed():
    assert set(radarsdf.__all__) <= set(dir(radarsdf))


def test_star_import():
    names = {}
    exec("from radarsdf import *", names)  # noqa: S102
    assert set(radarsdf.__all__) <= set(names)


def test_an_unknown_name():
    with pytest.raises(AttributeError, match="radarsdf attribute fitt"):
        radarsdf.fitt  # noqa: B018
    assert not hasattr(radarsdf, "_nothing")


def test_the_version_is_written_once():
    root = Path(__file__).parents[1]
    written = re.search(
        r'^version = "(.+)"$', (root / "pyproject.toml").read_text(encoding="utf-8"), re.MULTILINE
    )
    assert radarsdf.__version__ == _core.__version__ == written[1]
    # The one copy, for those who cite.
    assert f"\nversion: {written[1]}\n" in (root / "CITATION.cff").read_text(encoding="utf-8")


def test_the_version_of_sources_that_are_not_installed_is_that_of_the_core():
    run(
        "import importlib.metadata as m\n"
        "def missing(name): raise m.PackageNotFoundError(name)\n"
        "m.version = missing\n"
        "import radarsdf; assert radarsdf.__version__ == radarsdf.versions.versions()['radarsdf']"
    )


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_the_core_shares_the_openmp_runtime_of_pytorch():
    # This module imports the core, but not PyTorch.
    run(
        "import radarsdf; radarsdf.marching_cubes;"
        "lines = open('/proc/self/maps').read().splitlines();"
        "libraries = {line.split()[-1] for line in lines if any(x in line for x in ('gomp', 'iomp', 'libomp'))};"
        "assert len(libraries) == 1, libraries"
    )
