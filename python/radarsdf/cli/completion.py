# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""``radarsdf completion``: what a shell needs to complete commands, options and names of files."""

from __future__ import annotations

import argparse
from pathlib import Path

from radarsdf.cli.saying import say

SHELLS = ("bash", "zsh", "fish")

_EPILOG = """\
once, and then in every new shell:
  bash  radarsdf completion bash > ~/.local/share/bash-completion/completions/radarsdf
  zsh   radarsdf completion zsh > DIR/_radarsdf, with a DIR of $fpath
  fish  radarsdf completion fish > ~/.config/fish/completions/radarsdf.fish"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.epilog = _EPILOG
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("shell", choices=SHELLS)


def run(options: argparse.Namespace) -> None:
    """Print the script. It is made once: the shell does not start radarsdf to complete a word."""
    import shtab

    from radarsdf.cli import whole_parser

    parser = whole_parser()
    _complete_files(parser)
    say(shtab.complete(parser, shell=options.shell), end="")


def _complete_files(parser: argparse.ArgumentParser) -> None:
    """Say of each argument that is a path that it is one."""
    import shtab

    for action in parser._actions:
        if action.type is Path:
            action.complete = shtab.FILE  # type: ignore[attr-defined]
        if isinstance(action.choices, dict):
            for command in action.choices.values():
                _complete_files(command)
