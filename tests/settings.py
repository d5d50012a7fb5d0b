"""Settings by name without groups, for tests that vary single ones."""

import dataclasses
from typing import Any

from radarsdf import FitConfig


def grouped(**settings: Any) -> dict[str, Any]:
    """Settings without their groups, such as ``sdf_iterations=3``, as arguments of :class:`FitConfig`."""
    top: dict[str, Any] = {}
    for name, value in settings.items():
        for group in ("returns", "encoding", "networks", "training"):
            if name in {field.name for field in dataclasses.fields(getattr(FitConfig(), group))}:
                top.setdefault(group, {})[name] = value
                break
        else:
            top[name] = value
    return top
