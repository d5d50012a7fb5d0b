"""Columns by name: tables in text files, without silent loss of lines; units, of names such as ``x [ft]`` or by values; roles in a cloud."""

import contextlib
import re
from bisect import bisect
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy import constants

from radarsdf.arrays import Array, Floats
from radarsdf.checks import check
from radarsdf.io.files import reading
from radarsdf.scans import Columns, Notes, Scan, with_returns

_COMMENT = re.compile("(#|//|%).*")
_SINCE_1970 = (("s", 1.0), ("ms", 1e-3), ("µs", 1e-6), ("ns", 1e-9))
_LIMITS = (1e11, 1e14, 1e17)  # bounds of absolute times since 1970 in one of these units and the next
_SLACK = 1.05  # tolerance for angles that exceed a limit by rounding

_UNITS = {
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
    for dimension, names in _UNITS.items()
}
for _known in _FACTORS.values():
    _known.update({f"{word}s": factor for word, factor in _known.items() if len(word) > 2})
# Words of a name that are taken for its unit without brackets. `sec` and `nsec` are columns of their own, `min` is a minimum.
_UNIT_WORDS = {word for of in ("length", "speed", "angle") for word in _FACTORS[of]} - {"rev", "turn"}
_UNIT_WORDS |= {"s", "ms", "us", "µs", "ns"}
_UNIT = re.compile(
    rf"[\s_/]+(?:in[\s_]+)?((?:{'|'.join(map(re.escape, _UNIT_WORDS))})(?:/(?:{'|'.join(_FACTORS['time'])}))?|dbs?m?|linear)$"
    r"|[\s_]*[\[(]([^\])]*)[\])]$"
)
_QUOTIENT = re.compile(r"^(.+?)(?:\s*/\s*|\s+per\s+)(.+)$|^(.+?)[\s*·.]+(.+?)(?:\^|\*\*)?(?:-1|⁻¹)$")
_LENGTHS, _TIMES = _FACTORS["length"].items(), _FACTORS["time"].items()
_FACTORS["speed"] |= {f"{length}/{time}": a / b for length, a in _LENGTHS for time, b in _TIMES}

_XYZ = ("x", "y", "z")
_POLAR = ("range", "azimuth", "elevation")
SIGMA = ("sigma_range", "sigma_azimuth", "sigma_elevation")
# Names of a role in sensors, drivers and data sets, lower case, without separators. The first in a cloud is used, ours first.
_ALIASES: dict[str, tuple[str, ...]] = {
    "x": ("x",),
    "y": ("y",),
    "z": ("z",),
    "range": ("range", "distance", "r", "rng", "dist", "radius", "slantrange"),
    "azimuth": ("azimuth", "azimuthangle", "az", "azi", "azim", "angleazimuth"),
    "elevation": ("elevation", "elevationangle", "el", "ele", "elev", "angleelevation"),
    "intensity": ("power", "intensity", "rcs", "snr", "snrdb", "amplitude", "reflectivity", "reflectance", "magnitude",
                  "rssi", "signalpower", "signalstrength"),
    "doppler": ("doppler", "velocity", "dopplervelocity", "vdopplermps", "radialspeed", "radialvelocity", "rangerate",
                "vr", "speed", "rdot", "vradial", "vrad", "velr", "vel", "radialvel", "velocityradial",
                "dopplerspeed", "vdoppler", "relativevelocity"),
    "sigma_range": ("sigmarange", "rangestd", "rangeaccu"),
    "sigma_azimuth": ("sigmaazimuth", "azimuthstd", "aziaccu"),
    "sigma_elevation": ("sigmaelevation", "elevationstd", "eleaccu"),
}  # fmt: skip
_DIMENSIONS = {
    **dict.fromkeys((*_XYZ, "range", "sigma_range"), "length"),
    **dict.fromkeys(("azimuth", "elevation", "sigma_azimuth", "sigma_elevation"), "angle"),
    "doppler": "speed",
}  # intensities may have any unit
_IN_DEGREES = ("aziaccu", "eleaccu")  # of the Oculii Eagle
# Names of unnamed columns, by the number of columns.
_COLUMNS: dict[int, tuple[str, ...]] = {
    3: ("x", "y", "z"),
    4: ("x", "y", "z", "intensity"),  # KITTI
    5: ("x", "y", "z", "intensity", "doppler"),  # ColoRadar
    7: ("x", "y", "z", "rcs", "v_r", "v_r_compensated", "time"),  # View-of-Delft
    8: ("x", "y", "z", "v_r", "range", "power", "alpha", "beta"),  # TJ4DRadSet
}


def read_table(path: Path) -> tuple[list[list[str]], Floats]:
    """Read a text file with one row of numbers per line, separated by commas, semicolons, tabs or spaces.

    Return the words of each line and comment above the rows, one of which may name the columns, and the values (R, W):
    NaN for words that are not numbers, and for rows of another width. Comments begin with ``#``, ``//`` or ``%``; decimal commas are read if semicolons separate the numbers. The first
    line with a number is the first row. Raises a ValueError if most rows have words that are not numbers.
    """
    heads: list[list[str]] = []
    rows: list[str] = []
    for line in read_text(path).splitlines():
        bare = _COMMENT.sub("", line).strip()
        if not rows and line.strip():
            head = (bare or line.strip().lstrip("/#% ")).rstrip(",; \t")
            separator = _separator(head)
            if separator is None:
                head = re.sub(r"\s+(?=[\[(])", "", head)  # a unit belongs to its name
            parts = (head.replace(",", ".") if separator == ";" else head).split(separator)
            words = [part.strip().strip('"') for part in parts]
            if not bare or not any(map(_is_number, words)):
                heads.append(words)
                continue
        if bare:
            rows.append(bare)
    return heads, _values(rows) if rows else np.zeros((0, len(heads[-1]) if heads else 0))


def _values(rows: list[str]) -> Floats:
    """Parse rows to numbers (R, W): by NumPy at once or, if some are damaged, row by row."""
    separator = _separator(rows[0])
    if separator == ";":
        rows = [row.replace(",", ".") for row in rows]
    with contextlib.suppress(ValueError):
        return np.loadtxt(rows, delimiter=separator, comments=None, ndmin=2)
    words = [row.rstrip(",; \t").split(separator) for row in rows]
    width = Counter(map(len, words)).most_common(1)[0][0]
    cells = [parts if len(parts) == width else [""] * width for parts in words]
    known = np.array([[_is_number(cell) for cell in parts] for parts in cells])
    table = np.array([[float(cell) if _is_number(cell) else np.nan for cell in parts] for parts in cells])
    of_words = ~known.any(axis=0)  # a column of labels is no damage
    damaged = ~known[:, ~of_words].all(axis=1)
    most = of_words.all() or 2 * damaged.sum() > len(words)
    check(not most, f"a line is not a row of {width} numbers: {rows[int(np.argmax(damaged))]!r:.50}")
    return table


def read_numbers(path: Path, columns: int | None = None) -> Floats:
    """Read a table of finite numbers (R, columns) from a text file; None: any number of columns."""
    with reading(path, f"a table of {columns or 'any number of'} columns of finite numbers"):
        _, values = read_table(path)
        bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
        check(len(bad) == 0, f"row {bad[:1]} has other values, or another number of columns")
        check(columns in (None, values.shape[1]), f"it has {values.shape[1]}")
    return values


def read_text(path: Path) -> str:
    """Read text in UTF-8. Undecodable bytes, such as a comment in Latin-1, become replacement characters."""
    return path.read_bytes().decode("utf-8-sig", errors="replace")


def as_numbers(words: Array) -> Floats:
    """Convert words (N,) to numbers; NaN for those that are none."""
    with contextlib.suppress(ValueError):
        return words.astype(np.float64)
    return np.array([float(word) if _is_number(word) else np.nan for word in words.tolist()])


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _separator(line: str) -> str | None:
    """Return the sign that separates the words of a line; None: white space."""
    return next((sign for sign in ";,\t" if sign in line), None)


def unit_since_1970(time: float) -> tuple[str, float]:
    """Unit of a time since 1970 by its magnitude, and its length, s."""
    return _SINCE_1970[bisect(_LIMITS, abs(time))]


def in_seconds(times: Floats, name: str, notes: Notes) -> Floats:
    """Convert times (N,) of the file `name` to s. They may be in ms, µs or ns since 1970, which is noted."""
    check(np.isfinite(times).all(), f"{name} holds a time that is not finite")
    unit, scale = unit_since_1970(float(np.median(times)) if len(times) else 0.0)
    if unit != "s":
        notes.add(f"times of {name} are taken as {unit} since 1970")
    return times * scale


def are_degrees(azimuth: Array, elevation: Array) -> bool:
    """Whether angles (N,) must be in degrees because they exceed the range of radians."""
    finite = np.isfinite(azimuth) & np.isfinite(elevation)
    if not finite.any():
        return False
    azimuth, elevation = azimuth[finite], elevation[finite]
    largest, highest = (np.quantile(np.abs(angles), 0.99) / np.pi for angles in (azimuth, elevation))
    # Azimuths in rad are from -pi to pi, or from 0 to 2 pi.
    return bool(highest > _SLACK / 2 or largest > (_SLACK if azimuth.min() < 0 else 2 * _SLACK))


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
        known = " ".join(_UNITS[dimension].values())
        msg = f"the column {column} has the unit {unit!r:.30}, which is no known {dimension}: name one of {known}"
        raise ValueError(msg)
    return factor


def scaled(column: Floats, name: str, dimension: str) -> Floats:
    """Convert a column to m, s, m/s or rad by the unit in its name, if it has one."""
    return column * factor_of(without_unit(name)[1], dimension, name)


def names_of(width: int, columns: int | Sequence[str] | None) -> list[str]:
    """Names of `width` columns that have none in their file."""
    names = range(columns) if isinstance(columns, int) else columns or range(width)
    check(len(names) == width, f"there are {width} columns, not the {len(names)} that are given")
    if columns is not None and not isinstance(columns, int):
        return list(columns)
    return list(_COLUMNS.get(width, ("x", "y", "z", *(f"column_{i}" for i in range(3, width)))[:width]))


@dataclass(frozen=True)
class Fields:
    """The field of a cloud for each role. Positions are x, y and z, or else range, azimuth and elevation."""

    names: dict[str, str]  # field name by role
    in_degrees: bool = False  # unit of angles whose names have none

    @classmethod
    def of(cls, names: list[str], overrides: Mapping[str, Any] | None = None) -> "Fields":
        """Find the roles of fields by their names. `overrides` maps roles to fields; None leaves a role out."""
        lower = {plain_name(name)[0]: name for name in reversed(names)}
        lower |= {name.lower(): name for name in reversed(names)}
        # AzimuthAngle, azimuth_angle and Azimuth Angle are the same name.
        squeezed = {_squeeze(name): lower[name] for name in reversed(lower)}
        found: dict[str, str] = {}
        for role, aliases in _ALIASES.items():
            name = next((squeezed[alias] for alias in aliases if alias in squeezed), None)
            if name is not None and name not in found.values():
                found[role] = name
        for role, field in (overrides or {}).items():
            check(role in _ALIASES, f"fields has no role {role!r}: roles are {', '.join(_ALIASES)}")
            found.pop(role, None)
            if field is None:
                continue
            name = field if field in names else lower.get(str(field).lower())
            check(name, f"there is no field {field} for {role}: there are {', '.join(names)}")
            found[role] = str(name)
        wanted = _POLAR if "range" in found and "x" not in found else _XYZ
        missing = ", ".join(role for role in wanted if role not in found)
        known = not missing or set(_POLAR) <= set(found)
        check(known, f"the fields {missing} are missing: there are {', '.join(names) or 'none'}")
        fields = cls(found)
        useless = [role for role in _POLAR if (overrides or {}).get(role) is not None and not fields.polar]
        check(not useless, f"fields {useless} have no effect next to x, y and z: set one of these to None")
        return fields

    @property
    def polar(self) -> bool:
        """Whether positions are given by range and angles."""
        return not set(_XYZ) <= set(self.names)

    def factor(self, role: str) -> float:
        """Return the factor from the unit of a field to m, rad or m/s: that in its name, or else degrees by value."""
        if role not in _DIMENSIONS:
            return 1.0
        name, dimension = self.names[role], _DIMENSIONS[role]
        bare, unit = plain_name(name)
        named = name.endswith(("]", ")")) or _squeeze(bare) in _ALIASES[role]
        if not named and known_factor(unit, dimension) is None:  # v_rad is a radial speed
            unit = ""
        degrees = (self.in_degrees and dimension == "angle") or _squeeze(bare) in _IN_DEGREES
        return factor_of("deg" if degrees and not unit else unit, dimension, name)

    def with_unit(self, columns: Columns, notes: Notes) -> "Fields":
        """Return these fields with the unit of their angles, from their names or else from the values in a cloud."""
        names = [self.names[role] for role in _POLAR[1:]] if self.polar else []
        if all(plain_name(name)[1] for name in names):
            return self
        azimuth, elevation = (np.asarray(columns[name], np.float64) for name in names)
        in_degrees = are_degrees(azimuth, elevation)
        unit = "degrees" if in_degrees else "rad"
        notes.add(f"{' and '.join(names)} are taken as {unit} by their values: azimuth_rad would be explicit")
        return replace(self, in_degrees=in_degrees)

    def note_use(self, names: Iterable[str], notes: Notes) -> None:
        name = self.names.get("intensity", "")
        if plain_name(name)[1] == "linear":
            notes.add(f"{name} is used as intensity unchanged: in dB, 10 log10, it gives a better map")
        if unused := [name for name in names if name and name not in self.names.values()]:
            notes.add(f"unused fields: {', '.join(unused)}; fields={{role: name}} or --field selects others")

    def scan(self, columns: Columns, T_world_sensor: Floats, time_s: float | None, notes: Notes) -> Scan:
        """Build a scan of the finite returns in columns (N,); others are counted. Positions are float64 if x, y or z need it."""
        values: dict[str, Array] = {}  # m, rad, m/s
        of_sigma = SIGMA if set(SIGMA) <= set(self.names) else ()
        optional = [role for role in ("intensity", "doppler", *of_sigma) if role in self.names]
        with np.errstate(over="ignore", invalid="ignore"):  # non-finite values are dropped
            for role in (*(_POLAR if self.polar else _XYZ), *optional):  # all others may be of any kind
                column, factor = columns[self.names[role]], self.factor(role)
                check(column.dtype.kind in "biuf", f"the field {self.names[role]} holds no numbers")
                values[role] = column if factor == 1 else column * np.float64(factor)
            if self.polar:
                ranges, azimuth, elevation = (values[role].astype(np.float64) for role in _POLAR)
                flat = ranges * np.cos(elevation)
                xyz = [flat * np.cos(azimuth), flat * np.sin(azimuth), ranges * np.sin(elevation)]
            else:
                xyz = [values[axis] for axis in _XYZ]
            in_double = not self.polar and any(part.dtype.itemsize > 4 for part in xyz)
            points = np.stack(xyz, axis=1).astype(np.float64 if in_double else np.float32)
            single = {role: np.ascontiguousarray(values[role], np.float32) for role in optional}
        sigmas = np.stack([single[role] for role in of_sigma], axis=1) if of_sigma else None
        scan = Scan(points, T_world_sensor, single.get("intensity"), single.get("doppler"), time_s, sigmas)
        finite = np.isfinite(points).all(axis=1) & np.isfinite(single.get("intensity", 0))
        what = "returns left out: a coordinate or the intensity is not a finite number"
        notes.count(what, int((~finite).sum()))
        return scan if finite.all() else with_returns(scan, finite)


def columns_of(scan: Scan, points: Array) -> Columns:
    """Columns of a scan with these points (N, 3), in any frame, by role."""
    columns: dict[str, Any] = dict(zip("xyz", points.T, strict=True))
    columns |= {"intensity": scan.intensities, "doppler": scan.doppler_mps}
    columns |= dict(zip(SIGMA, () if scan.sigma is None else scan.sigma.T, strict=False))
    return {name: values for name, values in columns.items() if values is not None}


def plain_name(name: str) -> tuple[str, str]:
    """Name in lower case, without CloudCompare's prefix, and its unit."""
    return without_unit(name.lower().removeprefix("scalar_"))


def _squeeze(name: str) -> str:
    return re.sub(r"[\W_]+", "", name.lower())
