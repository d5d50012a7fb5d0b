"""Presets by name, and changes of their settings as nested dicts."""

import ast
from collections.abc import Iterable
from typing import Any

from radarsdf import FitConfig

Changes = dict[str, Any]
"""Settings to change: top-level ones of a `FitConfig`, and a dict for each group; JSON-serialisable."""

PRESETS = {"default": FitConfig(), "quick": FitConfig.quick(), "paper": FitConfig.paper()}


def merged(*changes: Changes) -> Changes:
    """Merge changes; the last value of a setting wins."""
    found: Changes = {}
    for part in changes:
        for name, value in part.items():
            before = found.get(name)
            both = isinstance(before, dict) and isinstance(value, dict)
            found[name] = before | value if both else value
    return found


def parsed(words: Iterable[str]) -> Changes:
    """Parse changes from words such as ``training.batch_size=8192``. Those of ``mesh.`` are arguments of a mesh.

    Raises
    ------
    ValueError
        If a word has no ``=``, or `FitConfig` has no such setting.
    """
    found: Changes = {}
    for word in words:
        name, equals, text = word.partition("=")
        if not equals:
            msg = f"expected NAME=VALUE, not {word}"
            raise ValueError(msg)
        try:
            value = ast.literal_eval(text)
        except (ValueError, SyntaxError):
            value = text
        group, dot, setting = name.partition(".")
        found = merged(found, {group: {setting: value}} if dot else {name: value})
    FitConfig().override(**{name: value for name, value in found.items() if name != "mesh"})
    return found


def words_of(changes: Changes) -> str:
    """Format changes as words; the inverse of :func:`parsed`."""
    words = []
    for name, value in changes.items():
        of_group = value if isinstance(value, dict) else {"": value}
        words += [f"{name}.{setting}={own}".replace(".=", "=") for setting, own in of_group.items()]
    return ", ".join(words)
