"""Read and run the fenced code blocks of a page."""

import contextlib
import io
import logging
import os
import re
import shlex
import subprocess
import sys
import warnings
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
_OWN = re.compile(r"(cd|radarsdf) [^|<;&$*>]+(> \S+)?")


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


def run_shell(block: Block) -> None:
    """Run a block. Any command that fails is an error."""
    lines = [line.split("  #")[0].strip() for line in block.text.splitlines()]
    if not all(_OWN.fullmatch(line) for line in lines):
        lines = [block.text]
    before = Path.cwd()
    try:
        for line in lines:
            status, printed = _run(line)
            assert status == 0, f"$ {line}\n{printed}"
    finally:
        os.chdir(before)  # a block does not move the next one


def run_console(block: Block) -> None:
    """Run each line that starts with `$`, and compare its output with the page.

    Numbers may differ. A line … matches any lines, and … within a line any number. The exit status does not matter.
    """
    for part in re.split(r"^\$ ", block.text, flags=re.MULTILINE)[1:]:
        command, *expected = part.splitlines()
        printed = [line.rstrip() for line in _run(command)[1].splitlines() if line.rstrip()]
        pattern = "".join(r"(.*\n)*?" if line == _OMITTED else re.escape(_plain(line)) for line in expected)
        assert re.fullmatch(pattern, "".join(map(_plain, printed))), "\n".join(
            [f"$ {command}", *printed, "-- but the page has", *expected]
        )


def _plain(line: str) -> str:
    return _NUMBER.sub("#", line.replace(_OMITTED, "#")) + "\n"


def _run(command: str) -> tuple[int, str]:
    """Status and output. Commands of radarsdf run in this process, which has already imported PyTorch."""
    if not _OWN.fullmatch(command):
        done = subprocess.run(
            ["bash", "-euo", "pipefail", "-c", command],
            env=os.environ
            | {"PATH": os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            encoding="utf-8",
            check=False,
            timeout=300,
        )
        return done.returncode, done.stdout
    command, _, file = command.partition(" > ")
    name, *words = shlex.split(command)
    if name == "cd":
        os.chdir(*words)
        return 0, ""
    printed = io.StringIO()
    handler = logging.StreamHandler(printed)
    logging.getLogger("radarsdf").addHandler(handler)
    try:
        with (
            contextlib.redirect_stdout(printed),
            contextlib.redirect_stderr(printed),
            warnings.catch_warnings(),
        ):
            warnings.simplefilter("default")  # as in a separate process: printed, and no error
            status = main(words)
    finally:
        logging.getLogger("radarsdf").removeHandler(handler)
    if file:
        Path(file).write_text(printed.getvalue(), encoding="utf-8")
        return status, ""
    return status, printed.getvalue()
