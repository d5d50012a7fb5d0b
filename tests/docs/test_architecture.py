# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The files and names that the architecture page refers to exist."""

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
TEXT = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8").replace("\n", " ")
PLACES = (
    "",
    "python/radarsdf",
    *(f"python/radarsdf/{subpackage}" for subpackage in ("checking", "report", "view")),
)
FILE = r"`([\w/]+\.(?:py|hpp|cpp|md|txt|svg|sh))`"


def found(path):
    return next((ROOT / place / path for place in PLACES if (ROOT / place / path).is_file()), None)


def test_files_exist():
    paths = set(re.findall(FILE, TEXT))
    assert len(paths) > 40
    assert sorted(path for path in paths if found(path) is None) == []


def test_names_are_in_their_files():
    """References of the form `Name` (`file`), and `Name` in or of `file`."""
    references = [
        (name, path)
        for names, path in re.findall(rf"((?:`[\w.]+`(?:, | and )?)+) (?:\(|in |of ){FILE}", TEXT)
        for name in re.findall(r"[\w.]+(?=`)", names)
    ]
    assert len(references) > 40
    missing = [
        (name, path)
        for name, path in references
        for word in name.split(".")
        if found(path) is None or not re.search(rf"\b{word}\b", found(path).read_text(encoding="utf-8"))
    ]
    assert missing == []
