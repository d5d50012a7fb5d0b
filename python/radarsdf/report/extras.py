# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The libraries that a report needs and a fit does not."""

from __future__ import annotations

import importlib

_EXTRA_OF = {"matplotlib": "plot", "viser": "view"}


def require_extras() -> None:
    """Raise an ImportError that says what to install, if a library is missing. To be called before the work."""
    missing = []
    for name in _EXTRA_OF:
        try:
            importlib.import_module(name)
        except ImportError:
            missing.append(name)
    if missing:
        extras = ",".join(_EXTRA_OF[name] for name in missing)
        msg = f'a report needs {" and ".join(missing)}: pip install "radarsdf[{extras}]"'
        raise ImportError(msg)
