# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Exceptions of a fit that ends early. They carry the map so far."""

from __future__ import annotations

from radarsdf.map.radar_map import RadarMap


class Interrupted(KeyboardInterrupt):
    """Ctrl-C during a fit.

    Attributes
    ----------
    radar_map : RadarMap or None
        The map so far, which can be used like any other. None if the training had not begun. In its
        ``report``, ``iterations_done`` is less than ``iterations``.
    """

    def __init__(self, radar_map: RadarMap | None = None) -> None:
        super().__init__("interrupted while training" if radar_map else "interrupted before the training")
        self.radar_map = radar_map


class Diverged(FloatingPointError):
    """A loss or a parameter is not finite. The message names it, the stage and the iteration.

    Attributes
    ----------
    radar_map : RadarMap or None
        The last state that was checked and finite, at most 100 iterations before.
    """

    radar_map: RadarMap | None = None
