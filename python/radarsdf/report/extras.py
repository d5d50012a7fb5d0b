# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The libraries that a report needs and a fit does not."""

from __future__ import annotations

from radarsdf.extras import require


def require_extras() -> None:
    """Raise an ImportError that says what to install, if a library is missing. To be called before the work."""
    require("matplotlib", "viser", what="a report needs")
