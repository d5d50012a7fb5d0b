"""Small valid files of every format, and malicious ones whose container is valid."""

from __future__ import annotations

import functools
import io
import json
import tempfile
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import radarsdf
import torch
import trimesh
from radarsdf import FitConfig
from radarsdf.field.neural_field import NeuralField
from radarsdf.fitting.checkpoint import Checkpoint
from radarsdf.fitting.occupied_cells import near_leaf_keys
from radarsdf.fitting.schedule import Schedule
from radarsdf.fitting.train import Training
from radarsdf.io.npz import write_scans
from radarsdf.returns.intensities import IntensityScale
from radarsdf.returns.rays import Rays, prepare
from radarsdf.scans import Scans
from radarsdf.threads import ThreadPool

_CONFIG = FitConfig(num_threads=1).override(
    training={"sdf_iterations": 2, "intensity_iterations": 2, "batch_size": 64, "intensity_batch_size": 64},
    networks={"intensity_hidden": (4, 3)},
    encoding={"fourier_count": 2},
)
_VALUES: list[Any] = [
    None, True, -1, 0, 1, 12, 13, 2**31, 2**63, 10**400, 1e308, -0.0, float("nan"), float("inf"), "", "x" * 10_000, [],
    [[]], [1e6] * 4, [30_000, 30_000, 30_000], [1] * 20_000, [2**62, 2**62], {}, {"a": {}}, "octree", "tri-quadtree",
]  # fmt: skip
_TYPES = ["f2", "f8", "i1", "u8", "c16", "S3", "U2", "M8[s]", "m8[s]", "V4", "?", ">f4", "f4,i4", "V0", "U0"]
_TENSOR_TYPES = ["F64", "F16", "BF16", "I64", "U8", "BOOL", "F8_E4M3", "X", ""]
_CLAIMS = [(10**12,), (2**32, 2**32), (2**63,), (-1, 3), (10**9, 3), (0, 2**62, 2**62), (2**16,) * 4]


def _small_scans(with_intensity: bool) -> Scans:
    rng = np.random.default_rng(0)
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[:, 0, 3] = [0.0, 0.5]
    points = [np.column_stack([np.full(9, 5.0), rng.uniform(-1, 1, (9, 2))]) for _ in poses]
    values = [rng.uniform(0, 9, 9) for _ in poses] if with_intensity else None
    return Scans(points, poses, values, rng.normal(size=(5, 3)))


@functools.cache
def maps() -> list[bytes]:
    """Fitted maps with and without intensities."""
    found = []
    with tempfile.TemporaryDirectory() as folder:
        for with_intensity, encoding in ((True, "tri-quadtree"), (False, "octree")):
            scans = _small_scans(with_intensity)
            config = _CONFIG.override(encoding={"kind": encoding})
            path = Path(folder) / "map.safetensors"
            fitted = radarsdf.fit(scans.points, scans.poses, scans.intensities, config=config, progress=False)
            fitted.save(path)
            found.append(path.read_bytes())
    return found


@functools.cache
def training() -> Training:
    """The training of :func:`fit_of_checkpoints`, for the files of :func:`checkpoints`."""
    rays, scale, config = fit_of_checkpoints()
    keys = near_leaf_keys(rays, config, 1)
    field = NeuralField(keys, config, with_intensity=True, num_threads=1)
    field.initialise(torch.Generator().manual_seed(0))
    count = len(rays)
    schedule = Schedule.of(
        config, surface_returns=count, returns=count, vertices=field.table.num_rows, with_intensity=True
    )
    return Training(field, rays, rays, scale, schedule, config, ThreadPool(1))


@functools.cache
def fit_of_checkpoints() -> tuple[Rays, IntensityScale | None, FitConfig]:
    """Rays, their intensities' scale and configuration of a small fit."""
    scans = _small_scans(True)
    rays = prepare(scans.points, scans.poses, scans.intensities, **_CONFIG.preparation)
    return rays, IntensityScale.of(rays.intensities), _CONFIG


@functools.cache
def checkpoints() -> list[bytes]:
    """The state of a training before its first iteration."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "state"
        Checkpoint(path, *fit_of_checkpoints()).write(training().state())
        return [path.read_bytes()]


@functools.cache
def tables() -> list[bytes]:
    """Points as text."""
    rows = np.random.default_rng(3).normal(size=(9, 3)).tolist()
    return [
        "".join(" ".join(map(str, row)) + "\n" for row in rows).encode(),
        b"# x y z r\n1 2 3 4\n5 6 7 8e-3\n",
    ]


def arrays() -> list[bytes]:
    """Points as a NumPy file."""
    rng = np.random.default_rng(4)
    return [_npy(rng.normal(size=(9, 3)).astype(dtype)) for dtype in (np.float32, np.float64, np.int16)]


def _settings(config: dict[str, Any]) -> list[tuple[dict[str, Any], str]]:
    """All settings, and all groups as a whole: the dict that each is in, and its name there."""
    groups = [config, *(value for value in config.values() if isinstance(value, dict))]
    return [(group, name) for group in groups for name in group]


def _change_one(rng: np.random.Generator, parts: Any, value: Any) -> None:
    if isinstance(parts, dict) and parts:
        parts[list(parts)[rng.integers(len(parts))]] = value


def hostile_map(rng: np.random.Generator) -> bytes:
    """A map whose header is valid JSON of the correct length, with one to three changed values."""
    data = maps()[rng.integers(2)]
    size = int.from_bytes(data[:8], "little")
    header, body = json.loads(data[8 : 8 + size]), data[8 + size :]
    description = json.loads(header["__metadata__"]["description"])
    for _ in range(rng.integers(1, 4)):
        value = _VALUES[rng.integers(len(_VALUES))]
        tensors = [name for name in header if name != "__metadata__"]
        tensor = header[tensors[rng.integers(len(tensors))]]
        match rng.integers(7):
            case 0 | 1:
                config = description.get("config")
                settings = _settings(config) if isinstance(config, dict) else []
                if settings:
                    group, name = settings[rng.integers(len(settings))]
                    group[name] = value
            case 2:
                description[str(rng.choice(["config", "report", "intensity_scale", "more"]))] = value
            case 6:
                _change_one(rng, description["sensor"], value)
                _change_one(rng, description.get("report"), value)
            case 3:
                shapes = [value, [2**32, 2**32], [0, 2**63], [10**12], [-1], [8, 8]]
                tensor["shape"] = shapes[rng.integers(len(shapes))]
            case 4:
                tensor["dtype"] = str(rng.choice(_TENSOR_TYPES))
            case 5:
                begin = int(rng.choice([0, 1, len(body), 2**40, 2**62]))
                tensor["data_offsets"] = [begin, begin + int(rng.choice([-1, 0, 4, len(body), 2**40]))]
    metadata = {k: v for k, v in header["__metadata__"].items() if not k.startswith("crc32")}
    header["__metadata__"] = metadata  # like older files without checksums, which detect most changes
    metadata["description"] = json.dumps(description)
    if rng.random() < 0.1:
        key, value = rng.choice(["format", "format_version"]), rng.choice(["", "2", "9" * 5000, "٣", "1.0"])
        metadata[str(key)] = str(value)
    text = json.dumps(header).encode()
    if rng.random() < 0.1:  # the same key twice
        text = text[:-1] + b"," + text[1:]
    if rng.random() < 0.1:  # NaN, infinities and extreme numbers
        body = bytes(rng.choice(np.array([0, 0x7F, 0x80, 0xFF, 0xC0], np.uint8), len(body)))
    return len(text).to_bytes(8, "little") + text + body


@functools.cache
def scans() -> list[bytes]:
    """Files of scans, compressed and uncompressed, with and without intensities."""
    found = []
    with tempfile.TemporaryDirectory() as folder:
        for with_intensity in (True, False):
            path = Path(folder) / "scans.npz"
            write_scans(path, _small_scans(with_intensity))
            found.append(path.read_bytes())
    plain = io.BytesIO()
    with np.load(io.BytesIO(found[0])) as arrays:
        np.savez(plain, **arrays)
    return [*found, plain.getvalue()]


def hostile_scans(rng: np.random.Generator) -> bytes:
    """A valid zip file with malicious members."""
    with np.load(io.BytesIO(scans()[0])) as file:
        arrays: dict[str, Any] = {name: _npy(array) for name, array in file.items()}
        arrays["static"] = _npy(np.ones(len(file["frame"]), bool))
        shapes = {name: array.shape for name, array in file.items()}
    for _ in range(rng.integers(1, 4)):
        name = str(rng.choice(["points", "frame", "poses", "intensity", "static", "lidar_points"]))
        shape = shapes.get(name, (18,))
        match rng.integers(6):
            case 0:
                arrays[name] = _npy(np.zeros(shape, str(rng.choice(_TYPES))))
            case 1:
                other = [(0, *shape[1:]), shape[:-1], (*shape, 1), (), (1,) * 30, (0,), shape[::-1]]
                arrays[name] = _npy(np.zeros(other[rng.integers(len(other))]))
            case 2:
                values = [np.nan, np.inf, -1, 2**63, 1e308, 0.5]
                arrays[name] = _npy(np.full(shape, values[rng.integers(len(values))]))
            case 3:
                arrays[name] = _claim(_CLAIMS[rng.integers(len(_CLAIMS))])
            case 4:
                heads = [b"(" * 9000, b"[" * 9000, b"{'descr': '<f4', 'fortran_order': 0, 'shape': 3}", b"__import__('os')",
                         b"{'descr': [('a', " * 400, b"\x00" * 50, b"{'descr': '<f4'}", b"9" * 9000]  # fmt: skip
                arrays[name] = _header(heads[rng.integers(len(heads))])
            case 5:
                del arrays[name]
                other_names = ["../points", "/points", "points/points", "x", "C:\\points"]
                arrays[str(rng.choice(other_names))] = _npy(np.ones((18, 3)))
        arrays.setdefault(name, _npy(np.zeros(shape)))
    result = io.BytesIO()
    kind = int(rng.choice([zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA]))
    with zipfile.ZipFile(result, "w", kind) as file:
        for name, data in arrays.items():
            file.writestr(name + ".npy", data)
    data = result.getvalue()
    if rng.random() < 0.1:
        head = b"PK\x01\x02\x14\x03\x14\x00"
        data = data.replace(head + b"\x00\x00", head + b"\x01\x00")  # "encrypted"
    return data


def _npy(array: np.ndarray[Any, Any]) -> bytes:
    data = io.BytesIO()
    np.save(data, array)
    return data.getvalue()


def _header(text: bytes) -> bytes:
    return b"\x93NUMPY\x01\x00" + (len(text) + 1).to_bytes(2, "little") + text + b"\n" + bytes(100)


def _claim(shape: tuple[int, ...]) -> bytes:
    return _header(f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}".encode())


def clouds() -> list[bytes]:
    """PCD files, binary and ASCII."""
    rng = np.random.default_rng(1)
    table = np.column_stack([rng.uniform(1, 9, (12, 3)), rng.uniform(0, 30, 12)]).astype(np.float32)
    found = []
    for kind in ("binary", "ascii"):
        head = (
            "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z power\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\n"
            f"WIDTH 12\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 12\nDATA {kind}\n"
        ).encode()
        rows = "".join(" ".join(map(str, row)) + "\n" for row in table.tolist()).encode()
        found.append(head + (table.tobytes() if kind == "binary" else rows))
    return found


def trajectories() -> list[bytes]:
    """Poses that cover the times of the scans of `write_folder`."""
    rows = [
        f"{99.8 + 0.2 * i:.3f} {0.1 * i} 2.5 -1e-3 0 0 {np.sin(0.1 * i):.9f} {np.cos(0.1 * i):.9f}\n"
        for i in range(6)
    ]
    return [("# time x y z qx qy qz qw\n" + "".join(rows)).encode()]


def transforms() -> list[bytes]:
    """A rigid transform, 4 x 4, as text."""
    return [b"0 -1 0 0.5\n1 0 0 0\n0 0 1 -0.2 # z\n0 0 0 1\n"]


@functools.cache
def meshes() -> list[bytes]:
    """PLY files of points and of a mesh, binary and ASCII."""
    make_cloud: Any = trimesh.PointCloud
    cloud = make_cloud(np.random.default_rng(2).normal(size=(9, 3)))
    box: Any = trimesh.creation.box()
    of_box = [box.export(file_type="ply", encoding=encoding) for encoding in ("ascii", "binary")]
    return [cloud.export(file_type="ply"), *of_box]


def write_folder(folder: Path) -> None:
    """A folder of two scans that `radarsdf.io.read` reads."""
    (folder / "radar").mkdir(parents=True, exist_ok=True)
    for time_s in ("100.0", "100.3"):
        (folder / "radar" / f"{time_s}.pcd").write_bytes(clouds()[0])
    (folder / "poses.txt").write_bytes(trajectories()[0])
    (folder / "base_T_radar.txt").write_bytes(transforms()[0])
    (folder / "lidar.ply").write_bytes(meshes()[0])
