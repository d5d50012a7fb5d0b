# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""`docs/draw.py` draws all figures, and the pages show them."""

import runpy
from pathlib import Path

import pytest

DOCS = Path(__file__).resolve().parents[2] / "docs"


def test_figures_are_drawn_and_shown(tmp_path):
    pytest.importorskip("matplotlib")
    code = runpy.run_path(str(DOCS / "draw.py"))
    code["SIZE"].update(width=240, height=112)  # most of the time is spent on pixels
    code["draw"](tmp_path, frames=6)
    drawn = {path.name for path in tmp_path.iterdir()}
    assert drawn == {path.name for path in (DOCS / "figures").iterdir()}
    pages = "".join(page.read_text(encoding="utf-8") for page in DOCS.glob("*.md"))
    assert [name for name in drawn if f"figures/{name}" not in pages] == []
