# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Text files of numbers, as programs write them: one way to read them, in which no line is lost without a word."""

from __future__ import annotations

import codecs
import itertools
import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from radarsdf.io.files import are_numbers

# Of UTF-32 before UTF-16, whose mark is the beginning of the other's.
_MARKS = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
COMMENTS = ("#", "//", "%")
"""Signs after which the rest of a line is a comment."""
_COMMENT = re.compile("(" + "|".join(COMMENTS) + ").*")
_DECIMAL_COMMA = r"[+-]?\d+,\d+(?:[eE][+-]?\d+)?"
_IN_CELL = re.compile(rf"(?:^|;)[ \t]*{_DECIMAL_COMMA}(?=[ \t]*(?:;|$))", re.MULTILINE)


def read_text(path: Path) -> str:
    """The text of a file, with a line feed after each line.

    It is in UTF-8, or in another encoding of Unicode that a byte order mark names, which is left out. What does not
    decode, such as a comment in Latin-1, becomes replacement characters. Lines may end as those of any system.
    """
    data = path.read_bytes()
    encoding = next((encoding for mark, encoding in _MARKS if data.startswith(mark)), "utf-8")
    return data.decode(encoding, errors="replace").replace("\r\n", "\n").replace("\r", "\n")


def with_points(text: str) -> str:
    """The same numbers with decimal points, if there are decimal commas: then semicolons separate numbers."""
    bare = map(without_comment, text.split("\n"))
    rows = list(itertools.islice(filter(None, bare), 2))  # a line of names, and one of numbers
    if any(";" in row for row in rows):
        return _IN_CELL.sub(lambda cell: cell[0].replace(",", "."), text)
    for words in map(str.split, rows):
        if len(words) > 1 and all(re.fullmatch(_DECIMAL_COMMA, word) for word in words):
            msg = "it has decimal commas between spaces: write decimal points, or semicolons between the numbers"
            raise ValueError(msg)
    return text


def without_comment(line: str) -> str:
    """A line without a comment, and without white space at its ends."""
    return _COMMENT.sub("", line).strip()


def check_header(words: list[str]) -> None:
    """Raises a ValueError if the words above numbers are no names, but a row of numbers with something else in it."""
    number = next((word for word in words if are_numbers([word])), None)
    if number is not None:
        wrong = next(word for word in words if not are_numbers([word]))
        msg = f"its first line has the number {number:.50} and {wrong!r:.50}, which is none"
        raise ValueError(msg)


def separator_of(line: str) -> str | None:
    """What separates the words of a line; None: white space."""
    return next((sign for sign in (";", ",", "\t") if sign in line), None)


def words_of(line: str) -> list[str]:
    """The words of a line, separated by commas, semicolons, tabs or else white space."""
    separator = separator_of(line)
    line = line if separator else re.sub(r"\s+(?=[\[(])", "", line)  # a unit belongs to its name
    return [word.strip().strip('"') for word in line.split(separator)]


def text_rows(path: Path) -> tuple[list[list[str]], list[tuple[int, list[str]]]]:
    """What may be the names of columns in a text file, and its rows with the numbers of their lines, from 1.

    Names are above the rows: comments after ``#``, ``//`` or ``%``, or a line without a number. Words of a row are
    separated by commas, semicolons or white space. Other comments and blank lines are left out.
    """
    heads: list[list[str]] = []
    rows: list[tuple[int, list[str]]] = []
    named = False
    for number, line in enumerate(with_points(read_text(path)).split("\n"), 1):
        bare = without_comment(line)
        if bare:
            words = re.split(r"\s*[,;]\s*|\s+", bare.rstrip(",; \t"))
            if rows or named or any(are_numbers([word]) for word in words):
                rows.append((number, words))
                continue
            named = True
        if line.strip() and not rows:
            heads.append(words_of((bare or line.strip().lstrip("/#% ")).rstrip(",; \t")))
    return heads, rows


def number_rows(path: Path) -> list[list[str]]:
    """The rows of a text file of numbers, without names above them; see :func:`text_rows`."""
    _, rows = text_rows(path)
    for number, words in rows:
        if not are_numbers(words):
            if number == rows[0][0]:
                check_header(words)
            wrong = next(word for word in words if not are_numbers([word]))
            msg = f"line {number} has {wrong!r:.50} where a number must be"
            raise ValueError(msg)
        if len(words) != len(rows[0][1]):
            msg = f"line {number} has {len(words)} numbers, and lines before it have {len(rows[0][1])}"
            raise ValueError(msg)
    return [words for _, words in rows]


def numbers_of(rows: list[tuple[int, list[str]]], width: int) -> NDArray[np.float64]:
    """(R, width) the numbers of rows; NaN for a word that is none, and in a row of another width."""
    table = np.full((len(rows), width), np.nan)
    for values, (_, words) in zip(table, rows, strict=True):
        if len(words) == width:
            try:
                values[:] = [float(word) for word in words]
            except ValueError:
                values[:] = [float(word) if are_numbers([word]) else np.nan for word in words]
    return table
