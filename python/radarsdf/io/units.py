"""Units in the names of columns, such as ``azimuth_deg``, ``x [ft]`` or ``time(ns)``."""

from __future__ import annotations

import re

from scipy import constants

from radarsdf.checks import check

_SI = {"": 1.0, "m": 1e-3, "u": 1e-6, "µ": 1e-6, "μ": 1e-6, "n": 1e-9}
_LENGTHS = {
    **{f"{prefix}m": factor for prefix, factor in (_SI | {"c": 1e-2, "d": 0.1, "k": 1e3}).items()},
    **{f"{long}{m}": x for long, x in (("", 1.0), ("milli", 1e-3), ("centi", 1e-2), ("kilo", 1e3)) for m in ("meter", "metre")},
    **dict.fromkeys(("in", "inch", "inches"), constants.inch), **dict.fromkeys(("ft", "foot", "feet"), constants.foot),
    **dict.fromkeys(("yd", "yds", "yard"), constants.yard), **dict.fromkeys(("mi", "mile"), constants.mile), "nmi": constants.nautical_mile,
}  # fmt: skip
_TIMES = {
    **{f"{prefix}{s}": x for prefix, x in _SI.items() for s in ("s", "sec", "second")},
    **dict.fromkeys(("millisec", "millisecond"), 1e-3), **dict.fromkeys(("microsec", "microsecond"), 1e-6),
    **dict.fromkeys(("nanosec", "nanosecond"), 1e-9), **dict.fromkeys(("min", "minute"), constants.minute),
    **dict.fromkeys(("h", "hr", "hrs", "hour"), constants.hour), **dict.fromkeys(("d", "day"), constants.day),
}  # fmt: skip
_SPEEDS = {
    **dict.fromkeys(("m/s", "mps"), 1.0), **dict.fromkeys(("km/h", "kmh", "kph", "kmph"), constants.kmh), "mph": constants.mph, "fps": constants.foot,
    **dict.fromkeys(("kn", "kt", "kts", "knot"), constants.knot),
}  # fmt: skip
_ANGLES = {
    **{f"{prefix}rad": factor for prefix, factor in _SI.items()}, "radian": 1.0, "milliradian": 1e-3,
    **dict.fromkeys(("deg", "degree", "°", "º"), constants.degree), **dict.fromkeys(("gon", "grad", "gradian"), constants.pi / 200),
    **dict.fromkeys(("arcmin", "arcminute"), constants.arcminute), **dict.fromkeys(("arcsec", "arcsecond"), constants.arcsecond),
    **dict.fromkeys(("rev", "revolution", "turn"), 2 * constants.pi),
}  # fmt: skip
_FACTORS = {"length": _LENGTHS, "time": _TIMES, "speed": _SPEEDS, "angle": _ANGLES}

# Words of a name that are taken for its unit without brackets. `sec` and `nsec` are columns of their own, `min` is a minimum.
_WORDS = "|".join(
    re.escape(word) + ("" if len(word) < 3 else "s?")
    for word in (*_LENGTHS, *_SPEEDS, *_ANGLES, "s", "ms", "us", "µs", "ns")
    if word not in ("rev", "turn")
)
_UNIT = re.compile(
    rf"[\s_/]+(?:in[\s_]+)?((?:{_WORDS})(?:/(?:{'|'.join(_TIMES)}))?|dbs?m?|linear)$|[\s_]*[\[(]([^\])]*)[\])]$"
)
_QUOTIENT = re.compile(r"(.+?)(?:\s*/\s*|\s+per\s+)(.+)|(.+?)[\s*·.]+(.+?)(?:\^|\*\*)?(?:-1|⁻¹)")


def without_unit(name: str) -> tuple[str, str]:
    """Split a column name into the bare name and the unit, both in lower case; the unit is empty if there is none."""
    name = name.strip().lower()
    found = _UNIT.search(name)
    if found is None or not found.start():
        return name, ""
    return name[: found.start()], found[1] if found[1] is not None else found[2].strip()


def factor_of(unit: str, dimension: str, column: str) -> float:
    """Return the factor from a unit to m, s, m/s or rad; 1 without a unit. Raises a ValueError for any other unit."""
    factor = _factor(unit, dimension) if unit else 1.0
    known = ", ".join(_FACTORS[dimension])
    check(
        factor,
        f"the column {column} has the unit {unit!r:.30}, which is no known {dimension}: name one of {known}",
    )
    return factor or 1.0


def has_dimension(unit: str, dimension: str) -> bool:
    """Whether a unit is a known one of this dimension."""
    return _factor(unit, dimension) is not None


def _factor(unit: str, dimension: str) -> float | None:
    factors = _FACTORS[dimension]
    singular = unit.removesuffix("s") if len(unit) > 3 else unit  # feet per ms, not per metres
    if singular in factors or unit in factors:
        return factors.get(unit, factors.get(singular))
    if dimension != "speed" or (parts := _QUOTIENT.fullmatch(unit)) is None:
        return None
    length, time = (
        _factor(part, of) for part, of in zip(filter(None, parts.groups()), ("length", "time"), strict=True)
    )
    return length / time if length and time else None
