# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Whether there is a place for a progress bar."""

from __future__ import annotations

import sys

from radarsdf.checks import flag


def hides_bar(progress: bool | None) -> bool | None:
    """tqdm's `disable`, where a bar is asked for (True), not wanted (False), or for a terminal alone (None).

    A service, or a command after ``2>&-``, has no standard error: then there is never a bar.
    """
    if sys.stderr is None or getattr(sys.stderr, "closed", False):
        return True
    return None if progress is None else not flag(progress, "progress")
