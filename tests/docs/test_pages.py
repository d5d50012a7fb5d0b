"""Every block of the pages runs and prints what the page shows; figures are drawn, and references exist."""

import re
import runpy
import shutil
import sys
from pathlib import Path

import pytest

from .pages import blocks, run_console, run_python, run_shell
from .recordings import write_recordings

DOCS = Path(__file__).resolve().parents[2] / "docs"
NEEDS = {"your_own_scans": "rosbags", "queries": "trimesh"}
RECORDINGS = {"your_own_scans": write_recordings}
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


def test_figures_are_drawn_and_shown(tmp_path):
    pytest.importorskip("matplotlib")
    code = runpy.run_path(str(DOCS / "draw.py"))
    code["draw"](tmp_path, frames=6)
    drawn = {path.name for path in tmp_path.iterdir()}
    assert drawn == {path.name for path in (DOCS / "figures").iterdir()}
    pages = "".join(page.read_text(encoding="utf-8") for page in DOCS.glob("*.md"))
    assert [name for name in drawn if f"figures/{name}" not in pages] == []


ROOT = Path(__file__).resolve().parents[2]
ARCHITECTURE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8").replace("\n", " ")
PLACES = (
    "",
    "python/radarsdf",
    *(f"python/radarsdf/{subpackage}" for subpackage in ("checking", "report", "view")),
)
FILE = r"`([\w/]+\.(?:py|hpp|cpp|md|txt|svg|sh))`"


def found(path):
    return next((ROOT / place / path for place in PLACES if (ROOT / place / path).is_file()), None)


def test_files_exist():
    paths = set(re.findall(FILE, ARCHITECTURE))
    assert len(paths) > 40
    assert sorted(path for path in paths if found(path) is None) == []


def test_names_are_in_their_files():
    """References of the form `Name` (`file`), and `Name` in or of `file`."""
    references = [
        (name, path)
        for names, path in re.findall(rf"((?:`[\w.]+`(?:, | and )?)+) (?:\(|in |of ){FILE}", ARCHITECTURE)
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
