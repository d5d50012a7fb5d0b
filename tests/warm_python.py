# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The Python of the tests, as the first words of a command."""

from __future__ import annotations

import sys


def warm_python() -> list[str]:
    """The command of the interpreter."""
    return [sys.executable]
