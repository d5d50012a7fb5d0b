"""Settings as a TOML file, with a table for each group."""

from __future__ import annotations

import dataclasses
import json
import sys
import textwrap
from pathlib import Path
from typing import Any

from radarsdf.checks import AnyPath
from radarsdf.config.fit_config import FitConfig

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

_WIDTH = 100  # columns of a comment


def read_toml(path: AnyPath) -> dict[str, Any]:
    """Read settings from a TOML file, as :meth:`FitConfig.override` takes them. A ValueError: the file is not TOML."""
    try:
        return tomllib.loads(Path(path).read_text(encoding="utf-8-sig"))
    except (ValueError, RecursionError) as error:  # RecursionError: lists in lists without end
        msg = f"{path} is not a TOML file: {error}"
        raise ValueError(msg) from error


def to_toml(config: FitConfig) -> str:
    """Format all settings as TOML, each below a comment that explains it.

    A setting that is None is written as a comment, because TOML has no null.
    """
    top, tables = [], []
    for name, value, description in _settings(config):
        if not dataclasses.is_dataclass(value):
            top += _lines(name, value, description)
            continue
        tables += ["", f"[{name}]", *_comment(description), ""]
        for setting in _settings(value):
            tables += _lines(*setting)
    return "\n".join(top + tables) + "\n"


def _settings(group: Any) -> list[tuple[str, Any, str]]:
    described = {name: field.description or "" for name, field in group.__pydantic_fields__.items()}
    return [(name, getattr(group, name), " ".join(text.split())) for name, text in described.items()]


def _lines(name: str, value: Any, description: str) -> list[str]:
    # TOML writes numbers, strings, booleans and lists as JSON does.
    written = f"# {name} =" if value is None else f"{name} = {json.dumps(value)}"
    return [*_comment(description), written]


def _comment(text: str) -> list[str]:
    return textwrap.wrap(text, _WIDTH, initial_indent="# ", subsequent_indent="# ")
