# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Poses of drives of any length: windows of scans, joined by the scans that they share."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from radarsdf.checks import hides_bar
from radarsdf.config.fit_config import FitConfig
from radarsdf.io.imu import Imu
from radarsdf.io.scans import Scan, Scans, scans_in_memory
from radarsdf.poses.odometry import NotToldError, Odometry, odometry
from radarsdf.poses.refine import RefinedPoses, refine_poses
from radarsdf.poses.rigid import (
    Floats,
    aligned,
    alignment,
    covariance_in,
    increments,
    moved,
    moved_by,
    placed,
    steps,
)

_NOWHERE = -1  # piece of a scan that has no pose

# Of one window, whichever is reached first. Measured, an estimate takes 0.6 kB a return: a quarter of a GB at most.
_SCANS, _RETURNS = 240, 400_000
_LEAST_SCANS = 32  # of a dense sensor: fewer scans hardly overlap
_COMMON = 0.25  # share of the scans of a window that are in the next one, too


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
    return moved(first, shares[:, None] * increments(first, second))


@dataclass(frozen=True)
class Window:
    """Consecutive scans of a drive."""

    begin: int
    """Number of the first scan."""
    scans: list[Scan]
    common: int
    """So many of the first ones are also the last ones of the window before."""

    def __str__(self) -> str:
        return f"scans {self.begin} to {self.begin + len(self.scans) - 1}"


def windows(scans: Iterable[Scan]) -> Iterator[Window]:
    """Windows of a drive, of which one is in memory at a time. Each scan is read once."""
    held: list[Scan] = []
    begin = common = returns = 0
    for scan in scans:
        full = len(held) >= _SCANS or (len(held) >= _LEAST_SCANS and returns >= _RETURNS)
        if full and len(held) > common:
            yield Window(begin, held, common)
            common = max(1, round(_COMMON * len(held)))
            begin, held = begin + len(held) - common, held[-common:]
            returns = sum(map(len, held))
        held.append(scan)
        returns += len(scan)
    if held:
        yield Window(begin, held, common)


def refine_in_windows(
    scans: Iterable[Scan], config: FitConfig, progress: bool | None = None
) -> tuple[RefinedPoses, Floats]:
    """As :func:`refine_poses`, in memory that grows by the poses alone; and the given poses (F, 4, 4).

    Each window has a verdict of its own: where it says keep, the given steps are kept. Loops are closed within windows.

    Raises
    ------
    ValueError
        If there are no scans, or one is invalid.
    """
    begin_s = time.perf_counter()
    answers: list[RefinedPoses] = []
    given: list[Floats] = []
    joined = JoinedPoses()
    for window, whole in _read(scans, None, "refine", progress):
        with _named(window):
            answer = refine_poses(whole, config=config, progress=False)
        joined.add(window.begin, answer.poses, answer.covariance)
        given.append(whole.poses[window.common :])
        answers.append(answer)
    before = np.concatenate(given)
    if len(answers) == 1:
        return answers[0], before
    better = [answer for answer in answers if answer.improved]
    poses = aligned(joined.poses, before) if better else before
    report = {
        "verdict": _verdict(len(better), len(answers)),
        "windows": [answer.improved for answer in answers],
        **{
            name: float(np.median([answer.report[name] for answer in better]))
            for name in ("sigma_m", "sigma_rad")
            if better
        },
        **moved_by(before, poses),
        "notes": _once(answer.report.get("notes", []) for answer in answers),
        "scans": len(poses),
        "seconds": time.perf_counter() - begin_s,
    }
    return RefinedPoses(poses, joined.covariance, bool(better), report), before


def find_in_windows(
    scans: Iterable[Scan], imu: Imu | None, config: FitConfig, progress: bool | None = None
) -> Odometry:
    """As :func:`odometry`, in memory that grows by the poses alone. Poses of the scans are not used.

    Scans of a window in which nothing measures how the sensor moved have no poses: each of them is a piece.

    Raises
    ------
    ValueError
        If a scan is invalid, or there is no other window.
    """
    begin_s = time.perf_counter()
    answers: list[Odometry] = []
    notes: list[list[str]] = []
    refused = None
    joined = JoinedPoses()
    for window, whole in _read(scans, imu, "find poses", progress):
        try:
            with _named(window):
                found = odometry(whole, config=config, progress=False)
        except NotToldError as why:
            refused = refused or why
            notes.append([f"There are no poses of the {window}: {why}"])
            joined.skip(window.begin, len(whole.points))
            continue
        upright = found.report["imu"] is not None
        joined.add(window.begin, found.poses, found.covariance, found.pieces, found.agreeing, upright=upright)
        answers.append(found)
        notes.append(found.report["notes"])
    if not answers and refused is not None:
        raise refused
    if len(answers) == 1 and refused is None:
        return answers[0]
    pieces, reports = joined.pieces, [found.report for found in answers]
    count, lengths_m = int(pieces[-1]) + 1, np.linalg.norm(steps(joined.poses)[:, :3, 3], axis=1)
    length_m = float(lengths_m[np.diff(pieces) == 0].sum())
    words = f"{len(pieces)} scans along {length_m:.1f} m were placed, in {len(answers)} windows of scans."
    if count > 1:
        words += f" {count} pieces do not belong together; the longest has {np.bincount(pieces).max()} scans."
    report = {
        "verdict": words,
        "length_m": length_m,
        "pieces": count,
        "doppler": any(of_window["doppler"] for of_window in reports),
        "doppler_sign": reports[0]["doppler_sign"],
        "gyroscope": any(of_window["gyroscope"] for of_window in reports),
        "imu": next((of_window["imu"] for of_window in reports if of_window["imu"] is not None), None),
        "notes": _once(notes),
        "scans": len(pieces),
        "seconds": time.perf_counter() - begin_s,
    }
    return Odometry(joined.poses, joined.covariance, pieces, joined.agreeing, report)


def _read(
    scans: Iterable[Scan], imu: Imu | None, description: str, progress: bool | None
) -> Iterator[tuple[Window, Scans]]:
    """Each window, in memory. Raises a ValueError if there is none."""
    window = None
    with tqdm(desc=description, unit="scan", disable=hides_bar(progress)) as bar:
        for window in windows(scans):
            yield window, scans_in_memory(window.scans, imu)
            bar.update(len(window.scans) - window.common)
    if window is None:
        msg = "there are no scans"
        raise ValueError(msg)


@contextmanager
def _named(window: Window) -> Iterator[None]:
    """Errors name their window: they number its scans from its first one."""
    try:
        yield
    except NotToldError:
        raise
    except ValueError as error:
        if window.begin == 0:
            raise
        msg = f"{window}, numbered from the first of them: {error}"
        raise ValueError(msg) from error


def _once(notes: Iterable[Iterable[str]]) -> list[str]:
    return list(dict.fromkeys(itertools.chain.from_iterable(notes)))


def _verdict(better: int, count: int) -> str:
    if better == 0:
        return f"The given poses are kept: in none of {count} windows of scans do returns that took no part agree better with those of other scans."
    kept = "" if better == count else " In the others, the given steps are kept."
    return f"The refined poses make a sharper map in {better} of {count} windows of scans: returns that took no part agree better with those of other scans.{kept}"
