"""Units in the names of columns, such as ``azimuth_deg``, ``x [ft]`` or ``time(ns)``."""

from __future__ import annotations

import re

from scipy import constants

from radarsdf.arrays import Floats

_NAMES = {
    "length": {
        1.0: "m meter metre", 0.1: "dm", 1e-2: "cm centimeter centimetre", 1e-3: "mm millimeter millimetre", 1e-6: "um µm μm", 1e-9: "nm",
        1e3: "km kilometer kilometre", constants.inch: "in inch inches", constants.foot: "ft foot feet", constants.yard: "yd yds yard",
        constants.mile: "mi mile", constants.nautical_mile: "nmi",
    },
    "time": {
        1.0: "s sec second", 1e-3: "ms msec millisec millisecond", 1e-6: "us µs μs usec microsec microsecond",
        1e-9: "ns nsec nanosec nanosecond", constants.minute: "min minute", constants.hour: "h hr hrs hour", constants.day: "d day",
    },
    "speed": {
        1.0: "m/s mps", constants.kmh: "km/h kmh kph kmph", constants.mph: "mph", constants.foot: "fps", constants.knot: "kn kt kts knot",
    },
    "angle": {
        1.0: "rad radian", 1e-3: "mrad milliradian", 1e-6: "urad µrad μrad", constants.degree: "deg degree ° º",
        constants.pi / 200: "gon grad gradian", constants.arcminute: "arcmin arcminute", constants.arcsecond: "arcsec arcsecond",
        2 * constants.pi: "rev revolution turn",
    },
}  # fmt: skip
_FACTORS = {
    dimension: {word: factor for factor, words in names.items() for word in words.split()}
    for dimension, names in _NAMES.items()
}
for _known in _FACTORS.values():
    _known.update({f"{word}s": factor for word, factor in _known.items() if len(word) > 2})
# Words of a name that are taken for its unit without brackets. `sec` and `nsec` are columns of their own, `min` is a minimum.
_WORDS = {word for of in ("length", "speed", "angle") for word in _FACTORS[of]} - {"rev", "turn"}
_WORDS |= {"s", "ms", "us", "µs", "ns"}
_UNIT = re.compile(
    rf"[\s_/]+(?:in[\s_]+)?((?:{'|'.join(map(re.escape, _WORDS))})(?:/(?:{'|'.join(_FACTORS['time'])}))?|dbs?m?|linear)$"
    r"|[\s_]*[\[(]([^\])]*)[\])]$"
)
_QUOTIENT = re.compile(r"^(.+?)(?:\s*/\s*|\s+per\s+)(.+)$|^(.+?)[\s*·.]+(.+?)(?:\^|\*\*)?(?:-1|⁻¹)$")
_LENGTHS, _TIMES = _FACTORS["length"].items(), _FACTORS["time"].items()
_FACTORS["speed"] |= {f"{length}/{time}": a / b for length, a in _LENGTHS for time, b in _TIMES}


def without_unit(name: str) -> tuple[str, str]:
    """Split a column name into the bare name and the unit, both in lower case; the unit is empty if there is none."""
    name = name.strip().lower()
    found = _UNIT.search(name)
    if found is None or not found.start():
        return name, ""
    return name[: found.start()], found[1] if found[1] is not None else found[2].strip()


def known_factor(unit: str, dimension: str) -> float | None:
    """Return the factor from a unit to m, s, m/s or rad; None if it is no known one of this dimension."""
    return _FACTORS[dimension].get(_QUOTIENT.sub(r"\1\3/\2\4", unit))


def factor_of(unit: str, dimension: str, column: str) -> float:
    """Return the factor from a unit to m, s, m/s or rad; 1 without a unit. Raises a ValueError for any other unit."""
    factor = known_factor(unit, dimension) if unit else 1.0
    if factor is None:
        known = " ".join(_NAMES[dimension].values())
        msg = f"the column {column} has the unit {unit!r:.30}, which is no known {dimension}: name one of {known}"
        raise ValueError(msg)
    return factor


def scaled(column: Floats, name: str, dimension: str) -> Floats:
    """Convert a column to m, s, m/s or rad by the unit in its name, if it has one."""
    return column * factor_of(without_unit(name)[1], dimension, name)
