"""Surfaces of this package and its peers: errors, time, memory, and size."""

import argparse
import itertools
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from radarsdf.evaluation import intensity_metrics, surface_metrics
from radarsdf.render.picture import save_picture
from scipy.spatial import cKDTree

from bench.peers.interface import PEERS, Peer, Reconstruction, reconstruct
from bench.runner import Column, Row, chosen_scenes, figure, groups
from bench.truth import NEAR_M, score_without_holes
from scenes.scene import QUICK, Scene
from scenes.settings import Changes, merged, words_of

Floats = NDArray[np.float64]

_MOST_EXACT = 100_000  # points with distances to the simulated scene

COLUMNS = {
    "accuracy_error_m": Column("acc. error, cm", 100, 2, "lowest"),
    "accuracy_ratio": Column("acc. ratio, %", 100, 2, "highest"),
    "outlier_ratio": Column("outliers, %", 100, 2, "lowest"),
    "completion_error_m": Column("compl. error, cm", 100, 2, "lowest"),
    "completion_ratio": Column("compl. ratio, %", 100, 2, "highest"),
    "f_score": Column("F-score, %", 100, 2, "highest"),
    "f_score_all": Column("F-score, nothing discarded, %", 100, 2, "highest"),
    "f_score_without_holes": Column("F-score by a truth without holes, %", 100, 2, "highest"),
    "gamma_shape": Column("Gamma shape"),
    "gamma_mean": Column("mean, rad", 1, 3, "lowest"),
    "gamma_variance": Column("variance", 1, 3, "lowest"),
    "seconds": Column("time, s", 1, 2, "lowest"),
    "peak_bytes": Column("peak memory, MB", 1e-6, 0, "lowest"),
    "mae": Column("held-out MAE", 1, 3, "lowest"),
}


def _quick(peer: Peer) -> Peer:
    """A peer with few iterations or a shallow octree, to check that it runs."""
    if "depth" in peer.options:
        return replace(peer, options=peer.options | {"depth": 8})
    return peer.with_changes(**QUICK)


def reconstructed(
    options: argparse.Namespace, peer: Peer, scene: Scene, held_out: Scene | None = None
) -> Reconstruction:
    """Reconstruct a scene by a peer. With `held_out`, also predict its intensities at the returns of that scene."""
    return reconstruct(
        _quick(peer) if options.quick else peer,
        scene.points,
        scene.poses,
        scene.intensities,
        **scene.ranges,
        queries=None if held_out is None else held_out.world_returns()[:2],
    )


def measured(options: argparse.Namespace, peer: Peer, scene: Scene, held_out: Scene | None = None) -> Row:
    """Time, memory and surface errors of a peer on a scene, or the reason why there are none.

    With `held_out`, also its intensity errors at the returns of that scene.
    """
    row: Row = {"scene": scene.name, "method": peer.name, "returns": scene.num_returns}
    if scene.ground_truth is None:
        return row | {"why_not": "the scene has no ground truth"}
    result = reconstructed(options, peer, scene, held_out)
    row |= {"seconds": result.seconds, "peak_bytes": result.peak_bytes, "map_bytes": result.map_bytes}
    if held_out is not None and result.intensity is not None:
        row |= intensity_metrics(result.intensity, held_out.world_returns()[2])
    if result.mesh is None:
        return row | {"why_not": result.why_not}
    if folder := getattr(options, "meshes", None):
        folder.mkdir(parents=True, exist_ok=True)
        stem = folder / f"{scene.name}, {len(scene)} scans, {peer.name}"
        result.mesh.export(f"{stem}.ply")
        save_picture(f"{stem}.png", _cropped(result.mesh, scene.ground_truth))
    try:
        metrics = surface_metrics(result.mesh, scene.ground_truth, box=scene.box, samples=samples_of(options))
    except ValueError as error:  # no part of the mesh is in the box
        return row | {"why_not": str(error)}
    if scene.simulation is not None and scene.box is None:
        x = sampled(result.mesh, samples_of(options, _MOST_EXACT), None)[0]
        without_holes = score_without_holes(scene.simulation, result.mesh, x, samples_of(options))
        metrics["f_score_without_holes"] = without_holes
    return row | {"triangles": len(result.mesh.faces), **metrics}


def samples_of(options: argparse.Namespace, most: int = 10_000_000) -> int:
    """Number of sampled points on a mesh for its errors."""
    count: int = min(options.samples, most, 100_000 if options.quick else most)
    return count


def _cropped(mesh: trimesh.Trimesh, ground_truth: Floats) -> trimesh.Trimesh:
    """Crop to the bounds of the ground truth: surfaces far outside would make the scene small in a picture."""
    middle = mesh.triangles_center
    inside = ((middle >= ground_truth.min(axis=0)) & (middle <= ground_truth.max(axis=0))).all(axis=1)
    return trimesh.Trimesh(mesh.vertices, mesh.faces[inside if inside.any() else slice(None)], process=False)


def surface(options: argparse.Namespace) -> Iterator[Row]:
    """Yield a row per scene and method."""
    for scene in chosen_scenes(options):
        for name in options.peers:
            yield measured(options, PEERS[name], scene)


def sparse(options: argparse.Namespace) -> Iterator[Row]:
    """Yield a row per scene, method and n, with every n-th scan used."""
    for scene in chosen_scenes(options):
        for n in (1, 2) if options.quick else range(1, 11):
            for name in options.peers:
                yield measured(options, PEERS[name], scene.every_nth(n)) | {"n": n}


_EDGES_M = (2.5, 10.0, 20.0, 30.0, 60.0)
RANGE_COLUMNS = {"precision": Column("precision, %", 100, 0), "completion": Column("completion, %", 100, 0)}


def ranges(options: argparse.Namespace) -> Iterator[Row]:
    """Yield a row per scene, method and distance from the sensor, with which noise grows."""
    for scene, name in itertools.product(list(chosen_scenes(options)), options.peers):
        row: Row = {"scene": scene.name, "method": name}
        truth = scene.ground_truth
        if truth is None:
            yield row | {"why_not": "the scene has no ground truth"}
            continue
        result = reconstructed(options, PEERS[name], scene)
        x = (
            np.zeros((0, 3))
            if result.mesh is None
            else sampled(result.mesh, samples_of(options), scene.box)[0]
        )
        if len(x) == 0:
            yield row | {"why_not": result.why_not or "the mesh has no surface in the box"}
            continue
        sensors = cKDTree(scene.poses[:, :3, 3])
        found = cKDTree(truth).query(x, distance_upper_bound=NEAR_M)[0] <= NEAR_M
        covered = cKDTree(x).query(truth, distance_upper_bound=NEAR_M)[0] <= NEAR_M
        range_of_x_m, range_of_truth_m = sensors.query(x)[0], sensors.query(truth)[0]
        for low_m, high_m in itertools.pairwise(_EDGES_M):
            meshed = found[(range_of_x_m >= low_m) & (range_of_x_m < high_m)]
            true = covered[(range_of_truth_m >= low_m) & (range_of_truth_m < high_m)]
            yield row | {
                "range": f"{low_m:g} to {high_m:g} m",
                "precision": float(meshed.mean()) if len(meshed) else None,
                "completion": float(true.mean()) if len(true) else None,
            }


def sampled(mesh: trimesh.Trimesh, count: int, box: Floats | None) -> tuple[Floats, Floats]:
    """Sample points uniformly by area on a mesh, with interpolated vertex normals: (N, 3) each.

    Only those in the box remain. Normals of single triangles are not used: their tilt would lengthen the errors.
    """
    if len(mesh.faces) == 0:
        return np.zeros((0, 3)), np.zeros((0, 3))
    rng = np.random.default_rng(0)
    area = mesh.area_faces
    chosen = rng.choice(len(area), count, p=area / area.sum())
    u, v = rng.random((2, count))
    weights = np.stack([1 - np.sqrt(u), np.sqrt(u) * (1 - v), np.sqrt(u) * v], axis=1)
    corners = mesh.faces[chosen]
    x = np.einsum("nk,nki->ni", weights, np.asarray(mesh.vertices, np.float64)[corners])
    normals = np.einsum("nk,nki->ni", weights, np.asarray(mesh.vertex_normals, np.float64)[corners])
    length = np.linalg.norm(normals, axis=1)
    kept = length > 0  # opposite normals of a fold have no mean
    if box is not None:
        kept &= ((x >= box[0]) & (x <= box[1])).all(axis=1)
    return x[kept], normals[kept] / length[kept, None]


SIZE_COLUMNS = {
    "bytes": Column("MB", 1e-6),
    "file_bytes": Column("file, MB", 1e-6),
    "share": Column("of the octree, %", 100, 0),
}
_EVERY = (10, 5, 3, 2, 1)  # of 117 scans, these leave 12, 24, 39, 59 and 117 as in the paper
_BYTES_PER_RETURN = 16  # x, y, z and intensity in float32
_MAPS: dict[str, tuple[str, Changes, bool]] = {
    "SHINE (octree)": ("paper", {"encoding": {"kind": "octree", "fourier_count": 0}}, False),
    "3QFPI": ("paper", {}, True),
    "radarsdf": ("default", {}, True),
}


def map_size(options: argparse.Namespace) -> Iterator[Row]:
    """Yield a row per scene, number of scans and method."""
    for scene, n in itertools.product(list(chosen_scenes(options)), _EVERY):
        part = scene.every_nth(n)
        row: Row = {"scene": part.name, "scans": f"{len(part)} scans"}
        octree_bytes = 0
        for name, (base, changes, with_intensity) in _MAPS.items():
            # The size does not depend on the training, so one iteration is enough.
            short: Changes = {"training": {"sdf_iterations": 1, "intensity_iterations": 1}}
            own = part if with_intensity else part.without_intensities()
            radar_map = own.fit(part.config(base, **merged(changes, short)))
            octree_bytes = octree_bytes or radar_map.nbytes
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder) / "map.safetensors"
                radar_map.save(path)
                sizes = {"bytes": radar_map.nbytes, "file_bytes": path.stat().st_size}
            yield row | {"method": name, **sizes, "share": radar_map.nbytes / octree_bytes}
        cloud_bytes = _BYTES_PER_RETURN * part.num_returns
        yield row | {"method": "point clouds", "bytes": cloud_bytes, "share": cloud_bytes / octree_bytes}
        result = reconstructed(options, PEERS["VDBFusion"], part)
        if result.map_bytes is None:
            yield row | {"method": "VDBFusion", "why_not": result.why_not}
        else:
            yield row | {
                "method": "VDBFusion",
                "bytes": result.map_bytes,
                "share": result.map_bytes / octree_bytes,
            }


# Training budgets, relative to the default.
_BUDGETS = {"1/16": 1 / 16, "1/8": 1 / 8, "1/4": 1 / 4, "1/2": 1 / 2, "1": 1.0, "2": 2.0, "4": 4.0}
_OURS = ("radarsdf", "radarsdf, intensities")


def curve(options: argparse.Namespace) -> Iterator[Row]:
    """Yield a row per scene, repetition and method: our budgets, `--set`, and peers, alternating.

    Each method gets the training scans. Intensities of the held-out ones are predicted afterwards.
    """
    methods = [
        (kind, f"{kind}, × {factor}", PEERS[kind].with_changes(effort=_BUDGETS[factor]))
        for kind in _OURS
        for factor in (("1/16",) if options.quick else _BUDGETS)
    ]
    methods += [
        ("setting", words_of(changes), PEERS[_OURS[1]].with_changes(**changes)) for changes in options.set
    ]
    methods += [("peer", name, PEERS[name]) for name in options.peers if name not in _OURS]
    for scene, seed in itertools.product(list(chosen_scenes(options)), range(options.repetitions)):
        train, test = scene.split()
        held_out = test if scene.intensities is not None else None
        for kind, name, peer in methods:
            row = measured(options, peer.with_changes(seed=seed), train, held_out)
            yield row | {"method": name, "kind": kind, "seed": seed}


def draw_curve(rows: list[Row], path: Path) -> None:
    """Plot, per scene, 100 % minus the F-score, and the error of the intensity, over time."""
    scenes = groups([row for row in rows if row.get("f_score_all") is not None], "scene")
    panels = (("f_score_all", "100 % − F-all, %"), ("mae", "MAE of the intensity"))
    with figure(path, rows=max(1, len(scenes)), columns=2, size=(5, 4)) as axes:
        for line, ((scene,), own) in zip(axes, scenes.items(), strict=False):
            for ax, (key, label) in zip(line, panels, strict=True):
                for (kind,), same in groups([row for row in own if row.get(key) is not None], "kind").items():
                    _draw_kind(ax, kind, same, key)
                ax.set(title=scene, xscale="log", xlabel="time, s", ylabel=label)


def _draw_kind(ax: Any, kind: str, rows: list[Row], key: str) -> None:
    points = []
    for (method,), same in groups(rows, "method").items():
        value = float(np.median([row[key] for row in same]))
        points.append(
            (float(np.median([row["seconds"] for row in same])), value if key == "mae" else 100 - 100 * value)
        )
        if kind not in _OURS:
            ax.annotate(method, points[-1], xytext=(3, 3), textcoords="offset points", fontsize=7)
    ax.plot(*zip(*points, strict=True), "o-" if kind in _OURS else "s", ms=4, label=kind)


def seeds(options: argparse.Namespace) -> Iterator[Row]:
    """Yield a row per scene and seed: variation of the errors of the default configuration."""
    for scene, seed in itertools.product(list(chosen_scenes(options)), range(options.repetitions)):
        train, test = scene.split()
        radar_map = train.fit(scene.config("default", quick=options.quick, seed=seed))
        row: Row = {"scene": scene.name, "seed": seed}
        mesh = radar_map.mesh(progress=False)
        if scene.ground_truth is not None and len(mesh.faces):
            row |= surface_metrics(mesh, scene.ground_truth, box=scene.box, samples=samples_of(options))
        if test.intensities is not None:
            x, sensors, intensities = test.world_returns()
            row |= intensity_metrics(radar_map.intensity(x, sensors, extrapolate=True), intensities)
        yield row
