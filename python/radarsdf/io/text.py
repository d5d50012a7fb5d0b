# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Tables of numbers in text files, in which no line is lost silently, and the units of their columns."""

from __future__ import annotations

import codecs
import contextlib
import itertools
import re
from bisect import bisect
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from radarsdf.io.files import reading
from radarsdf.io.scans import Notes

# Of UTF-32 before UTF-16, whose mark is the beginning of the other's.
_MARKS = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
_COMMENTS = ("#", "//", "%")
_COMMENT = re.compile("(" + "|".join(_COMMENTS) + ").*")
_DECIMAL_COMMA = r"[+-]?\d+,\d+(?:[eE][+-]?\d+)?"
_IN_CELL = re.compile(rf"(?:^|;)[ \t]*{_DECIMAL_COMMA}(?=[ \t]*(?:;|$))", re.MULTILINE)

SCALES = {"mm": 1e-3, "cm": 1e-2, "km": 1e3, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9, "mrad": 1e-3,
          **dict.fromkeys(("km/h", "kmh", "kph"), 1 / 3.6),
          **dict.fromkeys(("deg", "degree", "degrees", "°"), np.pi / 180)}  # fmt: skip
"""Units in names of columns, in m, s, m/s or rad."""

_UNIT = re.compile(
    r"[\s_]+(m|cm|mm|km|s|ms|us|ns|rad|mrad|radians?|deg|degrees?|mps|kmh|kph|dbs?m?|linear)$|[\s_]*[\[(]([^\])]*)[\])]$"
)
_SINCE_1970 = (("s", 1.0), ("ms", 1e-3), ("µs", 1e-6), ("ns", 1e-9))
_LIMITS = (1e11, 1e14, 1e17)  # of the absolute times since 1970, from one of these units to the next
_BEYOND = 1.05  # angles that exceed a limit by rounding
_STEPS, _ENOUGH = 4, 30  # parts of a degree, and angles that lie in such steps not by chance


class Table(NamedTuple):
    """The R rows of numbers of a text file."""

    header: list[str] | None
    """Names of columns: the words of the line above the rows, if that has no number and is no comment."""
    heads: list[list[str]]
    """The words of all lines above the rows, comments too: one of them may name the columns."""
    values: NDArray[np.float64]
    """(R, W). NaN for a word that is no number, and in a row of another width."""
    lines: list[int]
    """Number of the line of each row, from 1."""


def read_table(path: Path) -> Table:
    """Reads a text file with a row of numbers a line, separated by commas, semicolons, tabs or spaces.

    Comments begin with ``#``, ``//`` or ``%``; decimal commas are read where semicolons separate the numbers. The first
    line with a number is the first row. Raises a ValueError if most rows have words that are no numbers.
    """
    header: list[str] | None = None
    heads: list[list[str]] = []
    rows: list[str] = []
    numbers: list[int] = []
    for number, line in enumerate(_with_points(read_text(path)).split("\n"), 1):
        if rows:
            if line and not line.isspace() and not line.lstrip().startswith(_COMMENTS):
                rows.append(line)
                numbers.append(number)
            continue
        bare = _without_comment(line)
        words = _words_of((bare or line.strip().lstrip("/#% ")).rstrip(",; \t"))
        if bare and (header is not None or any(map(_is_number, words))):
            rows, numbers = [line], [number]
            continue
        if bare:
            header = words
        if line.strip():
            heads.append(words)
    if not rows:
        return Table(header, heads, np.zeros((0, len(header or ()))), [])
    return Table(header, heads, _values(rows, numbers, header), numbers)


def _values(texts: list[str], lines: list[int], header: list[str] | None) -> NDArray[np.float64]:
    """(R, W) the numbers in the lines of the rows, by NumPy at once or else, where some are damaged, row by row."""
    separator = next((sign for sign in (";", ",", "\t") if sign in _without_comment(texts[0])), None)
    with contextlib.suppress(ValueError):
        table: NDArray[np.float64] = np.loadtxt(texts, delimiter=separator, comments=_COMMENTS, ndmin=2)
        return table
    words = [re.split(r"\s*[,;]\s*|\s+", _without_comment(text).rstrip(",; \t")) for text in texts]
    width = len(header) if header else Counter(map(len, words)).most_common(1)[0][0]
    table = np.full((len(words), width), np.nan)
    known = np.zeros(table.shape, bool)
    for row, parts in enumerate(words):
        if len(parts) == width:
            known[row] = [_is_number(part) for part in parts]
            table[row, known[row]] = [float(part) for part in parts if _is_number(part)]
    of_words = ~known.any(axis=0)  # a column of labels is no damage
    damaged = ~known[:, ~of_words].all(axis=1)
    if of_words.all() or 2 * damaged.sum() > len(words):
        first = int(np.argmax(damaged))
        msg = f"line {lines[first]} is no row of {width} numbers: {texts[first].strip()!r:.50}"
        raise ValueError(msg)
    return table


def read_numbers(path: Path, columns: int | None = None) -> NDArray[np.float64]:
    """(R, columns) finite numbers of a text file; None: as many as it has. Raises a ValueError that names the line."""
    with reading(path, f"a table of {columns or 'any number of'} columns of numbers"):
        table = read_table(path)
        bad = ~np.isfinite(table.values).all(axis=1)
        if bad.any():
            msg = f"line {table.lines[int(np.argmax(bad))]} is not finite numbers, as many as in other lines"
            raise ValueError(msg)
        if columns not in (None, table.values.shape[1]):
            msg = f"it has {table.values.shape[1]}"
            raise ValueError(msg)
    return table.values


def read_text(path: Path) -> str:
    """The text of a file with line feeds, in UTF-8 or the encoding that a byte order mark names.

    What does not decode, such as a comment in Latin-1, becomes replacement characters.
    """
    data = path.read_bytes()
    encoding = next((encoding for mark, encoding in _MARKS if data.startswith(mark)), "utf-8")
    return data.decode(encoding, errors="replace").replace("\r\n", "\n").replace("\r", "\n")


def _with_points(text: str) -> str:
    """The same numbers with decimal points, if there are decimal commas: then semicolons separate numbers."""
    bare = map(_without_comment, text.split("\n"))
    rows = list(itertools.islice(filter(None, bare), 2))  # a line of names, and one of numbers
    if any(";" in row for row in rows):
        return _IN_CELL.sub(lambda cell: cell[0].replace(",", "."), text)
    for words in map(str.split, rows):
        if len(words) > 1 and all(re.fullmatch(_DECIMAL_COMMA, word) for word in words):
            msg = "it has decimal commas between spaces: write decimal points, or semicolons between the numbers"
            raise ValueError(msg)
    return text


def _without_comment(line: str) -> str:
    return _COMMENT.sub("", line).strip()


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _words_of(line: str) -> list[str]:
    """The words of a line, separated by commas, semicolons, tabs or else white space."""
    separator = next((sign for sign in (";", ",", "\t") if sign in line), None)
    line = line if separator else re.sub(r"\s+(?=[\[(])", "", line)  # a unit belongs to its name
    return [word.strip().strip('"') for word in line.split(separator)]


def without_unit(name: str) -> tuple[str, str]:
    """The name of a column in lower case without its unit, and the unit: of ``azimuth_deg``, ``x [m]``, ``time(ns)``."""
    name = name.strip().lower()
    found = _UNIT.search(name)
    if found is None or not found.start():
        return name, ""
    return name[: found.start()], found[1] if found[1] is not None else found[2].strip()


def unit_since_1970(time: float) -> tuple[str, float]:
    """The unit of a time since 1970 and its length, s."""
    return _SINCE_1970[bisect(_LIMITS, abs(time))]


def in_seconds(times: NDArray[np.float64], name: str, notes: Notes) -> NDArray[np.float64]:
    """Times (N,) of the file `name`, s. They may be in ms, µs or ns since 1970, which is noted."""
    if not np.isfinite(times).all():
        msg = f"{name} holds a time that is not finite"
        raise ValueError(msg)
    units = {unit_since_1970(time) for time in times[times != 0].tolist()}
    if len(units) > 1:
        msg = f"{name} holds times of different units, such as s and ns"
        raise ValueError(msg)
    ((unit, scale),) = units or {_SINCE_1970[0]}
    if unit != "s":
        notes.add(f"times of {name} are taken as {unit} since 1970")
    return times * scale


def are_degrees(azimuth: NDArray[Any], elevation: NDArray[Any], unit: str = "") -> bool:
    """Whether angles (N,) are in degrees: by the unit in their names, or else by their numbers.

    In degrees are numbers beyond what rad can be, or in steps that only degrees have.
    """
    if unit:
        return SCALES.get(unit) == SCALES["deg"]
    finite = np.isfinite(azimuth) & np.isfinite(elevation)
    if not finite.any():
        return False
    azimuth, elevation = azimuth[finite], elevation[finite]
    largest, highest = (np.quantile(np.abs(angles), 0.99) / np.pi for angles in (azimuth, elevation))
    if highest > _BEYOND / 2 or largest > 2 * _BEYOND:
        return True
    if largest > _BEYOND:  # rad from 0 to a whole turn have no other sign
        return bool(azimuth.min() < 0)
    steps = azimuth * _STEPS
    return bool(len(steps) >= _ENOUGH and steps.any() and (steps == np.round(steps)).all())
