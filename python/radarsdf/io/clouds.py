"""Point cloud files: PCD, PLY, KITTI's .bin, NumPy, text, LAS and LAZ. Readers return named columns; the parts of PLY files."""

import io
import re
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from radarsdf.arrays import Array, Floats, Floats32
from radarsdf.checks import AnyPath, check, path_of
from radarsdf.extras import require
from radarsdf.io.columns import SIGMA, Fields, as_numbers, columns_of, names_of, read_table
from radarsdf.io.files import check_fits_float32, check_regular_file, checked_suffix, reading, whole_file
from radarsdf.io.npz import array_in
from radarsdf.scans import Columns, Notes, Scans

TEXT_SUFFIXES = (".csv", ".txt", ".xyz")
LAS_INTENSITY = "radar_intensity"  # an extra dimension, since LAS's own is an integer from 0 to 65535
_PANIC = "PanicException"  # raised by lazrs, which is written in Rust; not a subclass of Exception
_MAX_COMPRESSION = 200  # LAZ packs lidar points to a tenth of their size
_VLRS_AT, _VLR_BYTES = 100, 54  # offset of the number of records in a LAS header, and the smallest record
_LAZ_LAYERS = {6: 9, 7: 10, 8: 11, 9: 10, 10: 12}  # layers of a chunk by point format, plus extra bytes
_VARIABLE = 2**32 - 1  # marks chunks of varying size, in place of the number of points per chunk
_MAX_HEADER_LINES, _MAX_LINE = 64, 1 << 16  # a PCD header has eleven lines
_PCD_TYPES = {f"<{kind}{size}" for kind in "iuf" for size in (1, 2, 4, 8)} - {"<f1"}
_LITERALS = 32  # a control byte below this precedes that many literal bytes, plus one
_LONG = 7  # largest length of three bits: the next byte is added to it
_KITTI_WIDTH, _INSPECTED_FILES = 4, 20  # columns, and number of .bin files that are inspected
_MAX_POSITION_M, _DAMAGED = 1e7, 0.02  # limit of coordinates, and share of numbers that may be damaged
_VARIANCE_RATIO, _MIN_ROWS = 0.8, 30  # limit of the variance left by another width

GivenColumns: TypeAlias = int | Sequence[str] | None
_CSV_FORMATS = {"f8": "%.17g", "f4": "%.9g", "i4": "%d"}  # enough digits for a round trip
_LAS_SCALE_M = 1e-4
_LAS_FORMAT = 6  # the first of LAS 1.4, with a time
_PLY_TYPES = {"f4": "float", "f8": "double", "u1": "uchar", "i4": "int"}


def read_columns(path: Path, columns: GivenColumns = None) -> Columns:
    """Read the columns of a point cloud file, (N,) each, by name."""
    check_regular_file(path)
    suffix = path.suffix.lower()
    check(suffix in READERS, f"{path} is not a point cloud file: those end in {', '.join(CLOUD_SUFFIXES)}")
    try:
        return READERS[suffix](path, columns)
    except BaseException as error:  # damaged files raise many kinds, including OSError
        of_system = isinstance(error, OSError) and error.filename is not None
        of_data = isinstance(error, Exception) or type(error).__name__ == _PANIC
        if of_system or not of_data or isinstance(error, (ImportError, MemoryError)):
            raise
        msg = f"{path} is not a complete {suffix} file of points: {error}"
        raise ValueError(msg) from error


def read_points(path: AnyPath) -> Floats:
    """Read points, such as ground truth from a lidar, from a PCD, PLY, LAS, LAZ, ``.bin``, ``.npy`` or text file.

    Raises a ValueError if the file is damaged, of another kind, or holds no points, an OSError if it cannot be read, and an
    ImportError that names a missing library.

    Returns
    -------
    (M, 3) float64 ndarray
        Finite points, m, in the frame of the file; for a PCD file, the frame to which its ``VIEWPOINT`` transforms.
    """
    file = path_of(path, "path")
    columns = read_columns(file)
    with reading(path, "a file of points"):
        fields = Fields.of(list(columns), dict.fromkeys(("intensity", "doppler"))).with_unit(columns, Notes())
        points = fields.scan(columns, np.eye(4), None, Notes()).points.astype(np.float64)
        check(len(points), "it holds no points")
    if file.suffix.lower() == ".pcd":
        T_world_sensor = read_viewpoint(file)
        points = points @ T_world_sensor[:3, :3].T + T_world_sensor[:3, 3]
    return points


def _bin(path: Path, columns: GivenColumns) -> Columns:
    """Read float32 x, y, z, intensity as in KITTI, or the columns that the user names."""
    if columns is None:
        check_kitti([path])
    width = columns if isinstance(columns, int) else len(columns or range(_KITTI_WIDTH))
    numbers = np.fromfile(path, "<f4")
    whole = path.stat().st_size % (4 * width) == 0
    check(whole, f"its size is not a multiple of {width} float32 per point: give columns (--columns)")
    return dict(zip(names_of(width, columns), numbers.reshape(-1, width).T, strict=True))


def check_kitti(paths: Sequence[Path]) -> None:
    """Raise a ValueError if ``.bin`` files of a recording do not look like points of four float32."""
    paths = [path for path in paths if path.stat().st_size][:_INSPECTED_FILES]
    fitting = [path for path in paths if path.stat().st_size % (4 * _KITTI_WIDTH) == 0]
    remedy = "give columns (--columns), how many float32 a point has, or their names"
    check(2 * len(fitting) >= len(paths), f"most .bin files are not points of four float32 each: {remedy}")
    numbers = np.concatenate([np.zeros(0, "<f4"), *(np.fromfile(path, "<f4") for path in fitting)])
    positions = numbers.reshape(-1, _KITTI_WIDTH)[:, :3]
    far = np.abs(positions[np.isfinite(positions)]) > _MAX_POSITION_M
    check(far.sum() <= _DAMAGED * far.size, f"numbers in the .bin files are not positions in m: {remedy}")
    # Numbers within a column are similar. Logarithms keep a single column from dominating the variance.
    numbers = np.nan_to_num(np.sign(numbers) * np.log1p(np.abs(numbers)))
    within = _variance(numbers, _KITTI_WIDTH)
    for width in range(3, min(21, len(numbers) // 2 + 1)):
        other, few = _variance(numbers, width), len(numbers) < _MIN_ROWS * width
        like_four = other >= _VARIANCE_RATIO * within or (few and other)
        check(like_four, f"the numbers of the .bin files look like {width} columns, not four: {remedy}")


def _variance(numbers: Floats32, width: int) -> float:
    return float(numbers[: len(numbers) // width * width].reshape(-1, width).var(axis=0).mean())


def _npy(path: Path, columns: GivenColumns) -> Columns:
    array = array_in(path)
    if array.dtype.names is not None and array.ndim == 1:
        check(not columns, "it has names of columns: leave out columns (--columns)")
        return {name: array[name] for name in array.dtype.names}
    rows = array.ndim == 2 and array.dtype.kind in "iuf"
    check(rows, f"it holds an array {array.shape} of {array.dtype}, not one row of numbers per point")
    return dict(zip(names_of(array.shape[1], columns), np.array(array).T, strict=True))


def _text(path: Path, columns: GivenColumns) -> Columns:
    heads, values = read_table(path)
    width = values.shape[1]
    # CloudCompare writes the column names after a comment sign.
    named = [head for head in heads if len(head) == width and not any(map(str.isdecimal, head))]
    names = named[-1] if named else names_of(width or 3, columns)
    values = values if len(values) else np.zeros((0, len(names)))
    check(values.shape[1] == len(names), f"its header has {len(names)} names for {values.shape[1]} columns")
    check(not (named and columns), "it has names of columns: leave out columns (--columns)")
    return {name: column for name, column in zip(names, values.T, strict=True) if names.count(name) == 1}


def _pcd(path: Path, _: GivenColumns) -> Columns:
    """Read the scalar fields of files up to version 0.7: pointclouds.org/documentation/tutorials/pcd_file_format.html."""
    with path.open("rb") as file:
        header = _pcd_header(file)
        body = file.read()
    names, points = header["FIELDS"], int(header["WIDTH"][0]) * int(header["HEIGHT"][0])
    counts = [int(count) for count in header.get("COUNT", ["1"] * len(names))]
    sizes = [int(size) * count for size, count in zip(header["SIZE"], counts, strict=True)]
    starts, step = np.cumsum([0, *sizes]).tolist(), sum(sizes)
    kinds = [f"<{kind.lower()}{size}" for kind, size in zip(header["TYPE"], header["SIZE"], strict=True)]
    # The name _ means padding, and several fields may have it. Others may have any type, size and count.
    scalars = [i for i, n in enumerate(counts) if n == 1 and kinds[i] in _PCD_TYPES and names[i] != "_"]
    form = header["DATA"][0]
    check(form in ("ascii", "binary", "binary_compressed"), f"its DATA is {form}: save it as binary")
    if form == "binary":
        table = np.frombuffer(body, np.uint8, points * step).reshape(points, step)
        return {names[i]: table[:, starts[i] : starts[i + 1]].copy().view(kinds[i])[:, 0] for i in scalars}
    if form == "binary_compressed":  # one field after another
        packed, unpacked = np.frombuffer(body, "<u4", 2).tolist()
        check(unpacked == points * step, f"its {unpacked} unpacked bytes are not {points} points of {step}")
        data = unpack_lzf(body[8 : 8 + packed], unpacked)
        return {names[i]: np.frombuffer(data, kinds[i], points, points * starts[i]) for i in scalars}
    words = np.array(body.split()).reshape(points, sum(counts))
    return {names[i]: as_numbers(words[:, sum(counts[:i])]) for i in scalars}


def unpack_lzf(data: bytes, size: int) -> bytes:
    """Unpack `size` bytes of LZF, by which PCL compresses. Raises a ValueError if the data are damaged."""
    out, at = bytearray(), 0
    end = data + bytes(3)  # padding, for truncated streams
    while at < len(data) and len(out) <= size:
        control, at = end[at], at + 1
        if control < _LITERALS:
            out += data[at : at + control + 1]
            at += control + 1
            continue
        length, distance = control >> 5, (control & 0x1F) << 8
        if length == _LONG:
            length, at = length + end[at], at + 1
        length, distance, at = length + 2, distance + end[at] + 1, at + 1
        check(distance <= len(out), "its compressed data are damaged")
        part = out[len(out) - distance :][:length]  # repeated below if the copy overlaps its own output
        out += (part * (length // len(part) + 1))[:length]
    check(len(out) == size and at == len(data), f"its compressed data do not unpack to {size} bytes")
    return bytes(out)


def read_viewpoint(path: Path) -> Floats:
    """T_world_sensor (4, 4) of a PCD file's ``VIEWPOINT`` (tx ty tz qw qx qy qz); the identity if it has none."""
    with path.open("rb") as file:
        numbers = np.array(_pcd_header(file).get("VIEWPOINT", [0, 0, 0, 1, 0, 0, 0]), np.float64)
    finite = numbers.shape == (7,) and np.isfinite(numbers).all()
    check(finite, f"{path}: its VIEWPOINT is not seven finite numbers")
    T_world_sensor = np.eye(4)
    T_world_sensor[:3, 3] = numbers[:3]
    if numbers[3:].any():  # some programs write zeros for an unknown rotation
        T_world_sensor[:3, :3] = Rotation.from_quat(numbers[[4, 5, 6, 3]]).as_matrix()
    return T_world_sensor


def _pcd_header(file: BinaryIO) -> dict[str, list[str]]:
    """Lines of a header by their first word. Comments may be in any encoding."""
    header: dict[str, list[str]] = {}
    for _ in range(_MAX_HEADER_LINES):
        line = file.readline(_MAX_LINE).lstrip()
        if line and not line.startswith(b"#"):
            key, *words = line.decode("ascii").split()
            header[key] = words
        if "DATA" in header:
            break
    return header


def ply_bytes(path: Path) -> io.BytesIO:
    """Load a PLY file for trimesh, without the comments of its header, which may be in any encoding."""
    head, end, body = path.read_bytes().partition(b"end_header")
    return io.BytesIO(re.sub(rb"(?<=[\r\n])(comment|obj_info)\b[^\r\n]*[\r\n]+", b"", head) + end + body)


def _ply(path: Path, _: GivenColumns) -> Columns:
    import trimesh  # noqa: PLC0415 - takes long, and few files need it

    # Without materials: a PLY file may name an image, which must not be opened.
    loaded: Any = trimesh.load(ply_bytes(path), file_type="ply", process=False, skip_materials=True)
    vertex = loaded.metadata.get("_ply_raw", {}).get("vertex")
    if vertex is None or not vertex["length"]:
        return {axis: np.zeros(0) for axis in "xyz"}
    data = vertex["data"]
    names = data.keys() if isinstance(data, dict) else data.dtype.names
    columns = {str(name): np.asarray(data[name]) for name in names}
    whole = {name: column.reshape(-1) for name, column in columns.items() if column.size == vertex["length"]}
    check(whole, f"its header claims {vertex['length']} points, but it holds fewer")
    return whole  # without lists


def _las(path: Path, _: GivenColumns) -> Columns:
    """Read columns by name; files of :func:`write_cloud` give back its names."""
    laspy = require("laspy", what=f"{path}: LAS and LAZ files are read by")
    size = path.stat().st_size
    with path.open("rb") as raw:
        raw.seek(_VLRS_AT)
        records = int.from_bytes(raw.read(4), "little")
    # laspy would loop up to four billion times.
    check(records * _VLR_BYTES <= size, f"its header claims {records} records: the file is too small")
    # Of laspy's two LAZ readers, the parallel one allocates by sizes that cannot be checked beforehand.
    with laspy.open(path, laz_backend=laspy.LazBackend.Lazrs, read_evlrs=False) as file:
        header = file.header
        largest = size * (_MAX_COMPRESSION if header.are_points_compressed else 1)
        fits = header.point_count * header.point_format.size <= largest
        check(fits, f"its header claims {header.point_count} points: the file is too small")
        if header.are_points_compressed:
            check(_has_chunks(path, header), "its chunks of points are damaged, or it is too small for them")
        cloud = file.read_points(header.point_count)
    # Scaled and offset, in double precision: the integers in the file are not metres.
    columns = {axis: np.asarray(getattr(cloud, axis), np.float64) for axis in "xyz"}
    names = {"intensity": "intensity", "gps_time": "time"}
    names |= {name: str(name) for name in header.point_format.extra_dimension_names}
    names |= {LAS_INTENSITY: "intensity"}
    known = set(header.point_format.dimension_names)
    return columns | {as_name: np.asarray(cloud[name]) for name, as_name in names.items() if name in known}


def _has_chunks(path: Path, header: Any) -> bool:
    """Whether a LAZ file is large enough for its chunks: lazrs allocates for them, and may abort the process."""
    import lazrs  # noqa: PLC0415 - an extra

    point, size, at = header.point_format, path.stat().st_size, header.offset_to_point_data
    record = bytes(header.vlrs.get("LasZipVlr")[0].record_data)
    usual = bytes(lazrs.LazVlr.new_for_compression(point.id, point.num_extra_bytes).record_data())
    # Compressor, then type, size and version of each item of a point.
    parts, usual_parts = (np.frombuffer(data[34:], "<u2").reshape(-1, 3)[:, :2] for data in (record, usual))
    possible = record[:2] == usual[:2] and np.array_equal(parts, usual_parts)
    layers = _LAZ_LAYERS.get(point.id, 0) + point.num_extra_bytes
    with path.open("rb") as file:
        for place in (at, size - 8):  # offset of the chunk table: before the points or at the end
            file.seek(place)
            table_at = int.from_bytes(file.read(8), "little", signed=True)
            if table_at > at:
                file.seek(min(table_at, size))
                chunks = int.from_bytes(file.read(8)[4:], "little")  # each begins with an uncompressed point
                possible &= table_at + 8 <= size and chunks * point.size <= size
                possible &= chunks <= max(header.point_count, 1)
                break
        chunk_size, left, at = int.from_bytes(record[12:16], "little"), header.point_count, at + 8
        # A chunk begins with the first point, the number of points, and the sizes of its layers.
        while possible and left > 0 and point.id in _LAZ_LAYERS:
            file.seek(at + point.size)
            count, *sizes = np.frombuffer(file.read(4 * (1 + layers)), "<u4").tolist() or [0]
            at += point.size + 4 * (1 + layers) + sum(sizes)
            expected = count if chunk_size == _VARIABLE else min(chunk_size, left)
            possible = len(sizes) == layers and at <= size and 0 < count == expected
            left -= count
    return possible


READERS: dict[str, Callable[[Path, GivenColumns], Columns]] = {
    ".pcd": _pcd,
    ".ply": _ply,
    ".las": _las,
    ".laz": _las,
    ".bin": _bin,
    ".npy": _npy,
    **dict.fromkeys(TEXT_SUFFIXES, _text),
}

CLOUD_SUFFIXES = tuple(READERS)
UNNAMED = (".bin", ".npy", *TEXT_SUFFIXES)  # formats whose columns may have no names


def write_cloud(path: AnyPath, scans: Scans) -> int:
    """Write all returns of scans as one point cloud, atomically.

    The cloud has x, y, z in the world frame, m; scan, the index of the scan; and, if all scans have them, intensity in sensor
    units, doppler in m/s, and time, s. Coordinates are float64. LAS and LAZ round them to 0.1 mm, and store the other columns
    as extra dimensions. PCD holds float32, since most programs read nothing else.

    Raises a ValueError for another suffix, if `path` is no regular file, the scans cannot be read, or float32 is too coarse; an
    OSError if a file cannot be read or written; an ImportError that names a missing library.

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


def _write_pcd(file: BinaryIO, rows: Array) -> None:
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


def _write_csv(file: BinaryIO, rows: Array) -> None:
    names = rows.dtype.names or ()
    formats = ",".join(_CSV_FORMATS[rows.dtype[name].str[1:]] for name in names)
    np.savetxt(file, rows, formats, header=",".join(names), comments="")


def _write_las(compressed: bool, file: BinaryIO, rows: Array) -> None:
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


def ply_header(dtype: np.dtype[Any], count: int, num_faces: int | None = None) -> bytes:
    """Header of a binary PLY file of `count` such records, and of triangles if it is a mesh."""
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += ["comment radarsdf: world frame, m", f"element vertex {count}"]
    lines += [f"property {_PLY_TYPES[dtype[name].str[1:]]} {name}" for name in dtype.names or ()]
    if num_faces is not None:
        lines += [f"element face {num_faces}", "property list uchar int vertex_indices"]
    return ("\n".join([*lines, "end_header"]) + "\n").encode("ascii")


_WRITERS: dict[str, Callable[[BinaryIO, Array], Any]] = {
    ".ply": lambda file, rows: file.write(ply_header(rows.dtype, len(rows)) + rows.tobytes()),
    ".pcd": _write_pcd,
    ".las": partial(_write_las, False),
    ".laz": partial(_write_las, True),
    ".npy": np.save,
    ".csv": _write_csv,
}

CLOUD_OUT_SUFFIXES = tuple(_WRITERS)
