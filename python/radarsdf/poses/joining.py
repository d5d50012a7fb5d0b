# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Joins the poses of windows of scans by the scans that they have in common."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from radarsdf.poses.rigid import Floats, alignment, covariance_in, moved, placed

_NOWHERE = -1  # piece of a scan that has no pose


class JoinedPoses:
    """Takes the poses of one window after another. The world is that of the first."""

    def __init__(self) -> None:
        self.poses: Floats = np.zeros((0, 4, 4))
        """(F, 4, 4) T_world_sensor, m."""
        self.covariance: Floats = np.zeros((0, 6, 6))
        """(F, 6, 6) relative to the scan in the middle of its window."""
        self.agreeing: Floats = np.zeros(0)
        """(F,) as of :class:`Odometry`; NaN where it is not known."""
        self._pieces = np.zeros(0, np.int64)
        self._upright = True

    @property
    def pieces(self) -> NDArray[np.int64]:
        """(F,) as of :class:`Odometry`. A scan without a pose is a piece of its own."""
        begins = (np.diff(self._pieces) != 0) | (self._pieces[1:] == _NOWHERE)
        numbers: NDArray[np.int64] = np.concatenate([[0], np.cumsum(begins)])
        return numbers

    def skip(self, begin: int, count: int) -> None:
        """A window of `count` scans from number `begin` on that has no poses."""
        new = begin + count - len(self.poses)
        last = self.poses[-1:] if len(self.poses) else np.eye(4)[None]
        nowhere, unknown = np.full(new, _NOWHERE), np.full(new, np.nan)
        self._extend(np.repeat(last, new, axis=0), np.zeros((new, 6, 6)), nowhere, unknown)

    def add(
        self,
        begin: int,
        poses: Floats,
        covariance: Floats,
        pieces: NDArray[np.int64] | None = None,
        agreeing: Floats | None = None,
        *,
        upright: bool = False,
    ) -> None:
        """A window of poses (K, 4, 4) from number `begin` on, in a world of its own.

        `upright`: the z axis of that world points up. Between two such windows, no tilt adds up.
        """
        pieces = np.zeros(len(poses), np.int64) if pieces is None else pieces
        agreeing = np.full(len(poses), np.nan) if agreeing is None else agreeing
        common = len(self.poses) - begin
        piece = self._pieces[-1] if common else _NOWHERE
        if piece == _NOWHERE:
            self._add_piece(begin, poses, covariance, pieces, agreeing)
            self._upright = upright
            return
        same = (self._pieces[begin:] == piece) & (pieces[:common] == pieces[common - 1])
        first = common - int(same[::-1].cumprod().sum())  # of those that both have in one piece
        rows, before = slice(begin + first, begin + common), self.poses[begin + first :]
        T = alignment(poses[first:common], before)
        if upright and self._upright:
            T = placed(_about_z(T), poses[first:common], before)
        there: Floats = np.einsum("ij,fjk->fik", T, poses)
        # From one window's poses to the other's bit by bit: at its ends, a window knows least.
        shares = np.arange(1, common - first + 1) / (common - first + 1)
        self.poses[rows] = _between(before, there[first:common], shares)
        turned = covariance_in(covariance, T[:3, :3])
        later = shares > 0.5
        self.covariance[rows][later] = turned[first:common][later]
        numbers = piece + pieces[common:] - pieces[common - 1]
        self._extend(there[common:], turned[common:], numbers, agreeing[common:])

    def _add_piece(
        self, begin: int, poses: Floats, covariance: Floats, pieces: NDArray[np.int64], agreeing: Floats
    ) -> None:
        """A window that nothing joins to those before. It begins where the last scan before was."""
        T = placed(np.eye(4), poses[:1], self.poses[begin - 1 : begin]) if begin else np.eye(4)
        numbers = int(self._pieces[:begin].max(initial=_NOWHERE)) + 1 + pieces
        for name in ("poses", "covariance", "agreeing", "_pieces"):
            setattr(self, name, getattr(self, name)[:begin])
        turned = covariance_in(covariance, T[:3, :3])
        self._extend(np.einsum("ij,fjk->fik", T, poses), turned, numbers, agreeing)

    def _extend(self, poses: Floats, covariance: Floats, pieces: NDArray[np.int64], agreeing: Floats) -> None:
        self.poses = np.concatenate([self.poses, poses])
        self.covariance = np.concatenate([self.covariance, covariance])
        self._pieces = np.concatenate([self._pieces, pieces])
        self.agreeing = np.concatenate([self.agreeing, agreeing])


def _about_z(T: Floats) -> Floats:
    """(4, 4) the rotation about z that is nearest to that of T."""
    angle = np.arctan2(T[1, 0] - T[0, 1], T[0, 0] + T[1, 1])
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec([0, 0, angle]).as_matrix()
    return turn


def _between(first: Floats, second: Floats, shares: Floats) -> Floats:
    """Poses (K, 4, 4) between two: shares (K,) of the way to the second."""
    turns = np.einsum("fij,fkj->fik", second[:, :3, :3], first[:, :3, :3])
    ways = np.concatenate([(second - first)[:, :3, 3], Rotation.from_matrix(turns).as_rotvec()], axis=1)
    return moved(first, shares[:, None] * ways)
