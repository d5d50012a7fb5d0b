# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The fenced blocks of a page, and how they are run."""

from __future__ import annotations

import contextlib
import io
import logging
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from radarsdf.cli import main

_FENCE = re.compile(r"^```(\S*)\s*$")
_NOT_RUN = re.compile(r"^<!-- not run: (.+) -->$")
_NUMBER = re.compile(r"-?\d+(\.\d+)?(e-?\d+)?")
_LEFT_OUT = "…"
_SHORT_MAIN = """
import sys
from radarsdf.cli import main
from tests.short import shorten
shorten(setattr)
sys.exit(main())
"""


@dataclass(frozen=True)
class Block:
    """One fenced block."""

    language: str
    text: str
    line: int
    not_run: str | None
    """Why it is not run."""


def blocks(page: Path) -> Iterator[Block]:
    """The blocks of a page, in order."""
    lines = page.read_text(encoding="utf-8").splitlines()
    start = None
    for i, line in enumerate(lines):
        match = _FENCE.match(line)
        if match and start is None:
            start, language = i, match[1]
        elif match:
            before = _NOT_RUN.match(lines[start - 1]) if start else None
            yield Block(language, "\n".join(lines[start + 1 : i]) + "\n", start + 1, before and before[1])
            start = None
    assert start is None, f"{page.name}: the block of line {start} has no end"


def run_python(block: Block, page: Path, names: dict) -> None:
    """Run the lines with the names of the page's blocks before."""
    code = compile("\n" * block.line + block.text, str(page), "exec")  # a traceback has the lines of the page
    exec(code, names)  # noqa: S102


def run_shell(block: Block, environment: dict[str, str]) -> str:
    """Run the block by bash; what it prints, errors too."""
    done = _bash(block.text, environment)
    assert done.returncode == 0, done.stdout
    return done.stdout


def run_console(block: Block, environment: dict[str, str]) -> None:
    """Run each line that begins with `$`, and compare what comes back with what the page has.

    Numbers may differ. A line … stands for any lines, and … within a line for a number that is left out. Where a command is said to fail is not written, so its status does
    not count.
    """
    for command, expected in _commands(block):
        printed = [line.rstrip() for line in _answer(command, environment).splitlines()]
        printed = [line for line in printed if line]
        assert _same(expected, printed), "\n".join(
            [f"$ {command}", *printed, "-- and the page has", *expected]
        )


def _answer(command: str, environment: dict[str, str]) -> str:
    """What a command prints. Those of radarsdf run in this process, which has imported PyTorch already."""
    if not command.startswith("radarsdf ") or set("|<>;&$*") & set(command):
        return _bash(command, environment).stdout
    printed = io.StringIO()
    notes = logging.StreamHandler(printed)  # as logging does by itself where nobody else handles them
    logging.getLogger("radarsdf").addHandler(notes)
    try:
        with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
            main(shlex.split(command)[1:])
    finally:
        logging.getLogger("radarsdf").removeHandler(notes)
    return printed.getvalue()


def _commands(block: Block) -> Iterator[tuple[str, list[str]]]:
    parts = re.split(r"^\$ ", block.text, flags=re.MULTILINE)
    assert not parts[0], "a console block begins with $"
    for part in parts[1:]:
        command, *expected = part.splitlines()
        yield command, expected


def _same(expected: list[str], printed: list[str]) -> bool:
    def plain(line: str) -> str:
        return _NUMBER.sub("#", line.replace(_LEFT_OUT, "#")) + "\n"

    whole = "".join(r"(.*\n)*?" if line == _LEFT_OUT else re.escape(plain(line)) for line in expected)
    return re.fullmatch(whole, "".join(map(plain, printed))) is not None


def shell_environment(folder: Path) -> dict[str, str]:
    """Variables for the shell: `radarsdf` and `python` are those of this process."""
    tools = folder / "tools"
    tools.mkdir()
    python = shlex.quote(sys.executable)
    for name, words in (("radarsdf", f"{python} -c {shlex.quote(_SHORT_MAIN)}"), ("python", python)):
        script = tools / name
        script.write_text(f'#!/bin/sh\nexec {words} "$@"\n', encoding="utf-8")
        script.chmod(0o755)
    root = Path(__file__).parents[2]
    return os.environ | {
        "PATH": os.pathsep.join([str(tools), os.environ["PATH"]]),
        "PYTHONPATH": os.pathsep.join([str(root), os.environ.get("PYTHONPATH", "")]),
        "MPLBACKEND": "Agg",
    }


def _bash(text: str, environment: dict[str, str]) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["bash", "-euo", "pipefail", "-c", text],
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        encoding="utf-8",
        check=False,
        timeout=300,
    )
