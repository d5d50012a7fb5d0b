# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The bench of the viewer runs; its page is driven in tests/view/test_page.py."""

from __future__ import annotations

import pytest

pytest.importorskip("viser", reason="the extra view is not installed")

from bench.viewing import __main__ as command


def test_a_client_counts(tmp_path, monkeypatch):
    monkeypatch.setattr(command, "why_no_browser", lambda: "left out")
    command.main(["--quick", "--seconds", "2", "--out", str(tmp_path)])
    text = (tmp_path / "viewing.md").read_text()
    rows = dict(line.split(" | ")[1:3] for line in text.splitlines() if line.startswith("| plain | "))
    assert (
        2 < float(rows["updates a second"].removesuffix(" |")) <= 22
    )  # at most 20 a second, and one more at the start
    assert "| chromium | left out | |" in text
