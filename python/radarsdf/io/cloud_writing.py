"""Write all returns of all scans as one point cloud in the world frame; also the parts of PLY files."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from radarsdf.arrays import Array
from radarsdf.checks import AnyPath
from radarsdf.extras import require
from radarsdf.io.clouds import LAS_INTENSITY
from radarsdf.io.fields import SIGMA, columns_of
from radarsdf.io.files import check_fits_float32, checked_suffix, whole_file
from radarsdf.scans import Columns, Scans

_CSV_FORMATS = {"f8": "%.17g", "f4": "%.9g", "i4": "%d"}  # enough digits for a round trip
_LAS_SCALE_M = 1e-4
_LAS_FORMAT = 6  # the first of LAS 1.4, with a time
_PLY_TYPES = {"f4": "float", "f8": "double", "u1": "uchar", "i4": "int"}


def write_cloud(path: AnyPath, scans: Scans) -> int:
    """Write all returns of scans as one point cloud, atomically.

    The cloud has x, y, z in the world frame, m; intensity in sensor units, doppler in m/s and time, s, if all scans have
    them; and scan, the index of the scan.
    Coordinates are float64. LAS and LAZ round them to 0.1 mm, and store the other columns as extra dimensions. PCD holds
    float32, since most programs read nothing else.

    Parameters
    ----------
    path : path-like
        A file that ends in .ply, .pcd, .las, .laz, .npy or .csv. An .npy file holds one record per return.
    scans : Scans
        Scans, read once.

    Returns
    -------
    int
        Number of returns.

    Raises
    ------
    ValueError
        For another suffix, if `path` is no regular file, the scans cannot be read, or float32 is too coarse.
    OSError
        If a file cannot be read or written.
    ImportError
        If the format needs a library that is not installed; the message names it.
    """
    suffix = checked_suffix(path, CLOUD_OUT_SUFFIXES, "point clouds to write")
    parts = []
    for number, scan in enumerate(scans):
        columns = columns_of(scan, scan.world_points) | {"scan": np.full(len(scan), number, np.int32)}
        parts.append(columns if scan.time_s is None else columns | {"time": np.full(len(scan), scan.time_s)})
    names = [name for name in parts[0] if name not in SIGMA and all(name in part for part in parts)]
    columns = {name: np.concatenate([part[name] for part in parts]) for name in names}
    in_single = {"intensity", "doppler"}
    if suffix == ".pcd":
        check_fits_float32(path, np.stack([columns[axis] for axis in "xyz"], axis=1))
        in_single |= set("xyz")
    columns |= {name: columns[name].astype(np.float32) for name in in_single & set(names)}
    with whole_file(path) as file:
        _WRITERS[suffix](file, records(columns))
    return len(columns["scan"])


def _ply(file: BinaryIO, rows: Array) -> None:
    file.write(ply_header(rows.dtype, len(rows)) + rows.tobytes())


def _pcd(file: BinaryIO, rows: Array) -> None:
    names = rows.dtype.names or ()
    kinds = [rows.dtype[name].str[1:] for name in names]
    header = f"""\
# .PCD v0.7, radarsdf: world frame, m
VERSION 0.7
FIELDS {" ".join(names)}
SIZE {" ".join(kind[1] for kind in kinds)}
TYPE {" ".join(kind[0].upper() for kind in kinds)}
COUNT {" ".join("1" for _ in kinds)}
WIDTH {len(rows)}
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS {len(rows)}
DATA binary
"""
    file.write(header.encode("ascii") + rows.tobytes())


def _csv(file: BinaryIO, rows: Array) -> None:
    names = rows.dtype.names or ()
    formats = ",".join(_CSV_FORMATS[rows.dtype[name].str[1:]] for name in names)
    np.savetxt(file, rows, formats, header=",".join(names), comments="")


def _las(compressed: bool, file: BinaryIO, rows: Array) -> None:
    laspy = require("laspy", what="LAS and LAZ files are written by")
    as_names = {"intensity": LAS_INTENSITY, "time": "gps_time"}
    header = laspy.LasHeader(point_format=_LAS_FORMAT, version="1.4")
    extra = [name for name in rows.dtype.names or () if name not in ("x", "y", "z", "time")]
    header.add_extra_dims([laspy.ExtraBytesParams(as_names.get(n, n), rows.dtype[n]) for n in extra])
    header.offsets = np.round([rows[axis].mean() for axis in "xyz"])
    header.scales = np.full(3, _LAS_SCALE_M)
    header.global_encoding.wkt = True  # required for formats 6 and above
    points = laspy.ScaleAwarePointRecord.zeros(len(rows), header=header)
    points["return_number"] = points["number_of_returns"] = np.ones(len(rows), np.uint8)  # of each pulse
    for name in rows.dtype.names or ():
        points[as_names.get(name, name)] = rows[name]
    with laspy.open(file, mode="w", header=header, closefd=False, do_compress=compressed) as writer:
        writer.write_points(points)


def records(columns: Columns) -> Array:
    """(N,) one record per row of the columns, of which there must be at least one."""
    dtype = np.dtype([(name, array.dtype.newbyteorder("<")) for name, array in columns.items()])
    return np.rec.fromarrays(list(columns.values()), dtype).view(dtype, np.ndarray)


def face_records(faces: NDArray[np.integer[Any]]) -> Array:
    """(T,) one record per triangle (T, 3), as in a binary PLY file."""
    rows = np.zeros(len(faces), np.dtype([("count", "u1"), ("rows", "<i4", (3,))]))
    rows["count"], rows["rows"] = 3, faces
    return rows


def ply_header(dtype: np.dtype[Any], count: int, num_faces: int | None = None) -> bytes:
    """Header of a binary PLY file of `count` such records, and of triangles if it is a mesh."""
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += ["comment radarsdf: world frame, m", f"element vertex {count}"]
    lines += [f"property {_PLY_TYPES[dtype[name].str[1:]]} {name}" for name in dtype.names or ()]
    if num_faces is not None:
        lines += [f"element face {num_faces}", "property list uchar int vertex_indices"]
    return ("\n".join([*lines, "end_header"]) + "\n").encode("ascii")


_WRITERS: dict[str, Callable[[BinaryIO, Array], None]] = {
    ".ply": _ply,
    ".pcd": _pcd,
    ".las": partial(_las, False),
    ".laz": partial(_las, True),
    ".npy": np.save,
    ".csv": _csv,
}

CLOUD_OUT_SUFFIXES = tuple(_WRITERS)
