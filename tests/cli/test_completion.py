# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Shells complete commands, options, choices and names of files."""

from __future__ import annotations

import shutil
import subprocess

import pytest
from radarsdf.cli import COMMANDS
from radarsdf.cli.completion import SHELLS

from .calls import call

_BASH = """
source "$1"; shift
COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1))
$(complete -p radarsdf | sed 's/.*-F \\([^ ]*\\) .*/\\1/') radarsdf "${COMP_WORDS[COMP_CWORD]}" "${COMP_WORDS[COMP_CWORD-1]}"
printf '%s\\n' "${COMPREPLY[@]}"
"""
_FISH = 'source $argv[1]; complete -C "$argv[2]"'


@pytest.fixture
def script(tmp_path, capsys):
    def write(shell):
        assert call("completion", shell) == 0
        path = tmp_path / f"radarsdf.{shell}"
        path.write_text(capsys.readouterr().out)
        return path

    return write


@pytest.mark.parametrize("shell", SHELLS)
def test_the_script_has_no_fault_of_syntax_and_every_command(script, shell):
    path = script(shell)
    assert all(command in path.read_text() for command in COMMANDS)
    if shutil.which(shell) is None:
        pytest.skip(f"no {shell} here")
    subprocess.run([shell, "-n", path], check=True, timeout=60)


@pytest.mark.parametrize("shell", ["bash", "fish"])
@pytest.mark.parametrize(
    ("words", "completed"),
    [
        (["conv"], {"convert"}),
        (["convert", "--ext"], {"--extrinsic"}),
        (["demo", "--scene", "hu"], {"hugin"}),
        (["fit", "scans_of"], {"scans_of_mine.npz"}),
        (["fit", "scans", "-o", "scans_of"], {"scans_of_mine.npz"}),
    ],
)
def test_words_are_completed(script, tmp_path, shell, words, completed):
    if shutil.which(shell) is None:
        pytest.skip(f"no {shell} here")
    path = script(shell)
    (tmp_path / "scans_of_mine.npz").touch()
    arguments = {
        "bash": ["-c", _BASH, "bash", path, "radarsdf", *words],
        "fish": ["--no-config", "-c", _FISH, path, " ".join(["radarsdf", *words])],
    }[shell]
    done = subprocess.run(
        [shell, *arguments], cwd=tmp_path, capture_output=True, text=True, check=True, timeout=60
    )
    assert {line.split("\t")[0] for line in done.stdout.splitlines()} == completed
