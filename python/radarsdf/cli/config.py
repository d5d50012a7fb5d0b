# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""`radarsdf config`: print every setting, as a file that ``--config`` reads."""

from __future__ import annotations

import argparse

from radarsdf.cli.options import add_config_options, config_of
from radarsdf.cli.saying import say


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add_config_options(parser)


def run(options: argparse.Namespace) -> None:
    """Print the configuration."""
    from radarsdf.config.toml import to_toml

    say(to_toml(config_of(options)), end="")
