"""Small valid files of every format, and headers of NumPy that claim any shape."""

import functools
import io
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import radarsdf
import torch
import trimesh
from radarsdf import FitConfig
from radarsdf.field.field import NeuralField
from radarsdf.fitting.checkpoint import Checkpoint
from radarsdf.fitting.estimate import Schedule
from radarsdf.fitting.surface_returns import near_leaf_keys
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
    vertices = field.table.num_rows
    schedule = Schedule.of(config, surface_returns=count, vertices=vertices, labelled=[count])
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
