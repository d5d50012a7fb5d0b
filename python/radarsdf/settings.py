"""Frozen dataclasses of settings, validated by pydantic."""

import re
from collections.abc import Mapping
from typing import Any, TypeVar, cast

from pydantic import ConfigDict, ValidationError
from pydantic.dataclasses import dataclass
from typing_extensions import dataclass_transform

from radarsdf.checks import check

_Class = TypeVar("_Class", bound=type)
_RULES = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True)


@dataclass_transform(frozen_default=True, kw_only_default=True)
def settings(cls: _Class) -> _Class:
    """Make a frozen keyword-only dataclass. Wrong values raise a `pydantic.ValidationError`, which is a ValueError."""
    return cast(_Class, dataclass(frozen=True, kw_only=True, config=_RULES)(cls))


def by_name(values: Any, what: str) -> dict[str, Any]:
    """Convert to a dict of settings by name. Raises a ValueError for anything but a mapping of names."""
    fits = isinstance(values, Mapping) and all(isinstance(name, str) for name in values)
    check(fits, f"{what} must be a mapping of names to values, not {values!r:.50}")
    return dict(values)


def first_wrong(error: ValidationError) -> str:
    """Format the first wrong value as one line, with the name of the setting."""
    first = error.errors(include_url=False)[0]
    name = ".".join(part for part in first["loc"] if isinstance(part, str))
    if first["type"] == "unexpected_keyword_argument":
        return f"unknown setting {name:.50}"
    if first["type"] == "value_error":  # one of our own checks, with a complete message
        return first["msg"].removeprefix("Value error, ")
    must = re.sub(r"^\w+ should", "must", first["msg"])
    return f"{name} {must}, not {first['input']!r:.50}"
