# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""``radarsdf info``: what a bug report needs."""

from __future__ import annotations

import argparse

from radarsdf.cli.options import add_json
from radarsdf.cli.results import Results


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add_json(parser)


def run(options: argparse.Namespace) -> None:
    """Print one line for each part."""
    from radarsdf.versions import versions

    results = Results(options)
    for name, value in versions().items():
        results.add(f"{name:<16}{value}", **{name.replace(" ", "_"): value})
    results.end()
