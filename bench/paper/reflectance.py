"""Predicted intensities and scans, compared with held-out ones."""

import argparse
import itertools
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from radarsdf import RadarMap
from radarsdf.evaluation import KNNIntensity, intensity_metrics
from radarsdf.map.view import View
from radarsdf.render.figures import save_view_picture
from scipy.spatial import cKDTree

from bench.runner import Column, Row, chosen_scenes
from scenes.scene import Scene
from scenes.settings import Changes, merged

Floats = NDArray[np.float64]

INTENSITY_COLUMNS = {
    "mae": Column("MAE", best="lowest"),
    "medae": Column("MedAE", best="lowest"),
    "noise_floor": Column("noise floor of the MAE"),
}
_NAMES = {"default": "radarsdf", "paper": "3QFPI"}
_NO_INTENSITIES = "the scene has no intensities"


def intensity(options: argparse.Namespace) -> Iterator[Row]:
    """Yield a row for the nearest-neighbour baseline, and per configuration and seed."""
    for scene in chosen_scenes(options):
        row: Row = {"scene": scene.name}
        if scene.intensities is None:
            yield row | {"method": "all", "why_not": _NO_INTENSITIES}
            continue
        train, test = scene.split()
        if test.simulation is not None:
            row["noise_floor"] = test.simulation.intensity_noise_floor()
        x, sensors, measured = test.world_returns()
        known = train.rays()
        assert known.intensities is not None
        knn = KNNIntensity.chosen(*known.in_world(), known.intensities, known.scans)
        metrics = intensity_metrics(knn.predict(x, sensors), measured)
        yield row | {"method": "kNN", "k": knn.k, "candidates": knn.candidates, **metrics}
        for base, seed in itertools.product(options.base, range(options.repetitions)):
            radar_map = train.fit(train.config(base, quick=options.quick, seed=seed))
            yield row | {"method": _NAMES[base], "seed": seed, **errors_of(radar_map, test)}


def errors_of(radar_map: RadarMap, test: Scene) -> Row:
    """Errors of intensities at the returns of held-out scans, extrapolated where the map observed nothing, like kNN."""
    x, sensors, measured = test.world_returns()
    return {**intensity_metrics(radar_map.intensity(x, sensors, extrapolate=True), measured)}


# All inputs of the paper, including those that the default configuration omits.
_FULL: Changes = {"networks": {"normals": True, "geometry_feature_dim": 15}}
_VARIANTS: dict[str, Changes] = {
    "full": {},
    "w/o SDF normals": {"networks": {"normals": False}},
    "w/o geometry feature": {"networks": {"geometry_feature_dim": 0}},
    "w/o viewing direction": {"networks": {"view_direction": False}},
}


def ablation(options: argparse.Namespace) -> Iterator[Row]:
    """Yield a row per configuration, seed, and omitted input."""
    for scene, base, variant in itertools.product(list(chosen_scenes(options)), options.base, _VARIANTS):
        row: Row = {"scene": scene.name, "base": base, "variant": variant}
        if scene.intensities is None:
            yield row | {"why_not": _NO_INTENSITIES}
            continue
        train, test = scene.split()
        for seed in range(options.repetitions):
            config = train.config(base, quick=options.quick, seed=seed, **merged(_FULL, _VARIANTS[variant]))
            yield row | {"seed": seed, **errors_of(train.fit(config), test)}


_ANGLES_DEG = range(-90, 90, 15)
_REFLECTOR_M = 0.6  # radius of the reflector: edges of 0.3 to 0.4 m, and noise across the beam
VIEW_COLUMNS = {"all": Column("all"), **{str(a): Column(f"{a} to {a + 15}°") for a in _ANGLES_DEG}}


def views(options: argparse.Namespace) -> Iterator[Row]:
    """MAE by viewing angle of the corner reflector, at it and elsewhere, with and without the viewing direction as input.

    Errors are relative to the measured intensities and, in a simulated scene, to the noiseless ones.
    """
    for scene in chosen_scenes(options):
        if scene.intensities is None:
            yield {"scene": scene.name, "base": "all", "why_not": _NO_INTENSITIES}
            continue
        train, test = scene.split()
        reflector = reflector_of(scene)
        x, sensors, measured = test.world_returns()
        truths = {"measured": measured}
        if test.simulation is not None:
            noiseless = enumerate(test.simulation.noiseless_intensities)
            truths["noiseless"] = np.concatenate([values[test.is_used(frame)] for frame, values in noiseless])
        angle_deg = _angle_deg(sensors, reflector)
        near = np.linalg.norm(x - reflector, axis=1) < _REFLECTOR_M
        for base, direction in itertools.product(options.base, (True, False)):
            config = scene.config(base, quick=options.quick, networks={"view_direction": direction})
            predicted = train.fit(config).intensity(x, sensors, extrapolate=True)
            for (truth, values), at_it in itertools.product(truths.items(), (True, False)):
                error = np.where(
                    near == at_it, np.abs(predicted - values), np.nan
                )  # false returns have no noiseless one
                row: Row = {
                    "scene": scene.name,
                    "place": "at the reflector" if at_it else "elsewhere",
                    "base": base,
                }
                row |= {"view direction": direction, "against": truth, "all": _mean(error)}
                for a in _ANGLES_DEG:
                    row[str(a)] = _mean(error[(angle_deg >= a) & (angle_deg < a + 15)])
                yield row


def _mean(values: Floats) -> float | None:
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else None


def reflector_of(scene: Scene) -> Floats:
    """Position (3,) of the reflector, world frame, m.

    It is the centre of the sensor's circular path, at the height of the strongest returns there.
    """
    middle = scene.poses[:, :2, 3].mean(axis=0)
    x, y = (scene.poses[:, :2, 3] - middle).T
    # |p - c|² = r² is linear in c and r² - |c|².
    a, b, _ = np.linalg.lstsq(np.stack([2 * x, 2 * y, np.ones_like(x)], 1), x**2 + y**2, rcond=None)[0]
    centre = np.array([a, b]) + middle
    points, _, measured = scene.world_returns()
    near = np.linalg.norm(points[:, :2] - centre, axis=1) < _REFLECTOR_M
    if not near.any():
        return np.append(centre, scene.poses[:, 2, 3].mean())
    strong = near & (measured >= np.quantile(measured[near], 0.9))
    return np.append(centre, np.median(points[strong, 2]))


def _angle_deg(sensors: Floats, place: Floats) -> Floats:
    """Azimuth (N,), degrees, of the sensor positions (N, 3) as seen from `place`, 0 in the middle of the path."""
    offset = sensors[:, :2] - place[:2]
    azimuth = np.arctan2(offset[:, 1], offset[:, 0])
    middle = np.angle(np.exp(1j * np.unique(azimuth)).mean())  # each scan counts once, not each return
    angle: Floats = np.rad2deg(np.angle(np.exp(1j * (azimuth - middle))))
    return angle


EXPLAINED_M = 0.3
SCAN_COLUMNS = {
    "returns": Column("returns", digits=0),
    "chamfer_m": Column("Chamfer, m"),
    "explained": Column("explained, %", 100, 1),
    "confirmed": Column("confirmed, %", 100, 1),
    "intensity": Column("intensity"),
}
Returns = tuple[Floats, Floats]
"""Points (N, 3), sensor frame, m, and intensities (N,), NaN without any."""


def novel_views(options: argparse.Namespace) -> Iterator[Row]:
    """Compare held-out scans with views that the map predicts from their poses, and with the nearest training scan, replayed.

    A view has as many returns as the sensor, or a multiple. Numbers are means over the held-out scans.
    """
    for scene, base in itertools.product(list(chosen_scenes(options)), options.base):
        train, test = scene.split()
        radar_map = train.fit(train.config(base, quick=options.quick))
        found: dict[str, list[Row]] = {}
        for frame in range(len(test)):
            measured, pose = returns_of(test, frame), test.poses[frame]
            if len(measured[0]) == 0:
                continue
            found.setdefault("replay", []).append(scan_errors(replayed(train, pose), measured))
            for multiple in (1, 2, 4):
                view = radar_map.render(pose, returns=multiple * radar_map.sensor.returns_per_scan)
                found.setdefault(f"view × {multiple}", []).append(scan_errors(_predicted(view), measured))
                if options.meshes is not None and multiple == 1 and frame == len(test) // 2:
                    options.meshes.mkdir(parents=True, exist_ok=True)
                    picture = options.meshes / f"{scene.name}, {base}, view.png"
                    save_view_picture(str(picture), [view], [np.column_stack(measured)])
        for method, rows in found.items():
            means = {key: _mean(np.array([row[key] for row in rows])) for key in rows[0]}
            yield {"scene": scene.name, "base": base, "method": method, **means}


def returns_of(scene: Scene, frame: int) -> Returns:
    """Returns of a scan within the ranges of its scene."""
    points = np.asarray(scene.points[frame], np.float64)
    kept = scene.is_used(frame)
    values = np.full(len(points), np.nan) if scene.intensities is None else scene.intensities[frame]
    return points[kept], np.asarray(values, np.float64)[kept]


def replayed(train: Scene, T_world_sensor: Floats) -> Returns:
    """The training scan nearest to a pose, transformed to that pose."""
    positions = train.poses[:, :3, 3]
    nearest = int(np.linalg.norm(positions - T_world_sensor[:3, 3], axis=1).argmin())
    points, values = returns_of(train, nearest)
    world = points @ train.poses[nearest, :3, :3].T + positions[nearest]
    return (world - T_world_sensor[:3, 3]) @ T_world_sensor[:3, :3], values


def _predicted(view: View) -> Returns:
    values = np.full(len(view), np.nan) if view.intensities is None else view.intensities
    return view.points.astype(np.float64), np.asarray(values, np.float64)


def scan_errors(predicted: Returns, measured: Returns) -> Row:
    """Errors of a predicted scan.

    `chamfer_m`: mean of the two mean distances to the nearest return of the other scan. `explained`: share of the
    measured returns with a predicted one within 0.3 m. `confirmed`: the reverse. `intensity`: mean absolute error of
    the nearest predicted return over the explained ones.
    """
    (points, values), (true, true_values) = predicted, measured
    if len(points) == 0:
        return {"returns": 0, "chamfer_m": np.nan, "explained": 0.0, "confirmed": np.nan, "intensity": np.nan}
    to_predicted_m, nearest = cKDTree(points).query(true)
    to_measured_m, _ = cKDTree(true).query(points)
    explained = to_predicted_m <= EXPLAINED_M
    differences = np.abs(values[nearest] - true_values)[explained]
    return {
        "returns": len(points),
        "chamfer_m": (to_predicted_m.mean() + to_measured_m.mean()) / 2,
        "explained": explained.mean(),
        "confirmed": (to_measured_m <= EXPLAINED_M).mean(),
        "intensity": differences.mean() if len(differences) else np.nan,
    }
