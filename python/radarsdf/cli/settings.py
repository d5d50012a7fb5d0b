"""``radarsdf config``, and the settings of other commands."""

from __future__ import annotations

import ast
from argparse import Namespace
from typing import Any

from radarsdf.cli.options import refuse_if
from radarsdf.cli.results import Results
from radarsdf.config.fit_config import FitConfig, read_toml, to_toml


def config(given: Namespace, results: Results) -> None:
    """Print the settings as TOML."""
    results.add(to_toml(load_config(given)).rstrip("\n"))


def load_config(given: Namespace) -> FitConfig:
    """Build the configuration: a preset, then the settings of a file, then single settings."""
    refuse_if(given.paper and given.quick, "--paper and --quick are two presets: leave out one of them")
    config = FitConfig.paper() if given.paper else FitConfig.quick() if given.quick else FitConfig()
    if given.config is not None:
        config = config.override(**read_toml(given.config))
    for text in given.set or ():
        config = config.override(**_setting_of(text))
    return config


def _setting_of(text: str) -> dict[str, Any]:
    """Parse one ``NAME=VALUE`` or ``GROUP.NAME=VALUE``. A value that is not a Python literal, such as octree, is a string."""
    path, equals, value = text.partition("=")
    refuse_if(not equals, f"--set takes NAME=VALUE, not {text!r:.50}")
    group, dot, name = path.partition(".")
    try:
        read = ast.literal_eval(value)
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError):
        read = {"true": True, "false": False}.get(value, value)  # as in TOML
    return {group: {name: read}} if dot else {path: read}
