# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Each format is read in the bench, which checks what it reads."""

from __future__ import annotations

import pytest

pytest.importorskip("rosbags", reason="the extra ros is not installed")
pytest.importorskip("laspy", reason="the extra las is not installed")

from bench.reading import __main__ as command
from bench.reading.formats import FORMATS


def test_each_format_has_a_row(tmp_path):
    # Without those that Open3D reads too: it takes seconds to import.
    names = [name for name, form in FORMATS.items() if form.peer != "Open3D"]
    command.main(["--quick", "--out", str(tmp_path), "--only", *names])
    lines = (tmp_path / "reading.md").read_text().splitlines()
    assert [line.split("|")[1].strip() for line in lines[4:]] == names
