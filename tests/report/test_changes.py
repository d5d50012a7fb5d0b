# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The page about what changed says it in words, and shows it."""

from __future__ import annotations

import numpy as np
import pytest
from radarsdf.changes.changes import APPEARED, COLORS, MOVED, NAMES, REPAINTED, SAME, ChangedSurface, Changes

from .reading import Page

HOSTILE = "<script>alert(1)</script>.safetensors"


def surface(kinds):
    """A sheet of 2 × 2 m for each kind, side by side."""
    steps = np.linspace(0, 2, 9)
    sheet = np.stack(np.meshgrid(steps, steps, [0.0], indexing="ij"), -1).reshape(-1, 3)
    corner = (np.arange(8)[:, None] * 9 + np.arange(8)).reshape(-1)
    faces = np.concatenate([corner[:, None] + [0, 9, 1], corner[:, None] + [1, 9, 10]])
    count = len(sheet)
    vertices = np.concatenate([sheet + [0, 3.0 * number, 0] for number in range(len(kinds))])
    faces = np.concatenate([faces + count * number for number in range(len(kinds))]).astype(np.int32)
    kind = np.repeat(np.array(kinds, np.int8), count)
    moved = np.where(kind == MOVED, 0.25, np.nan).astype(np.float32)
    change = np.where(kind == REPAINTED, 6.5, np.nan).astype(np.float32)
    return ChangedSurface(vertices, faces, kind, np.full(len(kind), 0.9, np.float32), moved, change)


def changes_of(kinds):
    report = {
        "alignment": "The maps were taken as they are.",
        "areas_m2": {NAMES[kind]: 4.0 * kinds.count(kind) for kind in (APPEARED, 1, MOVED, REPAINTED)},
        "compared_m2": 20.0,
        "reflectance": "It was not compared." if len(kinds) == 1 else "All returns are +0.4 stronger.",
    }
    return Changes(surface([SAME]), surface(kinds), np.eye(4), report)


@pytest.fixture(scope="module")
def write(tmp_path_factory):
    pytest.importorskip("viser", reason="the extra view is not installed")
    pytest.importorskip("matplotlib", reason="the extra plot is not installed")
    from radarsdf.report.changes import write_changes_report  # noqa: PLC0415

    def written(changes):
        path = tmp_path_factory.mktemp("changes") / "changes.html"
        size = write_changes_report(path, changes, ("monday", HOSTILE), 0.2, changes.regions(0.1))
        assert size == path.stat().st_size
        return Page(path.read_text("utf-8"))

    return written


def test_each_change_is_said_listed_and_shown(write):
    page = write(changes_of([SAME, APPEARED, MOVED, REPAINTED]))
    words = page.sections["conclusion"]
    assert "4.0 m² in one place, the largest round (1.0, 4.0, 0.0) m." in words
    assert "+0.4 stronger" in words
    assert "unseen, not gone" in words
    assert "Gone" not in words
    listed = page.sections["changes"]
    for expected in ("appeared", "moved by 0.25 m", "repainted, 6.5 stronger", "2.0 × 2.0 × 0.0", "0.90"):
        assert expected in listed
    assert len(page.all("img")) == 3 + 3
    assert len(page.frames) == 1
    assert all(picture["alt"] for picture in page.all("img"))
    styles = [found.get("style", "") for found in page.all("i")]
    for color in COLORS.values():
        assert "background:rgb({} {} {})".format(*color) in styles
    # No markup of names, and nothing from elsewhere.
    assert not page.all("script")
    assert all(address.startswith(("#", "data:")) for address in page.addresses())


def test_without_changes_it_says_so(write):
    page = write(changes_of([SAME]))
    assert "No place changed" in page.sections["conclusion"]
    assert "It was not compared" in page.sections["conclusion"]
    assert "Nothing changed." in page.sections["changes"]
    assert "places" not in page.sections
