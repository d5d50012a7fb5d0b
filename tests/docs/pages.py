# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Read and run the fenced code blocks of a page."""

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
from pathlib import Path
from typing import NamedTuple

from radarsdf.cli import main

_BLOCK = re.compile(
    r"^(?P<not_run><!-- not run: .+ -->\n)?```(?P<language>\S*) *\n(?P<text>.*?)^```$",
    re.DOTALL | re.MULTILINE,
)
_NUMBER = re.compile(r"-?\d+(\.\d+)?(e-?\d+)?")
_OMITTED = "…"
_SHORT_MAIN = """
import sys
from radarsdf.cli import main
from tests.short import shorten
shorten(setattr)
sys.exit(main())
"""


class Block(NamedTuple):
    """A fenced code block."""

    language: str
    text: str
    line: int
    is_run: bool


def blocks(page: Path) -> Iterator[Block]:
    """Return the blocks of a page, in order."""
    text = page.read_text(encoding="utf-8")
    for match in _BLOCK.finditer(text):
        line = text.count("\n", 0, match.start("text"))
        yield Block(match["language"], match["text"], line, match["not_run"] is None)


def run_python(block: Block, page: Path, names: dict) -> None:
    """Execute a block with the names that earlier blocks of the page defined."""
    code = compile("\n" * block.line + block.text, str(page), "exec")  # tracebacks show lines of the page
    exec(code, names)  # noqa: S102


def run_shell(block: Block, environment: dict[str, str]) -> None:
    """Run a block with bash."""
    done = _bash(block.text, environment)
    assert done.returncode == 0, done.stdout


def run_console(block: Block, environment: dict[str, str]) -> None:
    """Run each line that starts with `$`, and compare its output with the page.

    Numbers may differ. A line … matches any lines, and … within a line any number. The exit status does not matter.
    """
    for part in re.split(r"^\$ ", block.text, flags=re.MULTILINE)[1:]:
        command, *expected = part.splitlines()
        printed = [line.rstrip() for line in _output(command, environment).splitlines() if line.rstrip()]
        pattern = "".join(r"(.*\n)*?" if line == _OMITTED else re.escape(_plain(line)) for line in expected)
        assert re.fullmatch(pattern, "".join(map(_plain, printed))), "\n".join(
            [f"$ {command}", *printed, "-- but the page has", *expected]
        )


def _plain(line: str) -> str:
    return _NUMBER.sub("#", line.replace(_OMITTED, "#")) + "\n"


def _output(command: str, environment: dict[str, str]) -> str:
    """Run a command. Those of radarsdf run in this process, which has already imported PyTorch."""
    if not command.startswith("radarsdf ") or set("|<>;&$*") & set(command):
        return _bash(command, environment).stdout
    printed = io.StringIO()
    handler = logging.StreamHandler(printed)
    logging.getLogger("radarsdf").addHandler(handler)
    try:
        with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
            main(shlex.split(command)[1:])
    finally:
        logging.getLogger("radarsdf").removeHandler(handler)
    return printed.getvalue()


def shell_environment(folder: Path) -> dict[str, str]:
    """Return variables for a shell in which `radarsdf` and `python` are those of this process."""
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
