"""One reconstruction in a separate process: `python -m bench.peers.child METHOD OPTIONS SCANS RESULT`.

METHOD is a `module:function` of this package that returns a `Made` or its first fields. OPTIONS are its keywords as
JSON. SCANS and RESULT are .npz files. In a separate process, the peak memory is that of the method alone, a crash does not
stop the others, and the Python may differ. Besides NumPy, only the method's packages are needed.
"""

import importlib
import json
import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from bench.measure import memory_bytes, timed


@dataclass(frozen=True)
class ScanArrays:
    """All returns of some scans."""

    points: np.ndarray  # (N, 3) float32, sensor frame, m
    frame: np.ndarray  # (N,) row of `poses`
    poses: np.ndarray  # (F, 4, 4) float64, T_world_sensor
    intensities: np.ndarray | None  # (N,) sensor units

    def world(self) -> np.ndarray:
        """Returns (N, 3) float64, world frame, m."""
        T = self.poses[self.frame]
        return np.asarray(np.einsum("nij,nj->ni", T[:, :3, :3], self.points.astype(np.float64)) + T[:, :3, 3])

    def sensors(self) -> np.ndarray:
        """Position of the sensor for each return, (N, 3) float64, world frame, m."""
        return self.poses[self.frame, :3, 3]


class Made(NamedTuple):
    """Result of a method."""

    vertices: np.ndarray
    """(V, 3) world frame, m."""
    faces: np.ndarray
    """(F, 3) rows of the vertices."""
    map_bytes: int | None = None
    """Size of the map from which the mesh was extracted, if there is one."""
    report: dict[str, Any] | None = None
    """Further numbers of the method, in types of JSON."""
    intensity: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None
    """Predicts intensities (N,), sensor units, of points (N, 3) seen from positions (N, 3), world frame, m.

    It is called after time and memory are measured.
    """


def main() -> None:
    method, options, scans_path, result_path = sys.argv[1:]
    module, function = method.split(":")
    reconstruct = getattr(importlib.import_module(f"bench.peers.{module}"), function)
    with np.load(scans_path) as file:
        scans = ScanArrays(
            file["points"],
            file["frame"],
            file["poses"],
            file.get("intensities"),
        )
        queries = (file["query_points"], file["query_sensors"]) if "query_points" in file else None
    with timed() as taken:
        made = Made(*reconstruct(scans, **json.loads(options)))
    seconds, peak = taken.wall_s, memory_bytes("VmHWM")
    answers: dict[str, Any] = {}
    if queries is not None and made.intensity is not None:
        answers["intensity"] = made.intensity(*queries)
    np.savez(
        result_path,
        vertices=np.asarray(made.vertices, np.float64).reshape(-1, 3),
        faces=np.asarray(made.faces, np.int64).reshape(-1, 3),
        seconds=seconds,
        map_bytes=-1 if made.map_bytes is None else made.map_bytes,
        peak_bytes=peak,
        report=json.dumps(made.report or {}),
        **answers,
    )


if __name__ == "__main__":
    main()
