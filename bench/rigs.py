"""``python -m bench.rigs EXPERIMENT``: three radars on one body, compared with a single one, and with true noise and mountings.

The radars of `scenes/rigs.py` repeat the drive of each scene. The motorway is a file of front and rear radar, passed as a case.
"""

import argparse
import dataclasses
import itertools
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import radarsdf
from numpy.typing import NDArray
from radarsdf import FitConfig, LiveMap, RadarMap
from radarsdf.evaluation import holdout, intensity_metrics, surface_metrics, trajectory_metrics
from radarsdf.poses.rigid import moved, rotation_vector
from radarsdf.returns import noise
from radarsdf.returns.rays import Rays
from radarsdf.rig import Label
from radarsdf.scans import Scans
from radarsdf.simulate import SCENES, MountedRadar, SimulatedRig, Simulation, simulate_rig

from bench.measure import timed
from bench.runner import Column, Experiment, Row, main, quantile
from scenes.kinds import KINDS
from scenes.rigs import FRAME_S, three_radars
from scenes.scene import QUICK

Floats = NDArray[np.float64]

_LABELS = ("front", "rear", "side")
_ALL = (*SCENES, *KINDS)
_TURNING = ("oculii", "yard", "hall", "car_park", "fences")
_DRIVES = ("hugin", "oculii", "forest", "yard", "hall", "slope", "car_park", "fences")
_LATE_S = 0.02  # time offset of the rear radar
_MOUNTING_ERRORS = np.repeat([0.05, np.radians(2.0)], 3)  # standard deviations of given mountings: m, rad


def _drives(options: argparse.Namespace) -> Iterator[tuple[Row, Simulation, int]]:
    for name, seed in itertools.product(options.cases, options.seeds):
        drive = (dict(SCENES) | dict(KINDS))[name](seed=seed, frames=8 if options.quick else None)
        yield {"scene": name, "seed": seed}, drive, seed


def _driven(drive: Simulation, radars: dict[str, MountedRadar], seed: int) -> SimulatedRig:
    times_s = FRAME_S * np.arange(len(drive))
    return simulate_rig(drive.scene, radars, drive.poses, times_s, seed=seed)


def _of(scans: Scans, labels: Sequence[Label]) -> Scans:
    """Select the scans of some radars; of a single one, without its label and with its own poses."""
    assert scans.sensors is not None
    rows = [i for i, label in enumerate(scans.sensors) if label in labels]
    some = scans.select(rows)
    if len(labels) > 1:
        return some
    others: Row = {"doppler_mps": some.doppler_mps, "times_s": some.times_s}
    return Scans(some.points, some.sensor_poses, some.intensities, some.ground_truth, **others)


def fit(options: argparse.Namespace) -> Iterator[Row]:
    """Yield a row per scene, seed and method: F-score, and errors of held-out intensities of each radar.

    All methods have the same returns: with Doppler, only that of the rig would leave out those that move, a tenth.
    """
    for base, drive, seed in _drives(options):
        radars = three_radars(drive.sensor)
        own = _driven(drive, radars, seed).scans
        arrays = own.points, own.poses, own.intensities, own.ground_truth
        scans = Scans(*arrays, sensors=own.sensors, T_body_sensor=own.T_body_sensor)
        train, test = (scans.select(rows) for rows in holdout(len(scans)))
        config = FitConfig(num_threads=options.threads[0], **(QUICK if options.quick else {}))

        def fitted(own: Scans, config: FitConfig = config) -> RadarMap:
            return radarsdf.fit(own, config=config, progress=False)

        with mock.patch.object(noise, "sensor_noise", _true_noise([*radars.values()])):
            true = fitted(_in_one_unit(train, drive, radars))
        rig, one = fitted(train), fitted(Scans(train.points, train.sensor_poses, train.intensities))
        methods = ("rig", "one sensor", "each radar alone", "true noise and gains")
        rows: dict[str, Row] = {method: {} for method in methods}
        for label in _LABELS:
            alone, held_out = fitted(_of(train, [label])), _of(test, [label])
            maps: list[tuple[RadarMap, Row]] = [(rig, {"sensor": label}), (one, {}), (alone, {})]
            predicted = [_predicted(found, held_out, **of_rig) for found, of_rig in maps]
            errors = _intensity_errors(predicted, held_out)
            for method, error in zip(methods[:3], errors, strict=True):
                rows[method][label] = error
        for method, found in zip((*methods[:2], methods[3]), (rig, one, true), strict=True):
            mesh = found.mesh(0.1, progress=False)
            assert scans.ground_truth is not None
            samples = 10_000 if options.quick else 2_000_000
            rows[method]["f_score"] = surface_metrics(mesh, scans.ground_truth, samples=samples)["f_score"]
        for method, row in rows.items():
            yield base | {"method": method} | row


def _true_noise(radars: Sequence[MountedRadar]) -> Callable[..., noise.SensorNoise]:
    """Return a replacement of `sensor_noise` that knows the deviations of each radar."""
    estimate = noise.sensor_noise

    def known(surfels: Any, rays: Rays, *others: Any) -> noise.SensorNoise:
        assert rays.sensor_of_scan is not None
        rows = np.unique(rays.sensor_of_scan[rays.scans])
        if len(rows) != 1:
            return estimate(surfels, rays, *others)
        own = radars[rows[0]].sensor
        return noise.SensorNoise(own.sigma_range_m, own.sigma_azimuth_rad, own.sigma_elevation_rad)

    return known


def _in_one_unit(scans: Scans, drive: Simulation, radars: dict[str, MountedRadar]) -> Scans:
    assert scans.intensities is not None
    assert scans.sensors is not None
    gains = {label: radar.sensor.gain_db - drive.sensor.gain_db for label, radar in radars.items()}
    pairs = zip(scans.intensities, scans.sensors, strict=True)
    same = [values - np.float32(gains[str(label)]) for values, label in pairs]
    return Scans(scans.points, scans.poses, same, sensors=scans.sensors, T_body_sensor=scans.T_body_sensor)


def _predicted(found: RadarMap, test: Scans, **of_rig: Any) -> Floats:
    lengths = [len(points) for points in test.points]
    x = np.concatenate([scan.world_points for scan in test])
    return found.intensity(x, np.repeat(test.poses[:, :3, 3], lengths, axis=0), **of_rig)


def _intensity_errors(predicted: Sequence[Floats], test: Scans) -> list[float | None]:
    """Mean absolute errors, dB, of the intensities of held-out scans of one radar, at returns where no map has NaN; None without."""
    assert test.intensities is not None
    measured, seen = np.concatenate(test.intensities), np.isfinite(predicted).all(axis=0)
    if not seen.any():
        return [None] * len(predicted)
    return [float(intensity_metrics(own[seen], measured[seen])["mae"]) for own in predicted]


def drift(options: argparse.Namespace) -> Iterator[Row]:
    """Yield a row per scene, seed and set of radars: errors of odometry with Doppler, without an IMU."""
    sets = [labels for count in (1, 2, 3) for labels in itertools.combinations(_LABELS, count)]
    for base, drive, seed in _drives(options):
        scans = _driven(drive, three_radars(drive.sensor), seed).scans
        for labels in sets:
            own = _of(scans, labels)
            row = base | {"radars": len(labels), "labels": " ".join(labels)}
            yield row | _odometry_errors(own, options.threads[0])


def _odometry_errors(scans: Scans, threads: int) -> Row:
    try:
        with timed() as taken:
            found = radarsdf.odometry(scans, config=FitConfig(num_threads=threads), progress=False)
    except ValueError as error:
        return {"why_not": str(error)}
    part = found.longest_segment()
    poses, true = found.poses[part], scans.poses[part]
    metrics = trajectory_metrics(poses, true, align="poses")
    end = np.linalg.inv(true[0] @ np.linalg.inv(poses[0]) @ poses[-1]) @ true[-1]
    return {
        "relative": metrics["relative_ratio"],
        "end": float(np.linalg.norm(end[:3, 3])) / max(metrics["length_m"], 1e-9),
        "turned": float(np.degrees(metrics["absolute_rad"])),
        "segments": found.report["segments"],
        "seconds": taken.cpu_s,
    }


def calibrate(options: argparse.Namespace) -> Iterator[Row]:
    """Yield a row per scene, seed and radar: errors of the mountings, and the worst in its own deviations."""
    for base, drive, seed in _drives(options):
        radars = three_radars(drive.sensor)
        radars["rear"] = dataclasses.replace(radars["rear"], time_offset_s=_LATE_S)
        scans = _driven(drive, radars, seed).scans
        true = scans.T_body_sensor
        assert true is not None
        errors = np.random.default_rng(seed).normal(size=(len(_LABELS), 6)) * _MOUNTING_ERRORS
        errors[0] = 0.0
        given = dict(zip(true, moved(np.stack([*true.values()]), errors), strict=True))
        others: Row = {"doppler_mps": scans.doppler_mps, "times_s": scans.times_s, "sensors": scans.sensors}
        unposed = Scans(scans.points, None, T_body_sensor=given, **others)  # type: ignore[arg-type]
        try:
            with timed() as taken:
                found = radarsdf.calibrate(unposed)
        except ValueError as error:
            yield base | {"radar": "all", "why_not": str(error)}
            continue
        for label in _LABELS[1:]:
            own = found.mountings[label]
            late_s = own.time_offset_s - (_LATE_S if label == "rear" else 0.0)
            lever_m = own.T_body_sensor[:3, 3] - true[label][:3, 3]
            turn_rad = _turn(own.T_body_sensor, true[label])
            sigmas = np.append(np.sqrt(own.covariance.diagonal()), own.time_offset_sigma_s)
            ratios = np.abs([*lever_m, *turn_rad, late_s]) / sigmas
            errors_of = {
                "degrees": np.degrees(np.linalg.norm(turn_rad)), "metres": np.linalg.norm(lever_m), "late": abs(late_s)
            }  # fmt: skip
            yield (
                base
                | {"radar": label, "unknown": int(np.isnan(ratios).sum()), "seconds": taken.cpu_s}
                | {name: float(error) if np.isfinite(error) else None for name, error in errors_of.items()}
                | {"worst": float(np.nanmax(ratios)) if np.isfinite(ratios).any() else None}
            )


def _turn(own: Floats, expected: Floats) -> Floats:
    return np.asarray(rotation_vector(own[None, :3, :3] @ expected[None, :3, :3].swapaxes(1, 2))[0])


def motorway(options: argparse.Namespace) -> Iterator[Row]:
    """Yield a row per set of radars of a recording: end of its odometry, errors of calibrated rotations, and findings."""
    for path in options.cases:
        if not Path(path).is_file():
            yield {"radars": path, "why_not": "there is no such file"}
            continue
        for mirrored, labels in ((False, ("F",)), (False, ("B",)), (False, ("F", "B")), (True, ("F", "B"))):
            scans = _of(_motorway(Path(path), mirrored), labels)
            keys = ("radars", "findings", "length, m", "true, m", "height, m", "yaw, °", "rotation, °")
            row: Row = dict.fromkeys(keys, "–") | {"radars": " ".join(labels) + ", mirrored" * mirrored}
            if len(labels) > 1:
                names = {one.name for one in radarsdf.check(scans) if one.severity != "note"}
                row["findings"] = " ".join(sorted(names)) or "none"
            if mirrored:
                yield row
                continue
            found = radarsdf.odometry(scans, progress=False)
            end, true = (np.linalg.inv(poses[0]) @ poses[-1] for poses in (found.poses, scans.poses))
            row |= {
                "length, m": round(float(np.linalg.norm(end[:3, 3])), 2),
                "true, m": round(float(np.linalg.norm(true[:3, 3])), 2),
                "height, m": round(float(end[2, 3] - true[2, 3]), 2),
                "yaw, °": round(float(np.degrees(_turn(end, true)[2])), 2),
            }
            if len(labels) > 1:
                own = {label: one.T_body_sensor for label, one in radarsdf.calibrate(scans).mountings.items()}
                off = np.linalg.inv(own["F"]) @ own["B"]
                given = scans.T_body_sensor
                assert given is not None
                expected = np.linalg.inv(given["F"]) @ given["B"]
                row["rotation, °"] = round(float(np.degrees(np.linalg.norm(_turn(off, expected)))), 2)
            yield row


def _motorway(path: Path, mirrored: bool) -> Scans:
    """Front and rear radar, F and B, that measure together. `mirrored`: with the sign of the elevation reversed."""
    with np.load(path) as arrays:
        body, times_s = arrays["poses_body_gicp"], arrays["times_s"]
        points: list[Any] = []
        doppler: list[Any] = []
        mountings = {}
        for label in ("F", "B"):
            prefix = f"{label}_LRR_C_"
            cuts = np.cumsum(arrays[f"{prefix}counts"])[:-1]
            flip = np.array([1, 1, -1 if mirrored else 1], np.float32)
            points += np.split(arrays[f"{prefix}points"] * flip, cuts)
            doppler += np.split(arrays[f"{prefix}doppler_mps"], cuts)
            mountings[label] = np.linalg.inv(body[0]) @ arrays[f"{prefix}poses"][0]
    labels = [label for label in mountings for _ in body]
    of_rig: Row = {"doppler_mps": doppler, "sensors": labels, "T_body_sensor": mountings}
    scans = Scans(points, np.tile(body, (2, 1, 1)), times_s=np.tile(times_s, 2), **of_rig)
    return scans.select(np.argsort(np.tile(times_s, 2), kind="stable"))


def live(options: argparse.Namespace) -> Iterator[Row]:
    """Yield a row per scene, seed and source of the poses: time of a scan of a rig of three at 20 Hz each."""
    for base, drive, seed in _drives(options):
        radars = three_radars(drive.sensor)
        firsts = zip(radars.items(), (0.0, 0.017, 0.033), strict=True)
        at_20 = {label: dataclasses.replace(own, rate_hz=20.0, first_s=s) for (label, own), s in firsts}
        scans = _driven(drive, at_20, seed).scans
        for source in ("given poses", "odometry"):
            live_map = LiveMap(FitConfig(num_threads=options.threads[0]), T_body_sensor=scans.T_body_sensor)
            wall_ms, lost = [], 0
            for scan, pose in zip(scans, scans.poses, strict=True):
                given = pose if source == "given poses" else None
                others: Row = {"doppler_mps": scan.doppler_mps, "time_s": scan.time_s, "sensor": scan.sensor}
                with timed() as taken:
                    try:
                        live_map.integrate(scan.points, given, scan.intensities, **others)
                    except ValueError:
                        lost += 1
                wall_ms.append(1e3 * taken.wall_s)
            quantiles = {f"p{100 * share:.0f}, ms": quantile(wall_ms, share) for share in (0.5, 0.99, 1)}
            yield base | {"poses": source, "scans": len(scans), "lost": lost, **quantiles}


_OPTIONS, _SEEDS = ("seeds", "threads"), {"seeds": [*range(10)]}

EXPERIMENTS = {
    "fit": Experiment(
        "Surface and held-out intensities of a rig",
        fit,
        _ALL,
        _OPTIONS,
        _SEEDS,
        {"f_score": Column("F, %", 100, 2)} | {label: Column(f"{label}, dB") for label in _LABELS},
        lines=("scene", "method"),
    ),
    "drift": Experiment(
        "Drift of odometry with one, two and three radars",
        drift,
        _DRIVES,
        _OPTIONS,
        _SEEDS,
        {
            "relative": Column("relative, %", 100),
            "end": Column("end, %", 100),
            "turned": Column("°"),
            "segments": Column("segments", 1, 1),
            "seconds": Column("s", 1, 1),
        },
        lines=("radars", "labels"),
        median=True,
    ),
    "calibrate": Experiment(
        "Calibration of mountings and time offsets",
        calibrate,
        _TURNING,
        _OPTIONS,
        _SEEDS,
        {
            "degrees": Column("rotation, °", 1, 3),
            "metres": Column("lever arm, cm", 100, 1),
            "late": Column("time offset, ms", 1000, 1),
            "worst": Column("worst, own deviations", 1, 1),
            "unknown": Column("not observable", 1, 1),
            "seconds": Column("s", 1, 1),
        },
        lines=("scene", "radar"),
    ),
    "motorway": Experiment("Front and rear radar on a motorway", motorway, lines=("radars",)),
    "live": Experiment(
        "Time of a scan in a live map of a rig", live, _TURNING[:2], _OPTIONS, {"seeds": [0], "threads": [2]}
    ),
}

if __name__ == "__main__":
    main("bench.rigs", EXPERIMENTS)
