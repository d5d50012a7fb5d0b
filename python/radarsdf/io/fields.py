"""Roles of the fields of a radar's point cloud: the names that sensors use, and the returns of a scan."""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from radarsdf.arrays import Array, Floats
from radarsdf.checks import check
from radarsdf.io.text import are_degrees, factor_of, known_factor, without_unit
from radarsdf.scans import Columns, Notes, Scan, finite_returns

_XYZ = ("x", "y", "z")
_POLAR = ("range", "azimuth", "elevation")
SIGMA = ("sigma_range", "sigma_azimuth", "sigma_elevation")
# Names that sensors, drivers and data sets use for a role, in lower case and without separators. The first one found
# in a cloud is used. Our own names come first.
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

    def with_unit(self, columns: Mapping[str, Array], notes: Notes) -> "Fields":
        """Return these fields with the unit of their angles, from their names or else from the values in a cloud."""
        names = [self.names[role] for role in _POLAR[1:]] if self.polar else []
        if all(plain_name(name)[1] for name in names):
            return self
        azimuth, elevation = (np.asarray(columns[name], np.float64) for name in names)
        in_degrees = are_degrees(azimuth, elevation)
        unit = "degrees" if in_degrees else "rad"
        how = "by their values: azimuth_deg or azimuth_rad would be explicit"
        notes.add(f"{' and '.join(names)} are taken as {unit} {how}")
        return replace(self, in_degrees=in_degrees)

    def note_use(self, names: Iterable[str], notes: Notes) -> None:
        name = self.names.get("intensity", "")
        if plain_name(name)[1] == "linear":
            notes.add(f"{name} is used as intensity unchanged: in dB, 10 log10, it gives a better map")
        if unused := [name for name in names if name and name not in self.names.values()]:
            notes.add(f"unused fields: {', '.join(unused)}; fields={{role: name}} or --field selects others")

    def scan(
        self, columns: Mapping[str, Array], T_world_sensor: Floats, time_s: float | None, notes: Notes
    ) -> Scan:
        """Build a scan of the finite returns in the columns, (N,) each. Positions are float64 if x, y or z need it, else float32."""
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
        return finite_returns(scan, notes)


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
