# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Settings as a TOML file, with a table for each group."""

from __future__ import annotations

import dataclasses
import json
import sys
import textwrap
from os import PathLike
from pathlib import Path
from typing import Any

from radarsdf.config.fit_config import FitConfig

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

_WIDTH = 100  # columns of a comment


def read_toml(path: str | PathLike[str]) -> dict[str, Any]:
    """The settings in a TOML file, as :meth:`FitConfig.override` takes them.

    Raises
    ------
    ValueError
        If the file is not TOML.
    OSError
        If it cannot be read.
    """
    try:
        return tomllib.loads(Path(path).read_text(encoding="utf-8-sig"))
    except (
        ValueError,
        RecursionError,
    ) as error:  # invalid TOML or invalid UTF-8, or lists in lists without end
        msg = f"{path} is not a TOML file: {error}"
        raise ValueError(msg) from error


def to_toml(config: FitConfig) -> str:
    """All settings, each below a comment that explains it.

    A setting that is None is written as a comment, because TOML has no null.
    """
    groups = [
        field.name
        for field in dataclasses.fields(config)
        if dataclasses.is_dataclass(getattr(config, field.name))
    ]
    lines = _settings(config, leave_out=groups)
    for name in groups:
        group = getattr(config, name)
        lines += ["", f"[{name}]", *_comment(_descriptions(config)[name]), "", *_settings(group)]
    return "\n".join(lines) + "\n"


def _settings(group: Any, leave_out: list[str] | None = None) -> list[str]:
    lines = []
    for field in dataclasses.fields(group):
        if field.name in (leave_out or []):
            continue
        value = getattr(group, field.name)
        lines += _comment(_descriptions(group)[field.name])
        # TOML writes numbers, strings, booleans and lists as JSON does.
        lines.append(f"# {field.name} =" if value is None else f"{field.name} = {json.dumps(value)}")
    return lines


def _descriptions(group: Any) -> dict[str, str]:
    return {
        name: " ".join((field.description or "").split()) for name, field in group.__pydantic_fields__.items()
    }


def _comment(text: str) -> list[str]:
    return textwrap.wrap(text, _WIDTH, initial_indent="# ", subsequent_indent="# ")
