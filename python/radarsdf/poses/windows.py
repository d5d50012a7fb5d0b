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

from radarsdf.config.fit_config import FitConfig
from radarsdf.io.imu import Imu
from radarsdf.io.scans import Scan, Scans, scans_in_memory
from radarsdf.poses.odometry import Odometry, UnobservedMotionError, odometry, trajectory_length_m
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
)
from radarsdf.progress import hides_bar

_NOWHERE = -1  # piece of a scan that has no pose

# Of one window, whichever is reached first. Measured, an estimate takes 0.6 kB a return: a quarter of a GB at most.
_SCANS, _RETURNS = 240, 400_000
_LEAST_SCANS = 32  # of a dense sensor: fewer scans hardly overlap
_COMMON = 0.25  # share of the scans of a window that are in the next one, too


class JoinedPoses:
    """Takes the poses of one window after another. The world is that of the first."""

    def __init__(self) -> None:
        self.poses: Floats = np.zeros((0, 4, 4))  # T_world_sensor, m
        self.covariance: Floats = np.zeros((0, 6, 6))  # relative to the scan in the middle of its window
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
        poses, nowhere = np.repeat(last, new, axis=0), np.full(new, _NOWHERE)
        self._replace(len(self.poses), poses, np.zeros((new, 6, 6)), nowhere)

    def add(
        self,
        begin: int,
        poses: Floats,
        covariance: Floats,
        pieces: NDArray[np.int64] | None = None,
        *,
        upright: bool = False,
    ) -> None:
        """A window of poses (K, 4, 4) from number `begin` on, in a world of its own.

        `upright`: the z axis of that world points up. Between two such windows, no tilt adds up.
        """
        pieces = np.zeros(len(poses), np.int64) if pieces is None else pieces
        common = len(self.poses) - begin
        piece = self._pieces[-1] if common else _NOWHERE
        if piece == _NOWHERE:
            # Nothing joins it to those before. It begins where the last scan before was.
            T = placed(np.eye(4), poses[:1], self.poses[begin - 1 : begin]) if begin else np.eye(4)
            pieces = pieces + int(self._pieces[:begin].max(initial=_NOWHERE)) + 1
            self._upright, first = upright, 0
        else:
            same = (self._pieces[begin:] == piece) & (pieces[:common] == pieces[common - 1])
            first = common - int(same[::-1].cumprod().sum())  # of those that both have in one piece
            before = self.poses[begin + first :]
            T = alignment(poses[first:common], before)
            if upright and self._upright:
                about_z = np.eye(4)
                angle = np.arctan2(T[1, 0] - T[0, 1], T[0, 0] + T[1, 1])
                about_z[:3, :3] = Rotation.from_euler("z", angle).as_matrix()
                T = placed(about_z, poses[first:common], before)
            pieces = pieces + piece - pieces[common - 1]
        poses, covariance = np.einsum("ij,fjk->fik", T, poses), covariance_in(covariance, T[:3, :3])
        if piece != _NOWHERE:
            # From one window's poses to the other's bit by bit: at its ends, a window knows least.
            shares = np.arange(1, common - first + 1) / (common - first + 1)
            off = increments(before, poses[first:common])
            poses[first:common] = moved(before, shares[:, None] * off)
            sooner = first + int((shares <= 0.5).sum())
            covariance[first:sooner] = self.covariance[begin + first : begin + sooner]
            pieces[first:common] = piece
        self._replace(begin + first, poses[first:], covariance[first:], pieces[first:])

    def _replace(self, begin: int, poses: Floats, covariance: Floats, pieces: NDArray[np.int64]) -> None:
        """All scans from number `begin` on."""
        self.poses = np.concatenate([self.poses[:begin], poses])
        self.covariance = np.concatenate([self.covariance[:begin], covariance])
        self._pieces = np.concatenate([self._pieces[:begin], pieces])


@dataclass(frozen=True)
class Window:
    """Consecutive scans of a drive."""

    begin: int  # number of the first scan
    scans: list[Scan]
    common: int  # number of the first ones that are also the last ones of the window before

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
    """
    begin_s = time.perf_counter()
    answers: list[RefinedPoses] = []
    given: list[Floats] = []
    joined = JoinedPoses()
    for window, whole in _read(scans, None, "refine", progress):
        with _named(window):
            answers.append(refine_poses(whole, config=config, progress=False))
        joined.add(window.begin, answers[-1].poses, answers[-1].covariance)
        given.append(whole.poses[window.common :])
    before = np.concatenate(given)
    if len(answers) == 1:
        return answers[0], before
    better = [answer for answer in answers if answer.improved]
    poses = aligned(joined.poses, before) if better else before
    count = f"{len(better)} of {len(answers)} windows of scans"
    report = {
        "verdict": f"The refined poses make a sharper map in {count}: in the others, the given steps are kept.",
        "windows": [answer.improved for answer in answers],
        **moved_by(before, poses),
        "notes": _once(answer.report["notes"] for answer in answers),
        "scans": len(poses),
        "seconds": time.perf_counter() - begin_s,
    }
    for name in ("sigma_m", "sigma_rad") if better else ():
        report[name] = float(np.median([answer.report[name] for answer in better]))
    return RefinedPoses(poses, joined.covariance, bool(better), report), before


def find_in_windows(
    scans: Iterable[Scan], imu: Imu | None, config: FitConfig, progress: bool | None = None
) -> Odometry:
    """As :func:`odometry`, in memory that grows by the poses alone. Poses of the scans are not used.

    Scans of a window in which nothing measures how the sensor moved have no poses: each of them is a piece.
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
        except UnobservedMotionError as why:
            refused = refused or why
            notes.append([f"There are no poses of the {window}: {why}"])
            joined.skip(window.begin, len(whole.points))
            continue
        upright = found.report["imu"] is not None
        joined.add(window.begin, found.poses, found.covariance, found.pieces, upright=upright)
        answers.append(found)
        notes.append(found.report["notes"])
    if not answers and refused is not None:
        raise refused
    if len(answers) == 1 and refused is None:
        return answers[0]
    pieces = joined.pieces
    length_m = trajectory_length_m(joined.poses, pieces)
    report = {
        **answers[0].report,
        "verdict": f"{len(pieces)} scans along {length_m:.1f} m were placed, in {len(answers)} windows of scans. The longest of "
        f"{pieces[-1] + 1} pieces has {np.bincount(pieces).max()} scans.",
        "length_m": length_m,
        "pieces": int(pieces[-1]) + 1,
        "movers": sum(found.report["movers"] for found in answers),
        "notes": _once(notes),
        "scans": len(pieces),
        "seconds": time.perf_counter() - begin_s,
    }
    return Odometry(joined.poses, joined.covariance, pieces, report)


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
    except UnobservedMotionError:
        raise
    except ValueError as error:
        msg = f"{window}, numbered from the first of them: {error}"
        raise ValueError(msg) from error


def _once(notes: Iterable[Iterable[str]]) -> list[str]:
    return list(dict.fromkeys(itertools.chain.from_iterable(notes)))
