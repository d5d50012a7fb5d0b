# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The report of a fit as it comes from the file of a map: what is known of it has the types that others rely on."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError
from typing_extensions import TypedDict

from radarsdf.settings import by_name, first_wrong

_Count = Annotated[int, Field(ge=0, le=2**53)]
_Finite = Annotated[float, Field(ge=0, allow_inf_nan=False)]
_Position = Annotated[list[Annotated[float, Field(allow_inf_nan=False)]], Field(min_length=3, max_length=3)]
_RULES = ConfigDict(strict=True, extra="allow")


class _Noise(TypedDict):
    range_m: _Finite
    azimuth_rad: _Finite
    elevation_rad: _Finite


class _History(TypedDict):
    iterations: list[_Count]
    losses: list[float]  # of a fit that diverged, not all are finite
    seconds: list[_Finite]


class _Poses(TypedDict):
    """What :func:`radarsdf.poses.way.way_of` writes."""

    verdict: str
    improved: bool | None
    step_m: _Finite | None
    step_rad: _Finite | None
    scans: list[_Count]
    before: list[_Position] | None
    after: list[_Position]
    sigma_m: list[_Finite]
    sigma_rad: list[_Finite]


class _Report(TypedDict, total=False):
    """What :func:`radarsdf.fitting.steps.fit_rays` writes, and :func:`radarsdf.tiles.fit_tiles.fit_tile`."""

    __pydantic_config__ = _RULES  # type: ignore[misc]

    scans: _Count
    returns: _Count
    returns_used: _Count
    ghosts: _Count
    movers: _Count
    wild_intensities: _Count
    noise: _Noise
    leaf_cells: _Count
    vertices: _Count
    iterations: dict[str, _Count]
    iterations_done: dict[str, _Count]
    losses: dict[str, float]
    loss_history: dict[str, _History]
    skipped: list[str]
    skipped_s: list[Annotated[float, Field(allow_inf_nan=False)] | None]
    plan: str
    poses: _Poses


_REPORT: TypeAdapter[Any] = TypeAdapter(_Report)


def checked_report(report: Any) -> dict[str, Any]:
    """`report`, a value of JSON. Values of other names are left as they are, but those that end in ``_s`` are seconds.

    Raises
    ------
    ValueError
        If a value has another type, is out of range, or does not fit to others.
    """
    try:
        checked: dict[str, Any] = _REPORT.validate_python(by_name(report, "the report"))
    except ValidationError as error:
        raise ValueError(first_wrong(error, "report.")) from None
    for name, value in checked.items():
        if (
            name.endswith("_s")
            and name != "skipped_s"
            and not (isinstance(value, float) and 0 <= value < 1e12)
        ):
            msg = f"report.{name:.50} must be seconds, not {value!r:.50}"
            raise ValueError(msg)
    way = checked.get("poses")
    lists = [] if way is None else [value for value in way.values() if isinstance(value, list)]
    histories = checked.get("loss_history", {}).values()
    if (
        len(checked.get("skipped", [])) != len(checked.get("skipped_s", []))
        or not checked.get("iterations_done", {}).keys() <= checked.get("iterations", {}).keys()
        or any(len({len(part) for part in history.values()}) != 1 for history in histories)
        or (way is not None and (len({len(part) for part in lists}) != 1 or not lists[0]))
    ):
        msg = "parts of the report do not fit together"
        raise ValueError(msg)
    return checked
