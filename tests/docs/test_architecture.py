# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The page of the architecture names files that are there, and what it says to be in a file is in it."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
TEXT = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
PLACES = (
    "",
    "python/radarsdf",
    "csrc",
    *(f"python/radarsdf/{room}" for room in ("checking", "report", "view")),
)
_NAMED_FILE = r"`([\w/]+\.(?:py|hpp|cpp|md|txt|svg|sh))`"


def found(path):
    return next((ROOT / place / path for place in PLACES if (ROOT / place / path).is_file()), None)


def test_its_files_are_there():
    paths = set(re.findall(_NAMED_FILE, TEXT))
    assert len(paths) > 80
    assert sorted(path for path in paths if found(path) is None) == []


def test_what_it_says_to_be_in_a_file_is_there():
    """`Name` (`file`), `Name` in `file`, `Name` of `file`."""
    names = r"((?:`[\w.]+`(?:, | and )?)+)"
    told = [
        (name, path)
        for named, path in re.findall(rf"{names} (?:\(|in |of ){_NAMED_FILE}", TEXT)
        for name in re.findall(r"[\w.]+(?=`)", named)
    ]
    assert len(told) > 80
    wrong = [
        (name, path)
        for name, path in told
        for word in name.removeprefix("radarsdf.").split(".")
        if not re.search(rf"\b{word}\b", found(path).read_text(encoding="utf-8"))
    ]
    assert wrong == []
