"""Peers, the methods to compare with, and `reconstruct`, which runs one of them.

Each peer runs in a child process (see `child`), and nothing of it is imported here. If it cannot run, the result states
the reason, and the peer stays in the tables.
"""

import json
import math
import subprocess
import sys
import tempfile
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from bench.measure import ROOT, failure
from scenes.settings import Changes, merged

PYTHON = [sys.executable]
"""Command that runs a peer, unless it needs another Python."""
VDBFUSION_ENVIRONMENT = ROOT / "build" / "peers" / "vdbfusion"
ODOMETRY_ENVIRONMENT = ROOT / "build" / "peers" / "odometry"
INSTALL = {
    "open3d": "pip install '.[peers]', on Debian after apt-get install libusb-1.0-0 libgl1 libegl1 libx11-6 libgomp1",
    "vdbfusion": "python -m bench.peers.install, which needs CPython 3.8 to 3.10",
}


@dataclass(frozen=True)
class Peer:
    """A method with its settings."""

    name: str
    """Name in the tables."""
    method: str
    """`module:function` in this package."""
    options: dict[str, Any]
    """Keywords of the function, with the values of the paper."""
    needs: str = ""
    """Package required in addition to NumPy."""
    intensities: bool = False
    """Whether it uses intensities."""

    def with_changes(self, *, mesh: dict[str, Any] | None = None, **changes: Any) -> "Peer":
        """Return the peer with other settings of `FitConfig` and arguments of its mesh. Methods of other packages are unchanged."""
        if "changes" not in self.options:
            return self
        options = {
            "changes": merged(self.options["changes"], changes),
            "mesh": self.options["mesh"] | (mesh or {}),
        }
        return replace(self, options=self.options | options)


# Limits of the published mesh.
_MESHES: dict[str, dict[str, Any]] = {
    "paper": {"min_confidence": 0.0, "max_uncertainty": math.inf, "min_component_triangles": 300}
}


def _fit(name: str, base: str, *, intensities: bool = False, voxel_m: float = 0.1, **changes: Any) -> Peer:
    mesh = {"voxel_size": voxel_m} | _MESHES.get(base, {})
    options = {"base": base, "changes": changes, "mesh": mesh}
    return Peer(name, "radarsdf_fits:radarsdf_fit", options, needs="radarsdf", intensities=intensities)


_OCTREE: Changes = {"encoding": {"kind": "octree"}}
_PUBLISHED_RATE: Changes = {"training": {"learning_rate": 1e-2}}


PEERS = {
    peer.name: peer
    for peer in (
        Peer("α-shapes", "open3d_meshes:alpha_shapes", {"alpha_m": 0.2}, "open3d"),
        Peer("BPA", "open3d_meshes:ball_pivoting", {"radius_m": 0.1}, "open3d"),
        Peer("Poisson", "open3d_meshes:poisson", {"depth": 12}, "open3d"),
        Peer("VDBFusion", "vdbfusion_tsdf:vdbfusion", {"voxel_m": 0.2}, "vdbfusion"),
        # 3QFP and the representation of SHINE-Mapping, computed by this package at the published learning rate.
        _fit(
            "SHINE (octree)", "paper", **merged(_OCTREE, {"encoding": {"fourier_count": 0}}, _PUBLISHED_RATE)
        ),
        _fit("3QFP", "paper", **_PUBLISHED_RATE),
        _fit("3QFPI", "paper", intensities=True),
        _fit("radarsdf, quick", "quick", voxel_m=0.2),
        _fit("radarsdf, octree", "default", **_OCTREE),
        _fit("radarsdf", "default"),
        _fit("radarsdf, intensities", "default", intensities=True),
    )
}
"""Peers by name, in the order of Table I of the paper, then the configurations of this package."""


@dataclass(frozen=True)
class Reconstruction:
    """Result of a peer, or the reason why it is missing."""

    mesh: trimesh.Trimesh | None
    why_not: str = ""
    seconds: float | None = None
    """Wall time from returns in memory to triangles in memory, without imports and file access."""
    peak_bytes: int | None = None
    """Peak resident memory of its process, with interpreter and libraries."""
    map_bytes: int | None = None
    """Size of the map from which the mesh was extracted, if there is one."""
    report: dict[str, Any] = field(default_factory=dict)
    """Further numbers of the method. For a fit: `RadarMap.report` and the time of the mesh."""
    intensity: np.ndarray | None = None
    """(N,) predicted intensities at the queries, sensor units. None if the method predicts none."""


def reconstruct(
    peer: Peer,
    points: list[np.ndarray],
    poses: np.ndarray,
    intensities: list[np.ndarray] | None = None,
    *,
    min_range_m: float = 2.5,
    max_range_m: float | None = None,
    queries: tuple[np.ndarray, np.ndarray] | None = None,
    timeout_s: float = 3600.0,
) -> Reconstruction:
    """Run one of `PEERS` on scans.

    Points are F arrays (N_i, 3), sensor frame, m; poses (F, 4, 4) T_world_sensor; intensities F arrays (N_i,), passed only to
    peers with `Peer.intensities`. Returns outside the ranges are dropped for all peers. Queries are points (N, 3)
    and sensor positions (N, 3), world frame, m, for which intensities are predicted. After the timeout a peer has no result.
    """
    python, why_not = _interpreter(peer.needs)
    if python is None:
        return Reconstruction(None, why_not)
    frame = np.repeat(np.arange(len(points)), [len(p) for p in points])
    sensor_points = np.concatenate([np.asarray(p, np.float32).reshape(-1, 3) for p in points])
    range_m = np.linalg.norm(sensor_points, axis=1)
    kept = (range_m >= min_range_m) & (range_m <= (np.inf if max_range_m is None else max_range_m))
    # Local origin, since peers that compute in float32 cannot resolve UTM coordinates.
    origin = poses[0, :3, 3].copy()
    local_poses = poses.copy()
    local_poses[:, :3, 3] -= origin
    if not kept.any():
        return Reconstruction(None, "no returns within the ranges")
    used, frame = np.unique(frame[kept], return_inverse=True)  # a scan may have no returns left
    arrays = {"points": sensor_points[kept], "frame": frame, "poses": local_poses[used]}
    if peer.intensities and intensities is not None:
        arrays["intensities"] = np.concatenate(intensities)[kept]
    if queries is not None:
        arrays |= {"query_points": queries[0] - origin, "query_sensors": queries[1] - origin}
    options = dict(peer.options)
    if "changes" in options:
        # Returns are already cropped to the ranges.
        options["changes"] = merged({"returns": {"min_range_m": 0.0}}, options["changes"])
    with tempfile.TemporaryDirectory() as folder:
        scans_path, result_path = Path(folder) / "scans.npz", Path(folder) / "result.npz"
        np.savez(scans_path, **arrays)
        command = [*python, "-m", "bench.peers.child", peer.method, json.dumps(options)]
        try:
            done = subprocess.run(
                [*command, str(scans_path), str(result_path)],
                cwd=ROOT,
                capture_output=True,
                text=True,
                timeout=timeout_s,
                check=False,
            )
        except subprocess.TimeoutExpired:
            return Reconstruction(None, f"no result after {timeout_s:.0f} s")
        if done.returncode != 0:
            return Reconstruction(None, failure(done))
        with np.load(result_path) as result:
            vertices, faces = result["vertices"] + origin, result["faces"]
            seconds, peak, map_bytes = (result[k].item() for k in ("seconds", "peak_bytes", "map_bytes"))
            report, intensity = json.loads(result["report"].item()), result.get("intensity")
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    if len(faces) == 0:
        return Reconstruction(None, "the mesh has no triangles", seconds)
    peak, map_bytes = (None if size < 0 else size for size in (peak, map_bytes))
    return Reconstruction(mesh, "", seconds, peak, map_bytes, report, intensity)


@cache
def _interpreter(needs: str) -> tuple[list[str] | None, str]:
    """Command of a Python that can import `needs`, or None and the reason."""
    candidates = [PYTHON]
    if needs == "vdbfusion":
        candidates += [[str(VDBFUSION_ENVIRONMENT / "bin" / "python")]]
    why_not = ""
    for python in candidates:
        if not Path(python[0]).exists():
            continue
        done = subprocess.run(
            [*python, "-c", f"import {needs}"], cwd=ROOT, capture_output=True, text=True, check=False
        )
        if done.returncode == 0:
            return python, ""
        why_not = failure(done)
    hint = INSTALL.get(needs)
    return None, f"{why_not} ({hint})" if hint else why_not
