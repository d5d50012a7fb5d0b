# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Every block of Python, shell and console of the pages runs, and prints what the page has."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import pytest

from .pages import Block, blocks, run_console, run_python, run_shell, shell_environment
from .recordings import write_demo, write_recordings

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted(
    page
    for page in (ROOT / "docs").rglob("*.md")
    if not page.read_text(encoding="utf-8").startswith("<!-- the text of")
)
NEEDS = {"five_minutes": "matplotlib", "your_own_scans": "rosbags", "queries": "trimesh"}
RECORDINGS = {"five_minutes": write_demo, "your_own_scans": write_recordings}
RUN = {"python", "sh", "console"}
TEXT = {"{toctree}", "{eval-rst}", "text"}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_the_languages_of_blocks_are_known(page):
    assert {block.language for block in blocks(page)} <= RUN | TEXT


@pytest.mark.skipif(
    sys.platform == "win32" or shutil.which("bash") is None, reason="the blocks of a shell are those of bash"
)
@pytest.mark.parametrize(
    "page",
    [page for page in PAGES if RUN & {block.language for block in blocks(page)}],
    ids=lambda page: page.stem,
)
def test_the_blocks_of_a_page_run(page, tmp_path, monkeypatch):
    if page.stem in NEEDS:
        pytest.importorskip(NEEDS[page.stem])
    work = tmp_path / "work"
    work.mkdir()
    if page.stem in RECORDINGS:
        RECORDINGS[page.stem](work)
    monkeypatch.chdir(work)
    environment, names = shell_environment(tmp_path), {"__name__": "page"}
    ran = 0
    for block in blocks(page):
        if block.not_run or block.language in TEXT:
            continue
        where = f"{page.name}, line {block.line}"
        try:
            if block.language == "python":
                run_python(block, page, names)
            elif block.language == "sh":
                run_shell(block, environment)
            else:
                run_console(block, environment)
        except Exception as error:
            msg = f"{where}: {error}"
            raise AssertionError(msg) from error
        ran += 1
    assert ran, "no block of the page runs"


@pytest.mark.parametrize(
    ("printed", "same"),
    [
        ("fit 3 s\nwritten to a", True),
        ("fit 5.8 s\nsomething else\nwritten to a", True),
        ("fitted 5.8 s\nwritten to a", False),
        ("fit 5.8 s\nwritten to b", False),
    ],
)
def test_a_console_block_is_compared(printed, same, tmp_path):
    text = "$ printf '" + printed.replace("\n", "\\n") + "\\n'\nfit 5.8 s\n…\nwritten to a\n"
    block = Block("console", text, 1, None)
    if same:
        run_console(block, shell_environment(tmp_path))
    else:
        with pytest.raises(AssertionError, match="and the page has"):
            run_console(block, shell_environment(tmp_path))


def test_numbers_may_be_left_out(tmp_path):
    environment = shell_environment(tmp_path)
    run_console(Block("console", "$ echo fit 5.8 s, 94.2%\nfit … s, …%\n", 1, None), environment)
    with pytest.raises(AssertionError, match="and the page has"):
        run_console(Block("console", "$ echo fit two s\nfit … s\n", 1, None), environment)


def test_a_shell_block_that_fails_is_found(tmp_path):
    with pytest.raises(AssertionError, match="no such"):
        run_shell(Block("sh", "echo no such; false\n", 1, None), shell_environment(tmp_path))
