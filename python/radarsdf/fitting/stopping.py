# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""How a fit ends before its time, and what it hands back then."""

from __future__ import annotations

from radarsdf.map.radar_map import RadarMap


class Interrupted(KeyboardInterrupt):
    """Ctrl-C during a fit.

    Attributes
    ----------
    radar_map : RadarMap or None
        What was learnt so far, a map like any other; None if the training had not begun. In its ``report``,
        ``iterations_done`` falls short of ``iterations``.
    """

    def __init__(self, radar_map: RadarMap | None = None) -> None:
        super().__init__("interrupted while training" if radar_map else "interrupted before the training")
        self.radar_map = radar_map


class Diverged(FloatingPointError):
    """A loss or a parameter stopped being finite; the message says which, in which stage and iteration.

    Attributes
    ----------
    radar_map : RadarMap or None
        The last state found to be finite throughout, at most a hundred iterations older.
    """

    radar_map: RadarMap | None = None
