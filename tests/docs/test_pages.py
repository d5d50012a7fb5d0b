# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Every Python, shell and console block of the pages runs and prints what the page shows."""

import shutil
import sys
from pathlib import Path

import pytest

from .pages import Block, blocks, run_console, run_python, run_shell
from .recordings import write_demo, write_recordings

DOCS = Path(__file__).resolve().parents[2] / "docs"
NEEDS = {"five_minutes": "matplotlib", "your_own_scans": "rosbags", "queries": "trimesh"}
RECORDINGS = {"five_minutes": write_demo, "your_own_scans": write_recordings}
RUN = {"python", "sh", "console"}
TEXT = {"{toctree}", "{eval-rst}", "text"}
PAGES = sorted(DOCS.rglob("*.md"))


def test_languages_of_blocks_are_known():
    languages = {block.language for page in PAGES for block in blocks(page)}
    assert languages <= RUN | TEXT
    assert all(page.read_text(encoding="utf-8").count("\n```") % 2 == 0 for page in PAGES)


@pytest.mark.skipif(
    sys.platform == "win32" or shutil.which("bash") is None, reason="shell blocks are written for bash"
)
@pytest.mark.parametrize(
    "page",
    [page for page in PAGES if RUN & {block.language for block in blocks(page)}],
    ids=lambda page: page.stem,
)
def test_blocks_run(page, tmp_path, monkeypatch):
    if page.stem in NEEDS:
        pytest.importorskip(NEEDS[page.stem])
    work = tmp_path / "work"
    work.mkdir()
    if page.stem in RECORDINGS:
        RECORDINGS[page.stem](work)
    monkeypatch.chdir(work)
    names = {"__name__": "page"}
    run = {"python": lambda block: run_python(block, page, names), "sh": run_shell, "console": run_console}
    for block in blocks(page):
        if not block.is_run or block.language in TEXT:
            continue
        try:
            run[block.language](block)
        except Exception as error:
            msg = f"{page.name}, line {block.line}: {error}"
            raise AssertionError(msg) from error


@pytest.mark.parametrize(
    ("printed", "matches"),
    [
        ("fit 3 s\\nsomething else\\nwritten to a", True),
        ("fitted 5.8 s\\nwritten to a", False),
        ("fit 5.8 s\\nwritten to b", False),
    ],
)
def test_console_blocks_are_compared(printed, matches):
    block = Block("console", f"$ printf '{printed}\\n'\nfit … s\n…\nwritten to a\n", 1, True)
    if matches:
        run_console(block)
    else:
        with pytest.raises(AssertionError, match="the page has"):
            run_console(block)
