# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What is released beside the wheels agrees with `pyproject.toml`: the recipe of conda, the image."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest

if sys.version_info < (3, 11):
    import tomli as tomllib
else:
    import tomllib

ROOT = Path(__file__).parents[1]
CONDA_NAMES = {"torch": "pytorch-cpu", "matplotlib": "matplotlib-base"}


@pytest.fixture(scope="module")
def project():
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def test_the_recipe_of_conda_asks_for_what_pip_asks_for(project):
    recipe = (ROOT / "conda/recipe.yaml").read_text(encoding="utf-8")
    assert re.findall(r'version: "(.+)"', recipe) == [project["version"]]
    asked = re.search(r"  run:\n((?:    - .+\n)+)", recipe)[1]
    found = {tuple(line[6:].partition("#")[0].split()) for line in asked.splitlines()}
    extras = project["optional-dependencies"]
    wanted = {("python", project["requires-python"])}
    for requirement in [*project["dependencies"], *extras["plot"], *extras["view"]]:
        name, limit = re.fullmatch(r"([\w-]+)(>=[\w.]+)(?:;.*)?", requirement.replace(" ", "")).groups()
        wanted.add((CONDA_NAMES.get(name, name), limit))
    assert found == wanted


def test_the_image_is_made_of_files_that_it_is_given():
    """`.dockerignore` leaves out all that it does not name: what the build reads must be in it."""
    given = {
        line[1:]
        for line in (ROOT / ".dockerignore").read_text(encoding="utf-8").splitlines()
        if line[:1] == "!"
    }
    assert all((ROOT / name).exists() for name in given)
    cmake = (ROOT / "CMakeLists.txt").read_text(encoding="utf-8")
    read = set(re.findall(r"include\((\w+)/|add_subdirectory\((\w+)", cmake))
    folders = {name for pair in read for name in pair if name} - {"tests"}
    assert (
        folders | {"CMakeLists.txt", "pyproject.toml", "constraints.txt", "LICENSE", "README.md", "python"}
        <= given
    )
