# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Files ``.bin`` of bare numbers: how many make a return, and of which type, by the content of several files."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtrc

_TYPES = ("<f4", "<f8")
_WIDTHS = range(3, 21)
_MAX_FILES, _MAX_NUMBERS = 20, 100_000  # that are judged, and of each file
_MAX_POSITION_M, _SMALLEST, _LARGEST = 1e7, 1e-20, 1e12  # other numbers are bytes of another type
_PLAUSIBLE = 0.98
_CHANCE = 1e-6
_LITTLE = 0.9  # of the variance that is left: more columns must explain more
_PREFERRED = 30  # times as probable by chance as another layout, KITTI's is still taken


class BinLayout(NamedTuple):
    """What a return is in a file of bare numbers."""

    dtype: str
    width: int


KITTI = BinLayout("<f4", 4)
"""x, y, z, intensity."""


def bin_layout(paths: Sequence[Path], width: int | None = None) -> BinLayout:
    """The layout of files of one recording, each return of which has `width` numbers, if that is known.

    A number explains most of its variance by its column where the width is right, and none where it is wrong. KITTI's
    four float32 are taken where the content does not decide.

    Raises
    ------
    ValueError
        If no layout is plausible, or several are.
    OSError
        If a file cannot be read.
    """
    rows = np.unique(np.linspace(0, len(paths) - 1, min(len(paths), _MAX_FILES)).astype(int))
    chosen = [path for path in (paths[i] for i in rows) if path.stat().st_size]
    kitti = KITTI if width is None else BinLayout("<f4", width)
    if not chosen:
        return kitti
    chances: dict[BinLayout, float] = {}
    for dtype in _TYPES:
        fitting: dict[int, list[Path]] = {}
        for columns in _WIDTHS if width is None else [width]:
            fitting[columns] = [
                path for path in chosen if path.stat().st_size % (columns * int(dtype[2])) == 0
            ]
        most = max(map(len, fitting.values()))  # all but files that are cut off
        spreads = {}
        for columns, whole in fitting.items():
            if len(whole) == most and 2 * most > len(chosen):
                count = _MAX_NUMBERS // columns * columns
                table = np.concatenate(
                    [np.fromfile(path, dtype, count).reshape(-1, columns) for path in whole]
                )
                if _are_returns(table):
                    spreads[BinLayout(dtype, columns)] = _Spread.of(table)
        if spreads and width is not None:
            return next(iter(spreads))
        if spreads:
            best = min(spreads, key=lambda layout: spreads[layout].variance)
            for (
                layout,
                spread,
            ) in spreads.items():  # every second return may differ, as of two lasers by turns
                little = (
                    spreads[best].variance > _LITTLE * spread.variance
                    or spreads[best].chance(spread) > _CHANCE
                )
                if best.width % layout.width == 0 and little:
                    best = layout
                    break
            if spreads[best].chance() < _CHANCE:
                return best
            chances |= {layout: spread.chance() for layout, spread in spreads.items()}
    if width is not None or (kitti in chances and chances[kitti] <= _PREFERRED * min(chances.values())):
        return kitti
    found = " or ".join(f"{layout.width} x float{8 * int(layout.dtype[2])}" for layout in chances)
    msg = (
        f"the content does not tell how many numbers a return has, {found}: say by columns (--columns) how many, or their names"
        if found
        else "its size is no whole number of points of 4 float32 each, or its numbers are no positions in m: say by columns "
        "(--columns) how many there are, or their names"
    )
    raise ValueError(msg)


def read_bin(
    path: Path, columns: BinLayout | int | Sequence[str] | None, names_of: Callable[[int, Any], list[str]]
) -> dict[str, NDArray[Any]]:
    """The columns of a file, whose names `names_of` gives by their number."""
    names = None if columns is None or isinstance(columns, (int, BinLayout)) else list(columns)
    if not isinstance(columns, BinLayout):
        width = len(names) if names is not None else columns if isinstance(columns, int) else None
        columns = bin_layout([path], width)
    size, row_bytes = path.stat().st_size, columns.width * int(columns.dtype[2])
    if size % row_bytes:
        msg = (
            f"its {size} bytes are no whole number of points of {columns.width} float{8 * int(columns.dtype[2])} each: "
            "say by columns (--columns) how many there are, or their names"
        )
        raise ValueError(msg)
    table = np.fromfile(path, columns.dtype).reshape(-1, columns.width)
    return dict(zip(names_of(columns.width, names), table.T, strict=True))


def _are_returns(table: NDArray[Any]) -> bool:
    """Whether rows may be x, y, z and other numbers: no other type of number read as this one."""
    with np.errstate(invalid="ignore"):
        size = np.abs(table)
        fitting = (size == 0) | ((size >= _SMALLEST) & (size <= _LARGEST))
        fitting[:, :3] &= size[:, :3] <= _MAX_POSITION_M
    finite = np.isfinite(table)
    return bool(
        fitting[finite].mean() >= _PLAUSIBLE and finite.mean() > 0.5 and table[:, :2].any(axis=0).all()
    )


class _Spread(NamedTuple):
    """How numbers vary within columns."""

    variance: float
    """Unbiased."""
    total: float
    """Sum of squared deviations from the mean of all."""
    size: int
    width: int

    @classmethod
    def of(cls, table: NDArray[Any]) -> _Spread:
        table = table.astype(np.float64)
        logs = np.sign(table) * np.log1p(np.abs(table))  # so that no column has all of the variance
        logs = logs[np.isfinite(logs).all(axis=1)]
        rest = logs.size - table.shape[1]
        within = logs.var(axis=0).sum() * len(logs) / rest if rest > 0 else np.inf
        return cls(float(within), float(logs.var() * logs.size), logs.size, table.shape[1])

    def chance(self, other: _Spread | None = None) -> float:
        """The probability that these columns explain so much more than others, a part of them, or than a single one."""
        width, total = (
            (1, self.total) if other is None else (other.width, other.variance * (self.size - other.width))
        )
        if not np.isfinite(self.variance) or width == self.width:
            return 1.0
        more = total - self.variance * (self.size - self.width)
        ratio = more / (self.width - width) / max(self.variance, 1e-12 * self.total / self.size, 1e-300)
        return float(fdtrc(self.width - width, self.size - self.width, max(ratio, 0.0)))
