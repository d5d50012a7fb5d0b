# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What to install for a library that is missing: words that pip takes anywhere, also before there is a release."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest
from radarsdf.extras import REQUIREMENTS, require

if sys.version_info < (3, 11):
    import tomli as tomllib
else:
    import tomllib

ROOT = Path(__file__).parents[1]


def test_the_requirements_are_those_of_the_extras():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"][
        "optional-dependencies"
    ]
    of_extras = {
        requirement for name in ("cluster", "las", "plot", "ros", "view") for requirement in extras[name]
    }
    assert set(REQUIREMENTS.values()) == of_extras
    assert all(requirement.startswith(module) for module, requirement in REQUIREMENTS.items())


def test_what_is_missing_is_named_with_a_command(monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    monkeypatch.setitem(sys.modules, "laspy", None)
    with pytest.raises(
        ImportError, match=re.escape('it takes viser and laspy: pip install "viser>=1.1" "laspy[')
    ):
        require("json", "viser", "laspy", what="it takes")
    assert require("json", what="it takes").loads("1") == 1


def test_nothing_asks_for_an_extra_by_name():
    """Of a project that has no release yet, pip finds no extras."""
    files = [
        *ROOT.glob("python/radarsdf/**/*.py"),
        *ROOT.glob("docs/**/*.md"),
        *ROOT.glob("*.md"),
        *ROOT.glob("examples/*"),
    ]
    assert len(files) > 100
    asked = [
        path.name
        for path in files
        if path.is_file() and 'install "radarsdf[' in path.read_text(encoding="utf-8")
    ]
    assert asked == []
