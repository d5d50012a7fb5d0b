# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Poses of drives of any length: of windows of scans, which are joined by the scans that they have in common."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from radarsdf.config.fit_config import FitConfig
from radarsdf.io.imu import Imu
from radarsdf.io.scans import Scan, Scans, scans_in_memory
from radarsdf.poses.joining import JoinedPoses
from radarsdf.poses.odometry import NotToldError, Odometry, odometry
from radarsdf.poses.refine import RefinedPoses, refine_poses
from radarsdf.poses.rigid import Floats, aligned, moved_by, steps
from radarsdf.progress import hides_bar

# Of one window, whichever is reached first. Measured, an estimate takes 0.6 kB a return: a quarter of a GB at most.
_SCANS, _RETURNS = 240, 400_000
_LEAST_SCANS = 32  # of a dense sensor: fewer scans hardly overlap
_COMMON = 0.25  # share of the scans of a window that are in the next one, too


@dataclass(frozen=True)
class Window:
    """Consecutive scans of a drive."""

    begin: int
    """Number of the first scan."""
    scans: list[Scan]
    common: int
    """So many of the first ones are also the last ones of the window before."""

    def whole(self, imu: Imu | None) -> Scans:
        """In memory, with what all of them have."""
        return scans_in_memory(self.scans, imu)

    @property
    def words(self) -> str:
        """For messages."""
        return f"scans {self.begin} to {self.begin + len(self.scans) - 1}"


def windows(scans: Iterable[Scan]) -> Iterator[Window]:
    """Windows of a drive, of which one is in memory at a time. Each scan is read once."""
    held: list[Scan] = []
    begin = common = returns = 0
    for scan in scans:
        if len(held) > common and (
            len(held) >= _SCANS or (len(held) >= _LEAST_SCANS and returns >= _RETURNS)
        ):
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
    _refuse_none(answers)
    before = np.concatenate(given)
    if len(answers) == 1:
        return answers[0], before
    better = [answer for answer in answers if answer.improved]
    poses = aligned(joined.poses, before) if better else before
    of_steps = {
        name: float(np.median([answer.report[name] for answer in better]))
        for name in ("sigma_m", "sigma_rad")
        if better
    }
    report = {
        "verdict": _verdict(len(better), len(answers)),
        "windows": [answer.improved for answer in answers],
        **of_steps,
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

    Scans of a window in which nothing tells how the sensor moved have no poses: each of them is a piece.

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
            notes.append([f"There are no poses of the {window.words}: {why}"])
            joined.skip(window.begin, len(whole.points))
            continue
        joined.add(
            window.begin,
            found.poses,
            found.covariance,
            found.pieces,
            found.agreeing,
            upright=found.report["imu"] is not None,
        )
        answers.append(found)
        notes.append(found.report["notes"])
    if not answers and refused is not None:
        raise refused
    _refuse_none(answers)
    if len(answers) == 1 and refused is None:
        return answers[0]
    pieces = joined.pieces
    between_scans = np.linalg.norm(steps(joined.poses)[:, :3, 3], axis=1)
    length_m = float(between_scans[np.diff(pieces) == 0].sum())
    imus = [found.report["imu"] for found in answers if found.report["imu"] is not None]
    report = {
        "verdict": _words(pieces, length_m, len(answers)),
        "length_m": length_m,
        "pieces": int(pieces[-1]) + 1,
        "doppler": any(found.report["doppler"] for found in answers),
        "doppler_sign": answers[0].report["doppler_sign"],
        "gyroscope": any(found.report["gyroscope"] for found in answers),
        "imu": imus[0] if imus else None,
        "notes": _once(notes),
        "scans": len(pieces),
        "seconds": time.perf_counter() - begin_s,
    }
    return Odometry(joined.poses, joined.covariance, pieces, joined.agreeing, report)


def _read(
    scans: Iterable[Scan], imu: Imu | None, description: str, progress: bool | None
) -> Iterator[tuple[Window, Scans]]:
    """Each window, in memory."""
    with tqdm(desc=description, unit="scan", disable=hides_bar(progress)) as bar:
        for window in windows(scans):
            yield window, window.whole(imu)
            bar.update(len(window.scans) - window.common)


@contextmanager
def _named(window: Window) -> Iterator[None]:
    """Errors say of which window they are: they number its scans from its first one."""
    try:
        yield
    except NotToldError:
        raise
    except ValueError as error:
        if window.begin == 0:
            raise
        msg = f"{window.words}, numbered from the first of them: {error}"
        raise ValueError(msg) from error


def _refuse_none(answers: Sequence[object]) -> None:
    if not answers:
        msg = "there are no scans"
        raise ValueError(msg)


def _once(notes: Iterable[Iterable[str]]) -> list[str]:
    return list(dict.fromkeys(itertools.chain.from_iterable(notes)))


def _verdict(better: int, count: int) -> str:
    if better == 0:
        return f"The given poses are kept: in none of {count} windows of scans do returns that took no part agree better with those of other scans."
    kept = "" if better == count else " In the others, the given steps are kept."
    return f"The refined poses make a sharper map in {better} of {count} windows of scans: returns that took no part agree better with those of other scans.{kept}"


def _words(pieces: NDArray[np.int64], length_m: float, count: int) -> str:
    whole = f"{len(pieces)} scans along {length_m:.1f} m were placed, in {count} windows of scans."
    if pieces[-1] == 0:
        return whole
    return f"{whole} {int(pieces[-1]) + 1} pieces do not belong together; the longest has {int(np.bincount(pieces).max())} scans."
