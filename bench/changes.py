"""``python -m bench.changes [KIND ...]``: detection of cubes that appear, disappear, move or change their reflectance.

The second of two simulated drives has other noise and another path: half a metre aside, between the scans, and slightly rotated.
Area within half a metre of a cube is not a false alarm: precision is the share of the changed area that is near one. Recall is
the share of a cube's area on its map that is classified as gone, appeared or moved. Cubes and flat patches of the ground that
change their reflectance return 6 dB more or less in the second drive; recall is the share of the later surface so classified.
Holes are cubes on raised surfaces whose returns in every second scan are extended by 8 m; recall is the share of area that is gone.
"""

import argparse
import dataclasses
import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import radarsdf
from numpy.typing import NDArray
from radarsdf.changes.changes import GONE, UNSEEN, Changes
from radarsdf.poses.odometry import pose_sigmas
from radarsdf.simulate import Box, Scene, Simulation, drifted, materials, simulate
from scipy.spatial.transform import Rotation

from bench.runner import Column, Experiment, Row, main
from scenes.kinds import KINDS

Floats = NDArray[np.float64]

_SIZES_M = (0.3, 0.6, 1.0, 2.0, 3.0)
_CHANGES = ("put in", "taken out", "moved")
_OF_REFLECTANCE = ("reflectance_changed", "patch of changed reflectance")
_STRONGER_DB = 6.0
_PATCH_M = 0.02  # half the thickness of a patch, half of which is above the ground
_ON_M, _NEAR_M = 0.2, 0.5
_FOUND = 0.2  # recall of a detected cube
_TRIES = 20
_HOLES_M, _HOLES, _EXTENDED_M = (1.0, 2.0, 4.0, 8.0), 2, 8.0


@dataclass(frozen=True)
class Change:
    """A cube that is in one of two scenes, elsewhere in the second, or of another material there."""

    kind: str
    size_m: float
    before: Box | None
    after: Box | None


COLUMNS = {
    "false_share": Column("false positives, % of area", 100, 3),
    "precision": Column("precision"),
    "recall": Column("recall"),
    "found": Column("detected"),
}


def rows(options: argparse.Namespace) -> Iterator[Row]:
    """Per kind of scene, yield a row without changes and one with them, and a row per cube with its recall."""
    for kind in options.cases:
        first = KINDS[kind](seed=options.seed)
        rng = np.random.default_rng([options.seed, len(kind)])
        ways = first.poses, other_way(first.poses, rng)
        for changes in ([], cubes(first, rng)):
            compared = compare(first, ways, changes, options)
            false_m2, seen_m2, true_m2 = areas(compared, changes)
            row: Row = {
                "part": "scenes",
                "name": f"{kind}, {len(changes)} cubes",
                "false_share": false_m2 / seen_m2,
            }
            if true_m2 + false_m2 > 0:
                row["precision"] = true_m2 / (true_m2 + false_m2)
            yield row
            for change in changes:
                for share in recalls(compared, change):
                    name = f"{change.kind}, {change.size_m:g} m"
                    yield {"part": "cubes", "name": name, "recall": share, "found": float(share > _FOUND)}
        for size_m, share in holes(first, rng):
            name = f"hole, {size_m:g} m"
            yield {"part": "cubes", "name": name, "recall": share, "found": float(share > _FOUND)}


def holes(drive: Simulation, rng: np.random.Generator) -> Iterator[tuple[float, float]]:
    """Yield sizes of holes, m, and the share of area there that is gone in the map of the other half of the scans."""
    config = radarsdf.FitConfig.quick(returns={"free_space": True})
    before = radarsdf.fit(drive.points[::2], drive.poses[::2], config=config)
    poses, terrain = drive.poses[1::2], drive.scene.terrain

    def raised(x: Floats) -> NDArray[np.bool_]:
        return x[:, 2] - (0.0 if terrain is None else terrain.height(x[:, :2])) > _NEAR_M

    ends = [scan @ T[:3, :3].T + T[:3, 3] for scan, T in zip(drive.points[1::2], poses, strict=True)]
    x = np.concatenate(ends)
    x = x[raised(x) & (np.abs(drive.scene.signed_distance(x)) < _ON_M)]
    for size_m, _ in itertools.product(_HOLES_M, range(_HOLES)):
        centre, points = x[rng.integers(len(x))], []
        for scan, end in zip(drive.points[1::2], ends, strict=True):
            inside = raised(end) & (np.abs(end - centre).max(axis=1) < size_m / 2)
            points.append(scan * (1 + inside * _EXTENDED_M / np.linalg.norm(scan, axis=1))[:, None])
        found = radarsdf.compare(before, radarsdf.fit(points, poses, config=config)).before
        kinds, face_m2 = found.of_faces()
        middle = found.vertices[found.faces].mean(axis=1)
        on = raised(middle) & (np.abs(middle - centre).max(axis=1) < size_m / 2 - _ON_M)
        if on.any():
            yield size_m, float(face_m2[on & (kinds == GONE)].sum() / face_m2[on].sum())


def other_way(poses: Floats, rng: np.random.Generator) -> Floats:
    """Poses (F, 4, 4) of the second drive."""
    count = len(poses)
    step = np.arange(count)
    first = np.minimum(step, count - 2)
    share = rng.uniform(0.2, 0.8)
    found = poses.copy()
    found[:, :3, 3] = (1 - share) * poses[first, :3, 3] + share * poses[first + 1, :3, 3]
    turns = 2 * np.pi * step / count
    side = 0.6 * np.sin(turns * rng.uniform(0.7, 2) + rng.uniform(0, 2 * np.pi))
    found[:, :3, 3] += side[:, None] * poses[:, :3, 1]
    yaw = 0.06 * np.sin(turns * rng.uniform(1, 3) + rng.uniform(0, 2 * np.pi))
    turned = Rotation.from_rotvec(yaw[:, None] * [0, 0, 1.0]).as_matrix()
    found[:, :3, :3] = turned @ poses[first, :3, :3]
    return found


def cubes(drive: Simulation, rng: np.random.Generator) -> list[Change]:
    """One cube per size and change, on the ground next to the path where there is room; changes of reflectance take the rest."""
    found: list[Change] = []
    centres: list[tuple[Floats, float]] = []
    for kinds in (_CHANGES, _OF_REFLECTANCE):
        for size, kind in itertools.product(_SIZES_M, kinds):
            for _ in range(_TRIES):
                pose = drive.poses[rng.integers(len(drive.poses))]
                angle = 0.4 * rng.uniform(-1, 1) * drive.sensor.azimuth_fov_rad
                ahead = pose[:3, :3] @ [np.cos(angle), np.sin(angle), 0.0]
                xy = pose[:2, 3] + rng.uniform(4, 12) * ahead[:2] / np.linalg.norm(ahead[:2])
                terrain = drive.scene.terrain
                ground = 0.0 if terrain is None else float(terrain.height(xy[None])[0])
                room = drive.scene.signed_distance(np.array([[*xy, ground + size]]))[0]
                clear = np.linalg.norm(drive.poses[:, :2, 3] - xy, axis=1).min() > size + 1.2
                alone = all(np.linalg.norm(at[:2] - xy) > other + size + 2.2 for at, other in centres)
                if room < min(size / 2, 0.9) or not clear or not alone:
                    continue
                centre = np.array([*xy, ground + 0.45 * size])
                cube = Box(centre, np.full(3, size / 2), rng.uniform(0, np.pi), materials.CONCRETE)
                angle, way = rng.uniform(0, 2 * np.pi), rng.uniform(0.2, 2.0)
                elsewhere = centre + way * np.array([np.cos(angle), np.sin(angle), 0.0])
                moved = Box(elsewhere, cube.half_extents, cube.yaw_rad, cube.material)
                pairs = {"put in": (None, cube), "taken out": (cube, None), "moved": (cube, moved)}
                pair = pairs[kind] if kind in pairs else reflectance_changed(kind, cube, ground, rng)
                centres.append((centre, size))
                found.append(Change(kind, size, *pair))
                break
    return found


def reflectance_changed(kind: str, cube: Box, ground: float, rng: np.random.Generator) -> tuple[Box, Box]:
    """A cube, or a patch of asphalt below it, before and after."""
    if kind == "patch of changed reflectance":
        x, y, _ = cube.half_extents
        cube = Box(
            np.array([*cube.center[:2], ground]), np.array([x, y, _PATCH_M]), cube.yaw_rad, materials.ASPHALT
        )
    reflectivity_db = cube.material.reflectivity_db + rng.choice([-1, 1]) * _STRONGER_DB
    other = dataclasses.replace(cube.material, reflectivity_db=reflectivity_db)
    return cube, Box(cube.center, cube.half_extents, cube.yaw_rad, other)


def compare(
    drive: Simulation, ways: tuple[Floats, Floats], changes: list[Change], options: argparse.Namespace
) -> Changes:
    """Compare quick maps of the scenes before and after the changes."""
    drift, seed = options.drift, options.seed
    maps = []
    for day, poses in enumerate(ways):
        boxes = [change.after if day else change.before for change in changes]
        solids = [*drive.scene.solids, *(box for box in boxes if box is not None)]
        scene = Scene(solids, drive.scene.terrain)
        scans = simulate(scene, drive.sensor, poses, name=drive.name, seed=seed + 1000 * day)
        given = drifted(poses, drift[0], np.deg2rad(drift[1]), seed + day) if any(drift) else poses
        config = radarsdf.FitConfig.quick(returns={"free_space": True})
        if options.refine:
            refined = radarsdf.refine_poses(scans.points, given)
            sigma_m, sigma_rad = pose_sigmas(refined.covariance)
            given = refined.poses
            config = config.override(returns={"pose_sigma_m": sigma_m, "pose_sigma_rad": sigma_rad})
        maps.append(radarsdf.fit(scans.points, given, scans.intensities, config=config))
    return radarsdf.compare(maps[0], maps[1])


def areas(found: Changes, changes: list[Change]) -> tuple[float, float, float]:
    """Changed area away from the cubes, all area there that both drives observed, and changed area near the cubes, m²."""
    false = seen = true = 0.0
    boxes = [box for change in changes for box in (change.before, change.after) if box is not None]
    for surface in (found.before, found.after):
        kinds, face_m2 = surface.of_faces()
        middle = surface.vertices[surface.faces].mean(axis=1)
        away = np.ones(len(middle), bool)
        for box in boxes:
            away &= box.signed_distance(middle) > _NEAR_M
        seen += float(face_m2[away & (kinds != UNSEEN)].sum())
        false += float(face_m2[away & (kinds > 0)].sum())
        true += float(face_m2[~away & (kinds > 0)].sum())
    return false, seen, true


def recalls(found: Changes, change: Change) -> list[float]:
    """Share of the area on the cube classified as changed, per drive that maps it; 0 if none does."""
    shares = []
    for surface, box in ((found.before, change.before), (found.after, change.after)):
        if box is None or (change.kind in _OF_REFLECTANCE and surface is found.before):
            continue
        kinds, areas = surface.of_faces()
        on = np.abs(box.signed_distance(surface.vertices[surface.faces].mean(axis=1))) < _ON_M
        shares.append(float(areas[on & (kinds > 0)].sum() / areas[on].sum()) if on.any() else 0.0)
    return shares


EXPERIMENT = Experiment(
    "Changes between two drives",
    rows,
    tuple(KINDS),
    ("seed", "drift", "refine"),
    {"seed": 31},
    COLUMNS,
    ("part",),
    ("name",),
)

if __name__ == "__main__":
    main("bench.changes", EXPERIMENT)
