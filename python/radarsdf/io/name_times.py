"""Times in the names of the files of a folder, which are read together: one name alone is ambiguous."""

from __future__ import annotations

import re
from datetime import datetime, timezone
from operator import itemgetter
from typing import Any

import numpy as np

from radarsdf.arrays import Floats
from radarsdf.io.text import unit_since_1970
from radarsdf.scans import Notes

# At the end of a name: a time of day, with or without its date; s and their fraction; s, ms, µs or ns since 1970.
_DATE = re.compile(
    r"(?<!\d)(?:((?:19|20)\d\d)([-_.]?)(\d\d)\2(\d\d)[-_.T ]*)?"
    r"(\d\d)([-_.:]?)(\d\d)\6(\d\d)(?:([-_.,])(\d{1,9})|(\d{3}))?$"
)
_SECONDS = re.compile(r"(?:(\d+)(\.)|(\d{9,10})([-_]))(\d{1,9})$")
_INTEGER = re.compile(r"(?<!\d)[1-9]\d{9,}$")
_LEAST_STEP_S = 1e-3  # no radar scans as fast: numbers that are nearer to each other are indices
_DAY_S = 86_400


def times_in(stems: list[str], notes: Notes) -> list[float] | None:
    """Return the times, s, at the ends of names, and note how they were read; None if names have none, or indices.

    Fractions of varying length are decimals, or ms, µs or ns without leading zeros: of the readings that all names allow,
    the one with the most even steps between the scans is used.
    """
    parts = [part for stem in stems if (part := _split(re.sub(r"\D+$", "", stem)))]
    kinds = {part[0] for part in parts}
    if len(parts) < len(stems) or len(kinds) != 1:
        return None
    whole_s, fractions = np.array([part[1] for part in parts]), [part[3] for part in parts]
    if kinds == {"dates"} and not any(fractions) and (whole_s % _DAY_S < 60).all():
        return None  # 20240501_000007 is the seventh scan of a day, not one of its first minute
    decimal_point = all(part[2] in (".", ",") for part in parts if part[3])
    possible: list[tuple[float, Any, str]] = []  # deviation of the steps from their median, times, text
    for how, fractions_s in _readings(fractions, decimal_point).items():
        times_s = whole_s + fractions_s
        steps_s = np.diff(np.sort(times_s))
        median_s = float(np.median(steps_s)) if len(steps_s) else np.inf
        if median_s > _LEAST_STEP_S * (1 + 1e-4):  # times since 1970 are rounded to 0.2 µs
            deviations = np.abs(steps_s / median_s - 1)
            text = f"{' '.join(kinds)}{how}" + (f", {median_s:.4g} s apart" if len(steps_s) else "")
            if odd := int((deviations > 0.5).sum()):
                text += f" but for {odd} of {len(steps_s)} steps"
            possible.append((float(np.minimum(deviations, 1).sum()), times_s, text))
    if not possible or 10 * len({part[1:] for part in parts}) < 9 * len(stems):  # rounded too far
        return None
    least, times_s, text = min(possible, key=itemgetter(0))
    for cost, others_s, other in possible:
        # A step in a wrong place costs up to 1.
        if cost - least < 1 and (np.abs(others_s - times_s) > _LEAST_STEP_S).any():
            text += f"; undecided: {other} would be as even; rename the files"
    notes.add(f"times in the names of the files: {text}")
    return [float(time_s) for time_s in times_s]


def _split(stem: str) -> tuple[str, float, str, str] | None:
    """Kind and whole seconds of the time at the end of a name, and the separator and digits of its fraction."""
    if (found := _DATE.search(stem)) and (found[1] or found[6]):
        month, day, hour, minute, second = (int(found[i] or 1) for i in (3, 4, 5, 7, 8))
        try:
            date = datetime(int(found[1] or 1970), month, day, hour, minute, second, tzinfo=timezone.utc)
        except ValueError:  # the 31st of February, or minute 61: an index
            return None
        return "dates", date.timestamp(), found[9] or "", found[10] or found[11] or ""
    if found := _SECONDS.search(stem):
        return "seconds", float(found[1] or found[3]), found[2] or found[4], found[5]
    if found := _INTEGER.search(stem):
        return "integers", int(found[0]) * unit_since_1970(int(found[0]))[1], "", ""
    return None


def _readings(fractions: list[str], decimal_point: bool) -> dict[str, Floats]:
    """Possible values of the digits of fractions, s, by what they are."""
    digits = [f for f in fractions if f]
    lengths = {len(f) for f in digits} or {0}
    longest, ragged = max(lengths), len(lengths) > 1
    # Ragged decimals have lost the zeros at their ends, ragged integers those at their beginnings.
    ends, begins = (any(f[i] == "0" for f in digits if len(f) > 1) for i in (-1, 0))
    values: dict[str, Floats] = {}
    if (not ends and decimal_point) if ragged else (decimal_point or longest > 2 or not longest):
        values[" with decimals" if longest else ""] = np.array([float(f"0.{f}0") for f in fractions])
    if not begins and (ragged or longest > 7):
        for unit, width in (("ns", 9), ("µs", 6), ("ms", 3)):
            if longest <= width:
                numbers = np.array([int(f or 0) for f in fractions])
                values[f" and {unit} without leading zeros"] = numbers / 10**width
    return values
