# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Scans in ``.npz`` files, and arrays in those of any kind."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable, Iterable, Mapping
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from radarsdf.checks import instance, path_of
from radarsdf.io.files import check_regular_file, write_whole
from radarsdf.io.imu import Imu
from radarsdf.io.scans import Scans
from radarsdf.io.unpacking import check_unpacked

_IMU = ("imu_times", "angular_velocity", "specific_force", "R_sensor_imu")  # in the order of Imu
_ARRAYS = (
    "points",
    "frame",
    "poses",
    "intensity",
    "static",
    "lidar_points",
    "doppler",
    "times",
    "sigma",
    "simulated",
    *_IMU,
)


def read_scans(path: str | PathLike[str]) -> Scans:
    """Reads scans from a file.

    Parameters
    ----------
    path : path-like
        An ``.npz`` file with these arrays:

        - ``points`` (N, 3): returns, sensor frame, m;
        - ``poses`` (F, 4, 4): T_world_sensor, m;
        - ``frame`` (N,): row of ``poses`` for each return;
        - ``intensity`` (N,), optional: sensor units;
        - ``static`` (N,) bool, optional: only returns with True are used;
        - ``lidar_points`` (M, 3), optional: ground truth, world frame, m;
        - ``simulated``, optional: not 0 if the ground truth is that of a simulator;
        - ``doppler`` (N,), optional: m/s;
        - ``times`` (F,), optional: when each scan was taken, s;
        - ``sigma`` (N, 3), optional: the sensor's own deviations of range, azimuth and elevation, m, rad, rad;
        - ``imu_times`` (G,), ``angular_velocity`` (G, 3), ``specific_force`` (G, 3), ``R_sensor_imu`` (3, 3), all optional: of
          :class:`radarsdf.io.Imu`.

    Returns
    -------
    Scans
        One scan for each row of ``poses`` with at least one return.

    Raises
    ------
    ValueError
        If the file has another format, or its arrays do not fit together.
    OSError
        If the file cannot be read.
    """
    if path_of(path, "path").suffix != ".npz":
        msg = f"{path} is not an .npz file: only .npz files of scans can be read"
        raise ValueError(msg)
    arrays = arrays_of(path, _ARRAYS)
    if missing := sorted({"points", "frame", "poses"} - set(arrays)):
        msg = f"{path} lacks the arrays {', '.join(missing)}"
        raise ValueError(msg)
    points, frame, poses = arrays["points"], arrays["frame"], arrays["poses"]
    count, num_poses = points.shape[:1], poses.shape[:1]
    for name, shape in {
        "points": (*count, 3), "poses": (*num_poses, 4, 4), "frame": count, "intensity": count, "static": count,
        "doppler": count, "times": num_poses, "sigma": (*count, 3),
    }.items():  # fmt: skip
        if name in arrays and arrays[name].shape != shape:
            msg = f"{path}: {name} must have shape {shape}, not {arrays[name].shape}"
            raise ValueError(msg)
    truth = arrays.get("lidar_points", points)
    if truth.ndim != 2 or truth.shape[1] != 3:
        msg = f"{path}: lidar_points must have shape (M, 3), not {truth.shape}"
        raise ValueError(msg)
    for name, array in arrays.items():
        if array.dtype.kind not in ("biuf" if name == "static" else "iuf"):
            msg = f"{path}: {name} must be real numbers, not {array.dtype}"
            raise ValueError(msg)
    imu = _imu(arrays, path)
    if (frame != np.floor(frame)).any():
        msg = f"{path}: frame must hold row numbers of poses"
        raise ValueError(msg)
    if len(frame) and not 0 <= frame.min() <= frame.max() < len(poses):
        msg = f"{path}: frame must lie in [0, {len(poses)})"
        raise ValueError(msg)
    used = arrays.get("static", np.ones(len(frame), bool)).astype(bool)
    frame = frame.astype(np.int64)
    order = np.flatnonzero(used)
    order = order[np.argsort(frame[order], kind="stable")]
    frames, first = np.unique(frame[order], return_index=True)
    rows = np.split(order, first)[1:]  # the part before the first scan is empty
    per_return = {
        name: [arrays[name][r] for r in rows] if name in arrays else None
        for name in ("intensity", "doppler", "sigma")
    }
    return Scans(
        points=[points[r] for r in rows],
        poses=poses[frames].astype(np.float64),
        intensities=per_return["intensity"],
        ground_truth=arrays.get("lidar_points"),
        doppler_mps=per_return["doppler"],
        times_s=arrays["times"][frames].astype(np.float64) if "times" in arrays else None,
        sigmas=per_return["sigma"],
        truth_kind="simulated" if "simulated" in arrays and arrays["simulated"].any() else "lidar",
        imu=imu,
    )


def _imu(arrays: dict[str, NDArray[Any]], path: str | PathLike[str]) -> Imu | None:
    """What the file has of an IMU; None without times or rates."""
    times_s, rates, *others = (arrays.get(name) for name in _IMU)
    if times_s is None or rates is None:
        return None
    try:
        return Imu(times_s, rates, *others)
    except ValueError as error:
        msg = f"{path}: {error}"
        raise ValueError(msg) from error


def array_in(path: Path) -> NDArray[Any]:
    """The array of an ``.npy`` file, as a memory map: a header that claims more than the file holds is refused."""
    check_regular_file(path)
    try:
        array: NDArray[Any] = np.load(path, mmap_mode="r", allow_pickle=False)
    except (ValueError, EOFError) as error:
        msg = f"{path} is not a whole .npy file: {error}"
        raise ValueError(msg) from error
    return array


def arrays_of(path: str | PathLike[str], names: Iterable[str]) -> dict[str, NDArray[Any]]:
    """The arrays of an ``.npz`` file that have these names, in this order. Raises as :func:`read_scans`."""
    check_regular_file(path)
    try:
        return _arrays(Path(path), names)
    except zipfile.BadZipFile as error:
        msg = f"{path} is not a whole .npz file: it is cut off, damaged, or of another kind"
        raise ValueError(msg) from error
    except Exception as error:  # damaged files raise exceptions of many kinds, among them OSError
        msg = f"{path} is not a whole .npz file: {error}"
        raise ValueError(msg) from error


def check_arrays(arrays: Mapping[str, NDArray[Any]], wanted: Mapping[str, tuple[Any, ...]]) -> None:
    """Raises a ValueError unless the wanted arrays are there, each of its type and shape. A length of None is any."""
    for name, (dtype, *shape) in wanted.items():
        array = arrays.get(name)
        fits = array is not None and array.dtype == dtype and array.ndim == len(shape)
        if (
            array is None
            or not fits
            or any(n not in (None, m) for n, m in zip(shape, array.shape, strict=True))
        ):
            msg = f"{name} is missing, or of another type or shape"
            raise ValueError(msg)


def write_arrays(
    path: str | PathLike[str], arrays: Mapping[str, ArrayLike], *, compressed: bool = False
) -> None:
    """Writes the ``.npz`` that :func:`arrays_of` reads, whole or not at all."""
    for name, array in arrays.items():
        if np.asarray(array).dtype.hasobject:
            msg = f"{name} has objects of Python, which are not written"
            raise ValueError(msg)
    file = io.BytesIO()
    save: Callable[..., None] = np.savez_compressed if compressed else np.savez
    save(file, **arrays)
    write_whole(path, file.getvalue())


def holds_scans(path: str | PathLike[str]) -> bool:
    """Whether an ``.npz`` file has poses. Raises as :func:`read_scans`."""
    return bool(arrays_of(path, ["poses"]))


def _arrays(path: Path, wanted: Iterable[str]) -> dict[str, NDArray[Any]]:
    with zipfile.ZipFile(path) as file:
        names = file.namelist()
        members = {name: file.getinfo(f"{name}.npy") for name in wanted if f"{name}.npy" in names}
        unpacked = sum(member.file_size for member in members.values())
        check_unpacked(unpacked, path.stat().st_size, "its arrays")
        arrays = {}
        for name, member in members.items():
            with file.open(member) as stream:
                arrays[name] = np.lib.format.read_array(stream, allow_pickle=False)
        return arrays


def write_scans(path: str | PathLike[str], scans: Scans) -> None:
    """Writes scans as the ``.npz`` file that :func:`read_scans` reads, whole or not at all.

    Parameters
    ----------
    path : path-like
        Where the file goes. ``.npz`` is appended where it is missing.
    scans : Scans
        At least one scan. What is None of it, the file lacks.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    instance(scans, Scans, "scans")
    arrays: dict[str, NDArray[Any]] = {
        "points": np.concatenate(scans.points),
        "frame": np.repeat(np.arange(len(scans.points), dtype=np.int32), [len(p) for p in scans.points]),
        "poses": scans.poses,
    }
    for name, values in (
        ("intensity", scans.intensities), ("doppler", scans.doppler_mps), ("sigma", scans.sigmas)
    ):  # fmt: skip
        if values is not None:
            arrays[name] = np.concatenate(values)
    if scans.times_s is not None:
        arrays["times"] = scans.times_s
    if scans.imu is not None:
        values_of = vars(scans.imu).values()
        arrays |= {name: array for name, array in zip(_IMU, values_of, strict=True) if array is not None}
    if scans.ground_truth is not None:
        arrays["lidar_points"] = scans.ground_truth
        if scans.truth_kind == "simulated":
            arrays["simulated"] = np.array(1, np.uint8)
    target = path_of(path, "path")
    named = target if target.suffix == ".npz" else target.with_name(f"{target.name}.npz")
    write_arrays(named, arrays, compressed=True)
