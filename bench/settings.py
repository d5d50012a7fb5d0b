# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Configurations of fits by their names, and changes of them as nested dicts: put together, and as words."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from radarsdf import FitConfig
from radarsdf.cli.options import setting_of

Changes = dict[str, Any]
"""Settings of the top of a `FitConfig`, and for each group a dict of those of its settings that change; goes through JSON."""

PRESETS = {"default": FitConfig(), "quick": FitConfig.quick(), "paper": FitConfig.paper()}


def merged(*changes: Changes) -> Changes:
    """All changes together; of the same setting, the last one counts."""
    found: Changes = {}
    for part in changes:
        for name, value in part.items():
            before = found.get(name)
            both = isinstance(before, dict) and isinstance(value, dict)
            found[name] = before | value if both else value
    return found


def parsed(words: Iterable[str]) -> Changes:
    """Of words such as ``training.joint=False``, as ``--set`` of radarsdf takes them."""
    return merged(*map(setting_of, words))
