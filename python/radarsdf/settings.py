# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Dataclasses whose values are checked, by pydantic, with errors of one line."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Mapping
from typing import Any, TypeVar, cast

from pydantic import ConfigDict, ValidationError
from pydantic.dataclasses import dataclass
from typing_extensions import dataclass_transform

_Class = TypeVar("_Class", bound=type)


def by_name(values: Any, what: str) -> dict[str, Any]:
    """`values` as a dict of settings by name. A ValueError says if they are none."""
    if not isinstance(values, Mapping):
        msg = f"{what} must be a mapping of names to values, not {values!r:.50}"
        raise ValueError(msg)  # noqa: TRY004 - of settings, a wrong type is a wrong value: see FitConfig
    for name in values:
        if not isinstance(name, str):
            msg = f"{what} must have names as keys, not {name!r:.50}"
            raise ValueError(msg)  # noqa: TRY004
    return dict(values)


def first_wrong(error: ValidationError, prefix: str) -> str:
    """One line on the first wrong value, whose name gets a prefix."""
    first = error.errors(include_url=False)[0]
    if first["type"] == "value_error":  # of a check of ours or of a group: its message is complete
        return first["msg"].removeprefix("Value error, ")
    name = prefix + ".".join(part for part in first["loc"] if isinstance(part, str))
    must = re.sub(r"^\w+ should", "must", first["msg"])
    return f"{name} {must}, not {first['input']!r:.50}"


@dataclass_transform(frozen_default=True, kw_only_default=True)
def settings(cls: _Class) -> _Class:
    """Makes a frozen dataclass that checks its values. A ValueError of one line names the wrong one."""
    rules = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True)
    checked = dataclass(frozen=True, kw_only=True, config=rules)(cls)
    construct: Callable[..., None] = checked.__init__
    group = cls.__name__.removesuffix("Config").lower()
    prefix = "" if group == "fit" else f"{group}."

    @functools.wraps(construct)
    def with_short_errors(self: Any, /, **values: Any) -> None:
        for name in values:
            if name not in cls.__annotations__:
                msg = f"unknown setting {prefix}{name:.50}"
                raise ValueError(msg)
        try:
            construct(self, **values)
        except ValidationError as error:
            raise ValueError(first_wrong(error, prefix)) from None

    setattr(checked, "__init__", with_short_errors)  # noqa: B010 - mypy refuses a plain assignment
    return cast(_Class, checked)
