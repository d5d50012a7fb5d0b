# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The figures of pages for users are those of one run, `bench/results.json`, at one commit; none is written by hand."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from bench.report import __main__ as command
from bench.report import pages, results

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "bench" / "results.json"
# The first is of the commits that bench/history names. The other two say what data are like.
OTHERS = {"defaults", "checks", "simulation"}
PAGES = [
    ROOT / "README.md",
    *(page for page in sorted((ROOT / "docs").glob("*.md")) if page.stem not in OTHERS),
]
FIGURE = re.compile(
    r"\d\s?(s|ms|min|minutes|seconds|dB|%)(?!\w)|F-score\D{0,20}\d\d|commit [0-9a-f]{7}", re.ASCII
)
COST = re.compile(r"\b(fit|in|about|and) \d[\d.]* (s|GB)\b|F-score\D*\d")  # of what a command prints


def by_hand(text):
    """The lines with a figure that stand outside the blocks of the run, and outside code."""
    found, language = [], None
    for line in pages.outside(text).splitlines():
        if line.startswith("```"):
            language = line[3:] or "text" if language is None else None
        elif (FIGURE if language is None else COST).search(line) and language not in ("python", "sh"):
            found.append(line)
    return found


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_no_figure_of_a_page_is_written_by_hand(page):
    assert by_hand(page.read_text(encoding="utf-8")) == []


def test_the_pages_have_the_figures_of_the_run_of_one_commit():
    run = results.read(RESULTS)
    assert re.fullmatch("[0-9a-f]{7,}", run["commit"])
    assert not run["quick"]
    shown = pages.pages(ROOT)
    assert {page.stem for page in shown} == {"README", "settings", "how_it_works", "large"}
    command.main(["write", "--check", str(RESULTS), "--root", str(ROOT)])


@pytest.mark.parametrize(
    "line",
    [
        "| radarsdf | 3.6 s |",
        "It takes 15 s and 1 GB.",
        "MAE 2.92 dB",
        "the F-score is 96.2",
        "96 % of the surface",
        "measured at commit 4e15be872d",
        "```console\n$ radarsdf demo\nfit 7.0 s, mesh 1.3 s\n```",
        "```console\nF-score     96.45 %\n```",
    ],
)
def test_a_figure_that_is_written_by_hand_is_found(line):
    assert by_hand(f"# Page\n\n{line}\n")


def test_figures_of_the_run_and_code_are_not_by_hand():
    block = "<!-- measured: growth -->\nIt takes 15 s.\n<!-- end -->\n"
    assert by_hand(f"{block}\n```sh\nsleep 15 s\n```\n```console\nfit … s, gaps up to 0.5 s\n```\n") == []
