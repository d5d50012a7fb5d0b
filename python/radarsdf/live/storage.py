# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The state of a map that grows, in one file. Nothing in it is executed."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from radarsdf.checks import MAX_POSITION_M, check_poses, check_values_of_scan, positions
from radarsdf.config.fit_config import FitConfig
from radarsdf.io.npz import arrays_of, check_arrays, write_arrays
from radarsdf.live.scan_log import FIELDS, LoggedScan, ScanId
from radarsdf.returns.noise import SensorNoise
from radarsdf.settings import by_name, settings

_FORMAT = 1
_Coordinate = Annotated[float, Field(ge=-MAX_POSITION_M, le=MAX_POSITION_M)]
_Count = Annotated[int, Field(ge=0, le=2**62)]


@settings
class State:
    """What a file has besides arrays."""

    format: Literal[1]
    config: dict[str, Any]
    origin: Annotated[list[_Coordinate], Field(min_length=3, max_length=3)] | None
    noise: Annotated[list[Annotated[float, Field(ge=0)]], Field(min_length=3, max_length=3)]
    noise_of: _Count
    next_id: _Count
    with_intensities: bool | None
    max_bytes: Annotated[int, Field(ge=1, le=2**63 - 1)] | None
    sealed: list[int | str]
    ids: list[int | str]
    held: list[list[Literal["points", "intensities", "doppler_mps", "standing"]]]


@dataclass(frozen=True)
class Stored:
    """What is kept of a map."""

    config: FitConfig
    origin: NDArray[np.float64] | None
    noise: SensorNoise
    noise_of: int
    next_id: int
    with_intensities: bool | None
    max_bytes: int | None
    sealed: list[ScanId]
    scans: dict[ScanId, LoggedScan]
    keys: NDArray[np.uint64]
    sums: NDArray[np.int64]
    scans_of_cells: NDArray[np.uint32]
    look_keys: NDArray[np.uint64]
    looks: NDArray[np.uint32]


CELL_COLUMNS: dict[str, tuple[Any, ...]] = {
    "keys": (np.uint64, None),
    "sums": (np.int64, None, 14),
    "scans_of_cells": (np.uint32, None),
    "look_keys": (np.uint64, None),
    "looks": (np.uint32, None),
}
"""Types and shapes of what is kept of cells and blocks, in the order in which the core takes it. None: any length."""


def save_state(stored: Stored, path: str | PathLike[str]) -> None:
    """Writes a state whole or not at all. Raises a ValueError for ids that are neither numbers nor words."""
    ids = [*stored.scans, *stored.sealed]
    if not all(type(scan_id) in (int, str) for scan_id in ids):
        msg = "a map can be saved only if the ids of its scans are whole numbers or strings"
        raise ValueError(msg)
    described = {
        "format": _FORMAT,
        "config": stored.config.to_dict(),
        "origin": None if stored.origin is None else stored.origin.tolist(),
        "noise": dataclasses.astuple(stored.noise),
        "noise_of": stored.noise_of,
        "next_id": stored.next_id,
        "with_intensities": stored.with_intensities,
        "max_bytes": stored.max_bytes,
        "sealed": stored.sealed,
        "ids": list(stored.scans),
        "held": [
            [name for name in FIELDS if getattr(scan, name) is not None] for scan in stored.scans.values()
        ],
    }
    scans = list(stored.scans.values())
    arrays: dict[str, NDArray[Any]] = {name: getattr(stored, name) for name in CELL_COLUMNS}
    arrays["poses"] = np.stack([scan.pose for scan in scans]) if scans else np.zeros((0, 4, 4))
    arrays["times_s"] = np.array([np.nan if scan.time_s is None else scan.time_s for scan in scans])
    arrays["counts"] = np.array([len(scan.points) for scan in scans], np.int64)
    for name in FIELDS:
        held = [array for array in (getattr(scan, name) for scan in scans) if array is not None]
        if held:
            arrays[name] = np.concatenate(held)
            # Some scans may be in float32, others not.
            arrays[f"{name}_single"] = np.array([array.dtype == np.float32 for array in held])
    arrays["described"] = np.frombuffer(json.dumps(described).encode(), np.uint8)
    write_arrays(path, arrays)


def load_state(path: str | PathLike[str]) -> Stored:
    """The state that :func:`save_state` wrote. Raises a ValueError if the file is none, or damaged."""
    names = (
        "described",
        "poses",
        "times_s",
        "counts",
        *CELL_COLUMNS,
        *FIELDS,
        *(f"{name}_single" for name in FIELDS),
    )
    arrays = arrays_of(Path(path), names)
    try:
        return _state_of(arrays)
    except (KeyError, TypeError, ValueError, IndexError, RecursionError) as error:
        msg = f"{path} is not the state of a live map of this version, or it is damaged: {error}"
        raise ValueError(msg) from error


def checked_sums(arrays: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """The arrays of :data:`CELL_COLUMNS`. Raises a ValueError if they are none."""
    check_arrays(arrays, CELL_COLUMNS)
    sums = {name: np.ascontiguousarray(arrays[name]) for name in CELL_COLUMNS}
    if (np.diff(sums["keys"].astype(np.float64)) < 0).any() or (sums["sums"][:, 0] < 1).any():
        msg = "its sums are none"
        raise ValueError(msg)
    return sums


def _state_of(arrays: dict[str, NDArray[Any]]) -> Stored:
    state = State(**by_name(json.loads(arrays["described"].tobytes()), "state"))
    sums = checked_sums(arrays)
    check_arrays(arrays, {"counts": (np.int64, len(state.held))})
    ids: list[ScanId] = [*state.ids]
    held: list[list[str]] = [[*names] for names in state.held]
    counts = arrays["counts"].tolist()
    all_ids = {*ids, *state.sealed}
    if len(all_ids) < len(ids) + len(state.sealed) or state.next_id in all_ids or min(counts, default=1) < 1:
        msg = "ids are there twice, or a scan is empty"
        raise ValueError(msg)
    poses = check_poses(arrays["poses"], len(ids)) if ids else np.zeros((0, 4, 4))
    columns = {name: _parts(arrays, name, held, counts) for name in FIELDS}
    times_s = np.asarray(arrays.get("times_s", np.full(len(ids), np.nan)), np.float64)
    scans = {
        scan_id: dataclasses.replace(
            LoggedScan(poses[i].copy(), *(columns[name][i] for name in FIELDS)),
            time_s=float(times_s[i]) if np.isfinite(times_s[i]) else None,
        )
        for i, scan_id in enumerate(ids)
    }
    for i, scan in enumerate(scans.values()):
        positions(scan.points, f"points of scan {i}")
        for name in FIELDS[1:]:
            if (value := getattr(scan, name)) is not None:
                check_values_of_scan(value, scan.points, name, i)
        if state.origin is None or state.with_intensities != (scan.intensities is not None):
            msg = "the origin is missing, or only some scans have intensities"
            raise ValueError(msg)
    return Stored(
        config=FitConfig.from_dict(state.config),
        origin=None if state.origin is None else np.array(state.origin, np.float64),
        noise=SensorNoise(*state.noise),
        noise_of=state.noise_of,
        next_id=state.next_id,
        with_intensities=state.with_intensities,
        max_bytes=state.max_bytes,
        sealed=[*state.sealed],
        scans=scans,
        **sums,
    )


def _parts(arrays: dict[str, NDArray[Any]], name: str, held: list[list[str]], counts: list[int]) -> list[Any]:
    """A column of each scan. None: the scan has none."""
    has = [name in names for names in held]
    if not any(has):
        return [None] * len(held)
    lengths = [count for count, own in zip(counts, has, strict=True) if own]
    whole, single = arrays[name], arrays[f"{name}_single"]
    if sum(lengths) != len(whole) or whole.dtype.kind != ("b" if name == "standing" else "f"):
        msg = f"{name} are of another number or type"
        raise ValueError(msg)
    parts = iter(zip(np.split(whole, np.cumsum(lengths)[:-1]), single, strict=True))
    found: list[Any] = []
    for own in has:
        if not own:
            found.append(None)
            continue
        part, is_single = next(parts)
        found.append(part.astype(np.float32) if is_single else part.copy())
    return found
