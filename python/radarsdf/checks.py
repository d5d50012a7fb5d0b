"""Validation of numbers and arrays from users. Errors name the argument."""

import math
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeAlias, TypeVar, cast

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from radarsdf.arrays import Array, ArrayLike, Bools, Floats

# Largest coordinate: squares of it, and products of three, are far from overflow in float64.
MAX_POSITION_M = 1e12
# Latest time before or after 0: times since 1970 in milliseconds or smaller units are beyond it.
MAX_TIME_S = 1e11
MISSING_POSES = (
    "poses are missing: T_world_sensor (4, 4) of each scan; "
    "radarsdf.odometry(points, doppler_mps=..., times_s=...) finds them"
)

AnyPath: TypeAlias = str | os.PathLike[str]
_Error: TypeAlias = type[Exception]

_Kind = TypeVar("_Kind")

_MAX_ROTATION_ERROR = 1e-3  # largest entry of R R^T - 1. float32 poses pass; scaled or sheared ones do not
_RIGID = f"rotation, translation within {MAX_POSITION_M:g} m, last row 0 0 0 1"


def check(holds: object, message: str, error: _Error = ValueError) -> None:
    """Raise an `error` with this message unless `holds`."""
    if not holds:
        raise error(message)


@contextmanager
def restating(
    message: str, *errors: _Error, kind: _Error = ValueError, unless: _Error | tuple[()] = ()
) -> Iterator[None]:
    """Turn `errors` raised in the block, `unless` they are of that type, into a `kind` with this message before theirs."""
    try:
        yield
    except unless:
        raise
    except errors as error:
        msg = f"{message}: {error}"
        raise kind(msg) from error


def real_array(values: Any, name: str, dtype: Any = np.float64) -> Array:
    """Convert to an array of `dtype` and any shape, without a copy if it is one already.

    Raises a TypeError for anything but real numbers, and a ValueError for masked values and integers too large for float64.
    """
    array = values
    if type(values) is not np.ndarray or values.dtype.kind not in "biuf":  # arrays need no checks
        refuse_masked(values, name)
        must = f"{name} must be real numbers, and all rows equally long"
        kinds = TypeError, ValueError, RuntimeError  # the last of a tensor that requires a gradient
        with restating(name, OverflowError), restating(must, *kinds, kind=TypeError):
            array = np.asarray(values)
            if array.dtype.kind == "O":  # numbers of other types, or integers with many digits
                array = array.astype(np.float64)
        _check_type(array.dtype.kind in "biuf", name, "real numbers", array.dtype)
    with np.errstate(over="ignore"):  # overflow becomes infinite, which callers refuse
        return array.astype(dtype, copy=False)


def refuse_masked(values: Any, name: str) -> None:
    """Refuse masked values: NumPy would use the data under the mask."""
    parts = values if isinstance(values, (list, tuple)) else [values]
    masked = any(isinstance(part, np.ma.MaskedArray) and np.ma.is_masked(part) for part in parts)
    check(not masked, f"{name} has masked values: leave them out")


def positions(values: ArrayLike, name: str) -> Floats:
    """Convert to finite positions (N, 3), m, in C order."""
    points: Floats = np.ascontiguousarray(real_array(values, name))
    check(points.ndim == 2 and points.shape[1] == 3, f"{name} must be (N, 3), not {points.shape}")
    check((np.abs(points) <= MAX_POSITION_M).all(), f"{name} must be finite, and within {MAX_POSITION_M:g} m")
    return points


def check_box(box: ArrayLike) -> Floats:
    """Validate a lower and an upper corner (2, 3), world, m."""
    corners = real_array(box, "box")
    ordered = corners.shape == (2, 3) and (corners[0] < corners[1]).all()
    check(ordered, "box must be a lower and an upper corner, (2, 3), the lower corner first")
    return positions(corners, "box")


def check_scan_shape(scan: Array, number: int) -> None:
    check(scan.ndim == 2 and scan.shape[1] == 3, f"scan {number} must have shape (N, 3), not {scan.shape}")


def values_of_scans(
    given: Iterable[Any],
    scans: Sequence[Array],
    name: str,
    convert: Callable[[Any, str], Array] = real_array,
    *columns: int,
) -> list[Array]:
    """Convert to one array (N, *columns) for each scan (N, 3). Raise a TypeError or a ValueError if they do not match."""
    each = enumerate(one_for_each_scan(given, name))
    values = [convert(value, f"{name} of scan {i}") for i, value in each]
    check(len(values) == len(scans), f"{name} holds {len(values)} scans, points {len(scans)}")
    for i, (value, scan) in enumerate(zip(values, scans, strict=True)):
        check_values_of_scan(value, scan, name, i, *columns)
    return values


def check_values_of_scan(value: Array, scan: Array, name: str, number: int, *columns: int) -> None:
    shape = len(scan), *columns
    check(value.shape == shape, f"{name} of scan {number} must have shape {shape}, not {value.shape}")


def pose_matrices(poses: ArrayLike, num_scans: int | None = None) -> Floats:
    """Convert to an array (F, 4, 4) float64 of any numbers."""
    T_world_sensor: Floats = real_array(poses, "poses")
    shape = T_world_sensor.shape
    count = (shape or (0,))[0] if num_scans is None else num_scans
    check(shape == (count, 4, 4), f"poses must have shape ({count}, 4, 4), one per scan, not {shape}")
    return T_world_sensor


def check_pose(pose: Any, name: str) -> Floats:
    """Convert to a rigid transform (4, 4) float64 T_a_b, m."""
    matrix: Floats = real_array(pose, name)
    check(matrix.shape == (4, 4), f"{name} must have shape (4, 4), not {matrix.shape}")
    check(are_rigid(matrix[None]).all(), f"{name} is not a rigid transform ({_RIGID})")
    return matrix


def check_poses(poses: ArrayLike, num_scans: int | None = None) -> Floats:
    """Convert to rigid transforms (F, 4, 4) float64 T_world_sensor, m, one per scan if the number of scans is given."""
    T_world_sensor = pose_matrices(poses, num_scans)
    rigid = are_rigid(T_world_sensor)
    check(rigid.all(), f"pose {int(np.argmin([*rigid, False]))} is not a rigid transform ({_RIGID})")
    return T_world_sensor


def usable_poses(poses: ArrayLike, num_scans: int | None = None) -> tuple[Floats, Bools]:
    """:func:`check_poses`, except that a minority of non-rigid poses is interpolated, and False in the mask (F,)."""
    T_world_sensor = pose_matrices(poses, num_scans)
    rigid = are_rigid(T_world_sensor)
    if rigid.all() or 2 * np.count_nonzero(rigid) <= len(rigid):
        return check_poses(T_world_sensor), rigid
    known = np.flatnonzero(rigid)
    rotations = Slerp(known, Rotation.from_matrix(T_world_sensor[known, :3, :3]))
    at = np.clip(np.arange(len(rigid)), known[0], known[-1])
    filled = interpolated_poses(at, rotations, T_world_sensor[known, :3, 3])
    return np.where(rigid[:, None, None], T_world_sensor, filled), rigid


def interpolated_poses(at: Array, rotations: Slerp, positions: Floats) -> Floats:
    """Interpolate poses (N, 4, 4): `rotations` at times `at` (N,), and positions (P, 3) at the times of the rotations linearly."""
    poses = np.tile(np.eye(4), (len(at), 1, 1))
    poses[:, :3, :3] = rotations(at).as_matrix()
    poses[:, :3, 3] = np.stack([np.interp(at, rotations.times, column) for column in positions.T], 1)
    return poses


def are_rigid(poses: Floats) -> Bools:
    """Mask (F,) of the matrices (F, 4, 4) that are rigid transforms."""
    rotation = poses[:, :3, :3]
    with np.errstate(all="ignore"):  # non-finite matrices are not rigid
        rotation_error = np.abs(rotation @ rotation.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
        return (
            (np.abs(poses) <= MAX_POSITION_M).all(axis=(1, 2))
            & (rotation_error < _MAX_ROTATION_ERROR)
            & (np.linalg.det(rotation) > 0)
            & (poses[:, 3] == [0, 0, 0, 1]).all(axis=1)
        )


def instance(value: Any, kind: type[_Kind], name: str) -> _Kind:
    _check_type(isinstance(value, kind), name, f"a {kind.__name__}", value)
    return cast(_Kind, value)


def one_for_each_scan(values: Any, name: str) -> Iterable[Any]:
    """Return `values` if they are iterable, else raise a TypeError."""
    one_by_one = hasattr(values, "__iter__") or hasattr(values, "__getitem__")
    has_rows = one_by_one and getattr(values, "ndim", 1) != 0
    _check_type(has_rows, name, "a list of arrays, one per scan", values)
    return cast(Iterable[Any], values)


def path_of(value: Any, name: str) -> Path:
    _check_type(isinstance(value, (str, os.PathLike)), name, "a path", value)
    return Path(value)


def flag(value: Any, name: str) -> bool:
    _check_type(isinstance(value, (bool, np.bool_)), name, "True or False", value)
    return bool(value)


def hides_bar(progress: bool | None) -> bool | None:
    """tqdm's `disable`, for a bar that is wanted (True), unwanted (False), or only wanted on a terminal (None).

    A service, or a command after ``2>&-``, has no standard error and thus never a bar.
    """
    if sys.stderr is None or getattr(sys.stderr, "closed", False):
        return True
    return None if progress is None else not flag(progress, "progress")


def whole_number(value: Any, name: str, lowest: int, highest: int = 2**63 - 1) -> int:
    """Convert to an int, `lowest` ≤ value ≤ `highest`."""
    is_whole = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
    _check_type(is_whole, name, "a whole number", value)
    least = "positive" if lowest == 1 else f"at least {lowest}"
    check(lowest <= value <= highest, f"{name} must be {least} and at most {highest}, not {value!r:.50}")
    return int(value)


def positive(value: Any, name: str) -> float:
    return _scalar(value, name, "positive and finite", lambda x: 0 < x < np.inf)


def not_negative(value: Any, name: str) -> float:
    return _scalar(value, name, "at least 0 and finite", lambda x: 0 <= x < np.inf)


def number(value: Any, name: str) -> float:
    """Convert to a float. Infinity is allowed, NaN is not."""
    return _scalar(value, name, "a number", lambda x: not math.isnan(x))


def _scalar(value: Any, name: str, wanted: str, fits: Callable[[float], bool]) -> float:
    array = real_array(value, name)
    check(array.shape == () and fits(float(array)), f"{name} must be {wanted}, not {value!r:.50}")
    return float(array)


def _check_type(holds: bool, name: str, wanted: str, value: Any) -> None:
    found = repr(value) if isinstance(value, (str, bytes, int, float, type(None))) else type(value).__name__
    check(holds, f"{name} must be {wanted}, not {found:.50}", TypeError)
