"""Scans in ``.npz`` files, and arrays in ``.npy`` and ``.npz`` files of any kind."""

import zipfile
import zlib
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from radarsdf.arrays import Array, ArrayLike, Bytes
from radarsdf.checks import AnyPath, check, instance, path_of
from radarsdf.io.files import check_regular_file, reading, whole_file
from radarsdf.rig import Imu
from radarsdf.scans import Scans

# Measurements are mostly noise and compress by a factor of 2 to 5. A file of kilobytes could unpack to gigabytes.
_MAX_COMPRESSION = 100
_ALWAYS_UNPACKED = 1 << 28  # bytes; smaller files are accepted at any compression

_IMU = ("imu_times", "angular_velocity", "specific_force", "R_sensor_imu")  # in the order of Imu's fields
_SHAPES: dict[str, tuple[str | int, ...]] = {
    "points": ("N", 3), "frame": ("N",), "poses": ("F", 4, 4), "intensity": ("N",), "static": ("N",), "doppler": ("N",),
    "times": ("F",), "sigma": ("N", 3), "lidar_points": ("M", 3), "ground_truth": ("M", 3), "sensor": ("F",),
    "sensor_labels": ("K",), "T_body_sensor": ("K", 4, 4),
}  # fmt: skip
TRUTH_ARRAYS = ("lidar_points", "ground_truth")  # the first of these that a file has is used


def read_scans(path: AnyPath) -> Scans:
    """Read scans with poses from an ``.npz`` file.

    Raises a ValueError if the file has another format, or inconsistent arrays, an OSError if it cannot be read.

    Parameters
    ----------
    path : path-like
        An ``.npz`` file with these arrays:

        - ``points`` (N, 3): returns, sensor frame, m;
        - ``poses`` (F, 4, 4): T_world_sensor, m; T_world_body with ``T_body_sensor``;
        - ``frame`` (N,): row of ``poses`` for each return;
        - ``intensity`` (N,), optional: sensor units;
        - ``static`` (N,) bool, optional: only returns with True are used;
        - ``lidar_points`` or ``ground_truth`` (M, 3), optional: ground truth, world frame, m;
        - ``doppler`` (N,), optional: m/s;
        - ``times`` (F,), optional: time of each scan, s;
        - ``sigma`` (N, 3), optional: the sensor's own standard deviations of range, azimuth and elevation, m, rad, rad;
        - ``sensor`` (F,), optional: row of ``sensor_labels`` (K,) str, the radars, for each scan; with their mountings
          ``T_body_sensor`` (K, 4, 4), m, if known;
        - ``imu_times`` (G,), ``angular_velocity`` (G, 3), ``specific_force`` (G, 3), ``R_sensor_imu`` (3, 3), all optional: of
          :class:`radarsdf.io.Imu`.

    Returns
    -------
    Scans
        One scan for each row of ``poses`` with at least one return.
    """
    check(path_of(path, "path").suffix == ".npz", f"{path} is not an .npz file of scans")
    arrays = arrays_of(path, (*_SHAPES, *_IMU))
    missing = sorted({"points", "frame", "poses"} - set(arrays))
    check(not missing, f"{path} lacks the arrays {', '.join(missing)}")
    with reading(path, "a file of scans"):
        _check_scans(arrays)
        times_s, rates, *others = (arrays.get(name) for name in _IMU)
        imu = None if times_s is None or rates is None else Imu(times_s, rates, *others)
    frame = arrays["frame"].astype(np.int64)
    order = np.flatnonzero(arrays["static"]) if "static" in arrays else np.arange(len(frame))
    order = order[np.argsort(frame[order], kind="stable")]
    frames, first = np.unique(frame[order], return_index=True)
    rows = np.split(order, first)[1:]  # np.split's first part, before the first scan, is empty

    def by_scan(name: str) -> list[Array] | None:
        return [arrays[name][r] for r in rows] if name in arrays else None

    labels, mountings = arrays.get("sensor_labels", np.zeros(0)).tolist(), arrays.get("T_body_sensor")
    return Scans(
        points=by_scan("points") or [],
        poses=arrays["poses"][frames].astype(np.float64),
        intensities=by_scan("intensity"),
        ground_truth=next((arrays[name] for name in TRUTH_ARRAYS if name in arrays), None),
        doppler_mps=by_scan("doppler"),
        times_s=arrays["times"][frames].astype(np.float64) if "times" in arrays else None,
        sigmas=by_scan("sigma"),
        imu=imu,
        sensors=[labels[i] for i in arrays["sensor"][frames].astype(int)] if "sensor" in arrays else None,
        T_body_sensor=None if mountings is None else dict(zip(labels, mountings, strict=True)),
    )


def _check_scans(arrays: Mapping[str, Array]) -> None:
    of_lengths = {"N": "points", "F": "poses", "K": "sensor_labels"}
    known = {length: np.shape(arrays.get(name, ()))[:1] for length, name in of_lengths.items()}
    for name, array in arrays.items():
        kinds = {"static": "biuf", "sensor_labels": "U"}.get(name, "iuf")
        check(array.dtype.kind in kinds, f"{name} must be real numbers, not {array.dtype}")
        first, *rest = _SHAPES.get(name, (None, *array.shape[1:]))
        expected = (*known.get(str(first), array.shape[:1]), *rest)
        check(array.shape == expected, f"{name} must have shape {expected}, not {array.shape}")
    for name, of in (("frame", "poses"), ("sensor", "sensor_labels")):
        count = len(arrays.get(of, ()))
        rows = arrays.get(name, np.zeros(count))
        fits = (rows == np.floor(rows)) & (rows >= 0) & (rows < count)
        check(fits.all(), f"{name} must hold row indices of the {count} {of}")


def write_scans(path: AnyPath, scans: Scans) -> None:
    """Write at least one scan as an ``.npz`` file for :func:`read_scans`, atomically.

    ``.npz`` is appended to the path if it is missing, and attributes that are None are omitted. Raises a TypeError if `scans` is
    not a :class:`Scans`, a ValueError if `path` is no regular file, an OSError if it cannot be written.
    """
    instance(scans, Scans, "scans")
    lists = (scans.points, scans.intensities, scans.doppler_mps, scans.sigmas)
    named = zip(("points", "intensity", "doppler", "sigma"), lists, strict=True)
    arrays = {name: np.concatenate(parts) for name, parts in named if parts is not None}
    arrays["frame"] = np.repeat(np.arange(len(scans.points), dtype=np.int32), [len(p) for p in scans.points])
    single = {"poses": scans.poses, "times": scans.times_s, "lidar_points": scans.ground_truth}
    if (rig := scans.rig) is not None:
        single |= {"sensor": rig.of_scan, "sensor_labels": np.array(list(map(str, rig.labels)))}
        single["T_body_sensor"] = rig.T_body_sensor
    if scans.imu is not None:
        single |= dict(zip(_IMU, vars(scans.imu).values(), strict=True))
    arrays |= {name: array for name, array in single.items() if array is not None}
    target = path_of(path, "path")
    target = target if target.suffix == ".npz" else target.with_name(f"{target.name}.npz")
    write_arrays(target, arrays, compressed=True)


def array_in(path: Path) -> Array:
    """Map the array of an ``.npy`` file into memory; a header that claims more than the file holds is refused."""
    check_regular_file(path)
    with reading(path, "a complete .npy file", EOFError):
        return np.asarray(np.load(path, mmap_mode="r", allow_pickle=False))


def arrays_of(path: AnyPath, names: Iterable[str]) -> dict[str, Array]:
    """Read those of the named arrays that an ``.npz`` file has, in this order. Raises the errors of :func:`read_scans`."""
    check_regular_file(path)
    arrays = {}
    # Damaged files raise exceptions of many kinds, including OSError.
    with reading(path, "a complete .npz file", Exception), zipfile.ZipFile(path) as file:
        held = set(file.namelist())
        members = {name: file.getinfo(f"{name}.npy") for name in names if f"{name}.npy" in held}
        unpacked = sum(member.file_size for member in members.values())
        largest = max(_ALWAYS_UNPACKED, _MAX_COMPRESSION * Path(path).stat().st_size)
        check(unpacked <= largest, f"its arrays would unpack to {unpacked} bytes: measurements compress less")
        for name, member in members.items():
            with file.open(member) as stream:
                arrays[name] = np.lib.format.read_array(stream, allow_pickle=False)
    return arrays


def check_arrays(arrays: Mapping[str, Array], wanted: Mapping[str, tuple[Any, ...]]) -> None:
    """Raise a ValueError unless the wanted arrays exist with their type and shape. A length of None matches any."""
    for name, (dtype, *shape) in wanted.items():
        array = arrays.get(name, np.zeros(0, "O"))
        fits = array.dtype == dtype and array.ndim == len(shape)
        fits = fits and all(n in (None, m) for n, m in zip(shape, array.shape, strict=True))
        check(fits, f"{name} is missing, or of another type or shape")


def write_arrays(path: AnyPath, arrays: Mapping[str, ArrayLike], *, compressed: bool = False) -> None:
    """Write an ``.npz`` file for :func:`arrays_of`, atomically."""
    save: Callable[..., None] = np.savez_compressed if compressed else np.savez
    with whole_file(path) as file:
        save(file, **arrays)
        # The zip format has a CRC of each array, but none of its own headers: it is the comment of the archive.
        file.flush()
        comment = _comment(np.memmap(file, np.uint8, "r")[:-2])
        file.seek(-2, 2)  # the length of the comment
        file.write(comment)


def check_archive(path: AnyPath) -> None:
    """Raise a ValueError if a file of :func:`write_arrays` differs from what was written."""
    content = np.memmap(path, np.uint8, "r")
    size = len(_comment(content[:0]))
    check(content[-size:].tobytes() == _comment(content[:-size]), "its checksum is wrong")


def _comment(content: Bytes) -> bytes:
    return b"\x08\0%08x" % zlib.crc32(content.data)
