# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""`radarsdf info`, in a process of its own."""

from __future__ import annotations

import os
import subprocess
import sys

from radarsdf import _core

from ..warm_python import warm_python


def test_one_line_for_each_part():
    done = subprocess.run(
        [*warm_python(), "-m", "radarsdf", "info"], capture_output=True, text=True, timeout=60, check=True
    )
    names = ["radarsdf", "python", "torch", "compiler", "openmp", "instruction set"]
    for name, line in zip(names, done.stdout.splitlines(), strict=True):
        assert line.startswith(name.ljust(16))
        assert len(line) > 17
    assert _core.__version__ in done.stdout
    assert done.stderr == ""


def test_an_unknown_instruction_set_is_said():
    done = subprocess.run(
        [sys.executable, "-m", "radarsdf", "info"],
        env=os.environ | {"RADARSDF_ISA": "nonsense"},
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    assert "RADARSDF_ISA=nonsense is none of baseline" in done.stderr
