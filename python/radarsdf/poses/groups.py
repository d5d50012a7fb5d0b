# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Scans that move in groups: long windows have no more unknowns than short ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from radarsdf.poses.rigid import Floats, skew

Blocks = tuple[Floats, Floats, Floats]
"""Blocks on the diagonal (F, 6, 6), below it (F - 1, 6, 6), and a gradient (F, 6), as of :meth:`Motion.prior`."""


@dataclass(frozen=True)
class Groups:
    """Consecutive scans, of which the middle one has an increment, and the others what lies between those of two middle ones."""

    num_scans: int
    size: int
    """Scans of a group; the last one may have fewer. 1: each scan is on its own."""

    @property
    def middles(self) -> NDArray[np.intp]:
        """(G,) number of the scan in the middle of each group."""
        begins = np.arange(0, self.num_scans, self.size)
        return (begins + np.minimum(begins + self.size, self.num_scans)) // 2

    def of(self, scans: NDArray[np.int32]) -> NDArray[np.int32]:
        """The number of the group of each scan."""
        return scans // np.int32(self.size)

    def prior(self, of_scans: Blocks, poses: Floats) -> Blocks:
        """Of increments of the groups, from that of increments of the scans with these poses (F, 4, 4)."""
        if self.size == 1:
            return of_scans
        diagonal, below, gradient = of_scans
        count = len(self.middles)
        own, at = self._segments()
        found = np.zeros((count, 6, 6)), np.zeros((count - 1, 6, 6)), np.zeros((count, 6))
        ends = self._by_ends(poses, own, at)
        for k, end in enumerate(ends):
            np.add.at(found[0], own + k, np.einsum("fki,fkl,flj->fij", end, diagonal, end))
            np.add.at(found[2], own + k, np.einsum("fki,fk->fi", end, gradient))
        np.add.at(found[1], own, np.einsum("fki,fkl,flj->fij", ends[1], diagonal, ends[0]))
        # Both scans of a step lie between the same two middles, or on them.
        first = [end[:-1] for end in ends]
        second = [end[1:] for end in self._by_ends(poses, np.concatenate([own[:1], own[:-1]]), at)]
        products = [[np.einsum("fki,fkl,flj->fij", b, below, a) for a in first] for b in second]
        for k in range(2):
            np.add.at(found[0], own[:-1] + k, products[k][k] + products[k][k].transpose(0, 2, 1))
        np.add.at(found[1], own[:-1], products[1][0] + products[0][1].transpose(0, 2, 1))
        return found

    def increments(self, of_groups: Floats, poses: Floats) -> Floats:
        """(F, 6) of the scans with these poses (F, 4, 4), from those of the groups (G, 6)."""
        if self.size == 1:
            return of_groups
        own, at = self._segments()
        ends = self._by_ends(poses, own, at)
        parts = [np.einsum("fij,fj->fi", end, of_groups[own + k]) for k, end in enumerate(ends)]
        found: Floats = parts[0] + parts[1]
        return found

    def _segments(self) -> tuple[NDArray[np.intp], Floats]:
        """(F,) for each scan, the group whose middle is the last one not after it; of the last group, the one before. And the
        places (F,) of all scans: those before the first middle and after the last one are there."""
        middles = self.middles
        at = np.clip(np.arange(self.num_scans), middles[0], middles[-1])
        own = np.searchsorted(middles, at, side="right") - 1
        return np.minimum(own, len(middles) - 2), at.astype(np.float64)

    def _by_ends(self, poses: Floats, own: NDArray[np.intp], at: Floats) -> list[Floats]:
        """Two times (F, 6, 6): how the increment of each scan follows from those of the middles of its group `own` and of the next."""
        middles = self.middles
        shares = (at - middles[own]) / (middles[own + 1] - middles[own])
        found = []
        for share, middle in ((1 - shares, middles[own]), (shares, middles[own + 1])):
            moved = np.tile(np.eye(6), (self.num_scans, 1, 1))
            moved[:, :3, 3:] = -skew(poses[:, :3, 3] - poses[middle, :3, 3])
            found.append(share[:, None, None] * moved)
        return found
