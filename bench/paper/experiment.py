# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What an experiment is: tasks that give rows, a table of the rows, and a plot of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import radarsdf
import trimesh
from radarsdf import FitConfig, RadarMap
from radarsdf.evaluation import intensity_metrics, surface_metrics
from radarsdf.render.picture import save_picture

from bench.peers.interface import PEERS, Peer, Reconstruction, reconstruct

from .scenes import Scene

Row = dict[str, Any]
"""One result: plain numbers, words and arrays, among them always `scene`, and `why_not` where there is no result."""


@dataclass(frozen=True)
class Options:
    """What the command line says."""

    quick: bool
    """Whether it is only to be seen that everything runs: the numbers then mean nothing."""
    repetitions: int
    samples: int
    """Points on a mesh."""
    bases: tuple[str, ...]
    """Configurations of this package: "default", "paper"."""
    peers: tuple[str, ...]
    """Names of `PEERS`."""
    meshes: Path | None = None
    """Folder for the meshes of `measure` and pictures of them."""
    levers: tuple[dict[str, Any], ...] = ()
    """Changes of the configuration to try besides those of the experiment."""

    def config(self, base: str, scene: Scene, **changes: Any) -> FitConfig:
        """A configuration with the scene's ranges."""
        ranges = {"min_range_m": scene.min_range_m, "max_range_m": scene.max_range_m}
        short = {"sdf_iterations": 20, "intensity_iterations": 40} if self.quick else {}
        settings = ranges | short | changes
        return FitConfig.paper(**settings) if base == "paper" else FitConfig(**settings)

    def reconstruct(self, method: str | Peer, scene: Scene, held_out: Scene | None = None) -> Reconstruction:
        """A peer's surface of a scene, and with `held_out` its intensities at the returns of that."""
        peer = PEERS[method] if isinstance(method, str) else method
        if self.quick:
            peer = peer.with_changes(sdf_iterations=20, intensity_iterations=40)
        return reconstruct(
            peer,
            scene.points,
            scene.poses,
            scene.intensities,
            min_range_m=scene.min_range_m,
            max_range_m=scene.max_range_m,
            queries=None if held_out is None else world_returns(held_out)[:2],
        )

    def measure(self, method: str | Peer, scene: Scene, held_out: Scene | None = None) -> Row:
        """Time, memory and errors of a peer's surface of a scene, or why there are none.

        With `held_out`, also the errors of the intensity at the returns of that, where the peer predicts it.
        """
        name = method if isinstance(method, str) else method.name
        if scene.ground_truth is None:
            return {"why_not": "the scene has no ground truth"}
        result = self.reconstruct(method, scene, held_out)
        row: Row = {"seconds": result.seconds, "peak_bytes": result.peak_bytes, "map_bytes": result.map_bytes}
        if result.report:
            row["report"] = result.report
        if held_out is not None and result.intensity is not None:
            row |= intensity_metrics(result.intensity, world_returns(held_out)[2])
        if result.mesh is None:
            return row | {"why_not": result.why_not}
        if self.meshes is not None:
            stem = self.meshes / f"{scene.name}, {len(scene)} frames, {name}"
            result.mesh.export(f"{stem}.ply")
            save_picture(f"{stem}.png", _cropped(result.mesh, scene.ground_truth))
        try:
            metrics = surface_metrics(result.mesh, scene.ground_truth, box=scene.box, samples=self.samples)
        except ValueError as error:  # nothing of it in the box
            return row | {"why_not": str(error)}
        return row | {"triangles": len(result.mesh.faces), **metrics}


@dataclass(frozen=True)
class Task:
    """A piece of an experiment, long enough to be waited for."""

    label: str
    run: Callable[[], Iterable[Row]]


@dataclass(frozen=True)
class Experiment:
    """One table or figure of the paper."""

    title: str
    scenes: tuple[str, ...]
    """Those it runs on where none are named."""
    tasks: Callable[[Scene, Options], list[Task]]
    table: Callable[[list[Row]], str]
    plot: Callable[[list[Row], Path], None]
    repetitions: int = 1
    """As in the paper."""
    bases: tuple[str, ...] = ("default", "paper")


def _cropped(mesh: trimesh.Trimesh, ground_truth: np.ndarray) -> trimesh.Trimesh:
    """What lies within the bounds of the ground truth, or else all: sheets far outside would shrink the rest."""
    middle = mesh.triangles_center
    inside = ((middle >= ground_truth.min(axis=0)) & (middle <= ground_truth.max(axis=0))).all(axis=1)
    return trimesh.Trimesh(mesh.vertices, mesh.faces[inside if inside.any() else slice(None)], process=False)


def fit(scene: Scene, config: FitConfig) -> RadarMap:
    """A map of all frames of a scene, with intensities if it has them."""
    return radarsdf.fit(scene.points, scene.poses, scene.intensities, config=config, progress=False)


def world_returns(scene: Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """World points (N, 3), sensor positions (N, 3) and intensities (N,) of the returns that the scene's ranges keep."""
    rays = radarsdf.returns.rays.prepare(
        scene.points,
        scene.poses,
        scene.intensities,
        min_range_m=scene.min_range_m,
        max_range_m=scene.max_range_m,
    )
    assert rays.intensities is not None
    return *rays.in_world(), rays.intensities


def groups(rows: Iterable[Row], *keys: str) -> dict[tuple[Any, ...], list[Row]]:
    """Rows with the same values of `keys` together, in the order of their first."""
    found: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        found.setdefault(tuple(row.get(key) for key in keys), []).append(row)
    return found


def mean_and_deviation(rows: list[Row], key: str) -> str:
    """`3.24 ± 0.04` over repetitions, or one number where there is one."""
    values = [row[key] for row in rows if row.get(key) is not None]
    if not values:
        return "–"
    mean = f"{np.mean(values):.2f}"
    return mean if len(values) == 1 else f"{mean} ± {np.std(values, ddof=1):.2f}"
