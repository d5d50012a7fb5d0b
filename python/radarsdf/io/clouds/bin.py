# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Files ``.bin`` of bare numbers: how many make a return, and of which type, by the content of several files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtrc

from radarsdf.io.clouds.fields import names_of

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

    def __str__(self) -> str:
        """Such as 5 x float32."""
        return f"{self.width} x {np.dtype(self.dtype).name}"


KITTI = BinLayout("<f4", 4)
"""x, y, z, intensity."""


def bin_layout(paths: Sequence[Path], width: int | None = None) -> BinLayout:
    """The layout of files of one recording, each return of which has `width` numbers, if that is known.

    A number explains most of its variance by its column where the width is right, and none where it is wrong. KITTI's
    four float32 are taken where the content does not decide. Raises a ValueError if no layout is plausible, or several are.
    """
    rows = np.unique(np.linspace(0, len(paths) - 1, min(len(paths), _MAX_FILES)).astype(int))
    chosen = [path for path in (paths[i] for i in rows) if path.stat().st_size]
    if not chosen:
        return KITTI if width is None else BinLayout("<f4", width)
    chances: dict[BinLayout, float] = {}
    for dtype in _TYPES:
        tables = _tables(chosen, dtype, _WIDTHS if width is None else [width])
        if width is not None and (tables or dtype == _TYPES[-1]):
            return BinLayout(dtype if tables else "<f4", width)
        if not tables:
            continue
        left = {columns: _variance(table) for columns, table in tables.items()}
        best = min(left, key=lambda columns: left[columns])
        for columns in tables:  # every second return may differ, as of two lasers by turns
            little = left[best] > _LITTLE * left[columns] or _chance(tables[best], columns) > _CHANCE
            if best % columns == 0 and little:
                best = columns
                break
        if _chance(tables[best]) < _CHANCE:
            return BinLayout(dtype, best)
        chances |= {BinLayout(dtype, columns): _chance(table) for columns, table in tables.items()}
    if KITTI in chances and chances[KITTI] <= _PREFERRED * min(chances.values()):
        return KITTI
    why = "its size is no whole number of points of 4 float32 each, or its numbers are no positions in m"
    if chances:
        why = f"the content does not decide how many numbers a return has, {' or '.join(map(str, chances))}"
    msg = f"{why}: give columns (--columns), their number or their names"
    raise ValueError(msg)


def read_bin(path: Path, columns: BinLayout | int | Sequence[str] | None) -> dict[str, NDArray[Any]]:
    """The columns of a file by name."""
    names = None if columns is None or isinstance(columns, (int, BinLayout)) else list(columns)
    if not isinstance(columns, BinLayout):
        columns = bin_layout([path], len(names) if names is not None else columns)  # type: ignore[arg-type]
    size = path.stat().st_size
    if size % (columns.width * np.dtype(columns.dtype).itemsize):
        msg = (
            f"its {size} bytes are no whole number of points of {columns.width} {np.dtype(columns.dtype).name} each: "
            "give columns (--columns), their number or their names"
        )
        raise ValueError(msg)
    table = np.fromfile(path, columns.dtype).reshape(-1, columns.width)
    return dict(zip(names_of(columns.width, names), table.T, strict=True))


def _tables(paths: list[Path], dtype: str, widths: Sequence[int]) -> dict[int, NDArray[np.float64]]:
    """The logarithms of numbers by the plausible widths, of all files but those that are cut off."""
    itemsize = np.dtype(dtype).itemsize
    fitting = {width: [p for p in paths if p.stat().st_size % (width * itemsize) == 0] for width in widths}
    most = max(map(len, fitting.values()))
    tables = {}
    for width, whole in fitting.items() if 2 * most > len(paths) else ():
        if len(whole) == most:
            numbers = [np.fromfile(path, dtype, _MAX_NUMBERS // width * width) for path in whole]
            with np.errstate(invalid="ignore"):  # bytes of another type
                table = np.concatenate(numbers).reshape(-1, width).astype(np.float64)
            if _are_returns(table):
                table = table[np.isfinite(table).all(axis=1)]
                # Logarithms, so that no column has all of the variance.
                tables[width] = np.sign(table) * np.log1p(np.abs(table))
    return tables


def _are_returns(table: NDArray[np.float64]) -> bool:
    """Whether rows may be x, y, z and other numbers: no other type of number read as this one."""
    size = np.abs(table)
    fitting = (size == 0) | ((size >= _SMALLEST) & (size <= _LARGEST))
    fitting[:, :3] &= size[:, :3] <= _MAX_POSITION_M
    finite = np.isfinite(table)
    return bool(
        fitting[finite].mean() >= _PLAUSIBLE and finite.mean() > 0.5 and table[:, :2].any(axis=0).all()
    )


def _variance(table: NDArray[np.float64]) -> float:
    """Within columns, unbiased."""
    rest = table.size - table.shape[1]
    return float(table.var(axis=0).sum()) * len(table) / rest if rest > 0 else np.inf


def _chance(table: NDArray[np.float64], width: int = 1) -> float:
    """The probability that columns explain so much more than those of a smaller `width`, or than a single one."""
    more, rest = table.shape[1] - width, table.size - table.shape[1]
    if more == 0 or rest <= 0 or table.shape[1] % width:
        return 1.0
    within = table.var(axis=0).sum() * len(table)
    total = table.reshape(-1, width).var(axis=0).sum() * table.size / width
    noise = max(within / rest, 1e-12 * table.var(), 1e-300)
    return float(fdtrc(more, rest, max(total - within, 0.0) / more / noise))
