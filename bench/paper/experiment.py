# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Experiments: tasks that return rows, and functions that make a table and a plot of the rows."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import radarsdf
import trimesh
from radarsdf import FitConfig, RadarMap
from radarsdf.evaluation import intensity_metrics, surface_metrics
from radarsdf.render.picture import save_picture
from radarsdf.returns.rays import Rays, prepare

from bench.peers.interface import PEERS, Peer, Reconstruction, reconstruct
from bench.settings import Changes, merged

from .report import figure
from .scenes import Scene

Row = dict[str, Any]
"""One result: numbers, words and arrays. It always has `scene`, and `why_not` if a result is missing."""

# After 20 iterations, some scenes have no surface yet.
_SHORT: Changes = {"training": {"sdf_iterations": 60, "intensity_iterations": 60}}


@dataclass(frozen=True)
class Options:
    """Options of the command line."""

    quick: bool
    """Only check that everything runs. The numbers are then meaningless."""
    repetitions: int
    samples: int
    """Points on a mesh for its errors."""
    bases: tuple[str, ...]
    """Configurations of this package: "default", "paper"."""
    peers: tuple[str, ...]
    """Names of `PEERS`."""
    meshes: Path | None = None
    """Folder for the meshes of `measure` and their pictures."""
    levers: tuple[Changes, ...] = ()
    """Settings, and under `mesh` arguments of the mesh, that `curve` measures besides its own."""

    def config(self, base: str, scene: Scene, **changes: Any) -> FitConfig:
        """The configuration `base` with the ranges of the scene and other changes."""
        config = scene.config(base)
        return config.override(**merged(_SHORT if self.quick else {}, changes))

    def reconstruct(self, method: str | Peer, scene: Scene, held_out: Scene | None = None) -> Reconstruction:
        """The surface of a peer for a scene. With `held_out`, also its intensities at the returns of that scene."""
        peer = PEERS[method] if isinstance(method, str) else method
        if self.quick:
            peer = peer.with_changes(**_SHORT)
        return reconstruct(
            peer,
            scene.points,
            scene.poses,
            scene.intensities,
            **scene.ranges,
            queries=None if held_out is None else world_returns(held_out)[:2],
        )

    def measure(self, method: str | Peer, scene: Scene, held_out: Scene | None = None) -> Row:
        """Time, memory and surface errors of a peer for a scene, or the reason why there are none.

        With `held_out`, also its intensity errors at the returns of that scene.
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
        except ValueError as error:  # no part of the mesh is in the box
            return row | {"why_not": str(error)}
        return row | {"triangles": len(result.mesh.faces), **metrics}


@dataclass(frozen=True)
class Task:
    """A part of an experiment, shown in the progress bar."""

    label: str
    run: Callable[[], Iterable[Row]]


def for_each_peer(
    rows: Callable[[Scene, str, Options], Iterable[Row]],
) -> Callable[[Scene, Options], list[Task]]:
    """Tasks of an experiment that asks for the `rows` of each peer by its name."""

    def tasks(scene: Scene, options: Options) -> list[Task]:
        return [Task(f"{scene.name}: {name}", partial(rows, scene, name, options)) for name in options.peers]

    return tasks


@dataclass(frozen=True)
class Experiment:
    """One table or figure of the paper."""

    title: str
    scenes: tuple[str, ...]
    """The scenes by default."""
    tasks: Callable[[Scene, Options], list[Task]]
    table: Callable[[list[Row]], str]
    plot: Callable[[list[Row], Path], None]
    repetitions: int = 1
    """Number of fits with different seeds, as in the paper."""
    bases: tuple[str, ...] = ("default", "paper")
    peers: tuple[str, ...] = tuple(PEERS)
    """The methods by default."""


def _cropped(mesh: trimesh.Trimesh, ground_truth: np.ndarray) -> trimesh.Trimesh:
    """The triangles within the bounds of the ground truth, or all if there are none.

    In a picture of the whole mesh, surfaces far outside would make the scene small.
    """
    middle = mesh.triangles_center
    inside = ((middle >= ground_truth.min(axis=0)) & (middle <= ground_truth.max(axis=0))).all(axis=1)
    return trimesh.Trimesh(mesh.vertices, mesh.faces[inside if inside.any() else slice(None)], process=False)


def fit(scene: Scene, config: FitConfig) -> RadarMap:
    """A map of all scans of a scene, with intensities if it has them."""
    return radarsdf.fit(scene.points, scene.poses, scene.intensities, config=config, progress=False)


def rays_of(scene: Scene) -> Rays:
    """The returns within the ranges of the scene."""
    return prepare(scene.points, scene.poses, scene.intensities, **scene.ranges)


def world_returns(scene: Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points (N, 3) and sensor positions (N, 3), world frame, m, and intensities (N,), sensor units.

    They are those of the returns within the ranges of the scene.
    """
    rays = rays_of(scene)
    assert rays.intensities is not None
    return *rays.in_world(), rays.intensities


def groups(rows: Iterable[Row], *keys: str) -> dict[tuple[Any, ...], list[Row]]:
    """Rows grouped by the values of `keys`, in the order of the first row of each group."""
    found: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        found.setdefault(tuple(row.get(key) for key in keys), []).append(row)
    return found


def panels(
    path: Path, rows: list[Row], *keys: str, size: tuple[float, float] = (5, 3.6)
) -> Iterator[tuple[Any, list[Row]]]:
    """Axes with a title, and the rows, of each group by `keys`, side by side in a plot that is written to `path` in the end."""
    found = groups(rows, *keys)
    with figure(path, columns=max(1, len(found)), size=size) as axes:
        for ax, (names, own) in zip(axes[0], found.items(), strict=False):
            ax.set_title(", ".join(names))
            yield ax, own


def mean_and_deviation(rows: list[Row], key: str) -> str:
    """Mean and standard deviation over the rows, such as `3.24 ± 0.04`, or the number if there is only one."""
    values = [row[key] for row in rows if row.get(key) is not None]
    if not values:
        return "–"
    mean = f"{np.mean(values):.2f}"
    return mean if len(values) == 1 else f"{mean} ± {np.std(values, ddof=1):.2f}"
