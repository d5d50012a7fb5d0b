# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""``python -m bench.breakages [FILE.npz ...]``: a table of breakages and scenes, simulated and the given ones."""

from __future__ import annotations

import argparse
import itertools
from pathlib import Path

import numpy as np
import radarsdf
from radarsdf.checking.check import check_cheaply
from radarsdf.checking.doppler import velocity_of_poses
from radarsdf.io.poses.trajectory import Trajectory
from scipy.spatial.transform import Rotation

from bench.breakages.ways import NEED_DOPPLER, WAYS, Data, with_other_sign
from bench.timing import timed

SCENES = (
    ("hugin", 120),
    ("hugin", 12),
    ("oculii", 120),
    ("oculii", 24),
    ("wall", 30),
    ("astyx", 20),
    ("astyx", 8),
)
_STEP_S = 0.1  # between scans, or more
_FASTEST_MPS = 55.0
_NAMED, _UNTRIED = "named", "–"
_GOOD = {name: (range(1, 8), (3, 5, 8, 15, 40)) for name in ("hugin", "oculii", "wall", "astyx")}
"""Seeds and numbers of scans of good recordings."""
_SLOW_M = (0.02, 0.05, 0.2)
"""Steps of slow ones."""


def simulated(name: str, frames: int, seed: int = 0) -> Data:
    """A simulated scene, with Doppler of its poses and a tenth of the returns moving at 3 m/s."""
    scans = getattr(radarsdf.simulate, name)(seed=seed, frames=frames)
    rng = np.random.default_rng(seed)
    step_m = np.median(np.linalg.norm(np.diff(scans.poses[:, :3, 3], axis=0), axis=1))
    times_s = max(_STEP_S, step_m / _FASTEST_MPS) * np.arange(frames, dtype=np.float64)
    doppler = []
    for scan, velocity_mps in zip(scans.points, velocity_of_poses(scans.poses, times_s), strict=True):
        away = scan / np.linalg.norm(scan, axis=1, keepdims=True)
        speeds = -away @ velocity_mps + rng.normal(0, 0.05, len(scan))
        doppler.append(speeds + np.where(rng.random(len(scan)) < 0.1, 3.0, 0.0))
    return Data(scans.points, scans.poses, scans.intensities, doppler, times_s)


def slow(name: str, step_m: float, seed: int = 0, cell: float = 0.0) -> Data:
    """A simulated place from a sensor that moves `step_m` between 24 scans, after half of them were taken from one position.

    `cell`: range, m, and angles, 0.1 rad, that the sensor rounds to; 0: none.
    """
    drive = (dict(radarsdf.simulate.SCENES) | dict(radarsdf.simulate.KINDS))[name](seed=seed, frames=12)
    usual_m = np.linalg.norm(np.diff(drive.poses[:2, :3, 3], axis=0))
    at = np.maximum(np.arange(24.0) - 12, 0) * min(step_m / usual_m, 1)
    along = Trajectory(np.arange(12.0), drive.poses[:, :3, 3], Rotation.from_matrix(drive.poses[:, :3, :3]))
    scans = radarsdf.simulate.simulate(
        drive.scene, drive.sensor, along.poses(at), name=name, seed=seed
    )
    points = scans.points
    if cell:
        points = [_rounded(scan, cell) for scan in points]
    intensities = [values[: len(scan)] for values, scan in zip(scans.intensities, points, strict=True)]
    return Data(points, scans.poses, intensities)


def _rounded(scan: np.ndarray, cell_m: float) -> np.ndarray:
    """A scan (N, 3) by a sensor with cells, each of which reports one return."""
    range_m = np.linalg.norm(scan, axis=1)
    angles = np.stack([np.arctan2(scan[:, 1], scan[:, 0]), np.arcsin(scan[:, 2] / range_m)])
    azimuth, elevation = 0.1 * np.round(angles / 0.1)
    range_m = cell_m * np.maximum(np.round(range_m / cell_m), 1)
    cells = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )
    return np.unique(np.float32(range_m * cells).T, axis=0)


def recorded(path: Path) -> Data:
    """A file of scans; with the arrays doppler, negative for what comes nearer, and times if it has them."""
    with np.load(path) as file:
        frame, count = file["frame"], len(file["poses"])

        def split(name: str) -> list[np.ndarray]:
            values = file[name]
            return [values[frame == i] for i in range(count)]

        doppler = split("doppler") if "doppler" in file else None
        times_s = file.get("times")
        data = Data(split("points"), file["poses"].astype(np.float64), split("intensity"), doppler, times_s)
    # Some sensors measure speeds with the other sign. Turned, it is a breakage for all.
    turned = "doppler_sign" in [name for name, _ in found_in(data, cheap=False)]
    return with_other_sign(data) if turned else data


def main() -> None:
    """Print the table, the share of breakages that are named, and the false alarms in good data."""
    parser = argparse.ArgumentParser(prog="python -m bench.breakages", description=__doc__)
    parser.add_argument("files", nargs="*", type=Path, help="recorded scans, .npz")
    parser.add_argument("--quick", action="store_true", help="two small scenes")
    parser.add_argument(
        "--cheap", action="store_true", help="the checks of radarsdf fit, without Doppler and times"
    )
    options = parser.parse_args()
    chosen = (("wall", 12), ("astyx", 8)) if options.quick else SCENES
    scenes = {f"{name} {frames}": simulated(name, frames) for name, frames in chosen}
    scenes |= {path.stem: recorded(path) for path in options.files}
    columns = list(scenes)
    print("| breakage | finding | named | " + " | ".join(columns) + " |")
    print("|---" * (len(columns) + 3) + "|")
    named = tried = 0
    for words, (finding, broken) in WAYS.items():
        cells: list[str] = []
        for data in scenes.values():
            if words in NEED_DOPPLER and (data.doppler_mps is None or options.cheap):
                cells.append(_UNTRIED)
                continue
            findings = found_in(broken(data), options.cheap)
            worse = [name for name, severity in findings if severity != "note"]
            hit = finding in [name for name, _ in findings]
            tried += 1
            named += hit
            cells.append(_NAMED if hit else ", ".join(worse) or "no")
        share = f"{cells.count(_NAMED)} of {len(cells) - cells.count(_UNTRIED)}"
        print(f"| {words} | `{finding}` | {share} | " + " | ".join(cells) + " |", flush=True)
    print(f"\n{named} of {tried} breakages are named: {named / tried:.1%}")
    good = dict(scenes)
    if not options.quick:
        for name, (seeds, lengths) in _GOOD.items():
            good |= {f"{name} {f} seed {s}": simulated(name, f, s) for s in seeds for f in lengths}
        kinds = [*radarsdf.simulate.SCENES, *radarsdf.simulate.KINDS]
        for name, step_m, cell in itertools.product(kinds, _SLOW_M, (0.0, 0.5)):
            good[f"{name} {step_m} m a scan, cells of {cell} m"] = slow(name, step_m, cell=cell)
    alarms = {}
    with timed() as taken:
        for name, data in good.items():
            if alarm := [found for found in found_in(data, options.cheap) if found[1] != "note"]:
                alarms[name] = alarm
    seconds = taken.wall_s / len(good)
    print(
        f"{len(alarms)} of {len(good)} good recordings have a finding worse than a note: {alarms}; {seconds:.2f} s each"
    )


def found_in(data: Data, cheap: bool) -> list[tuple[str, str]]:
    """Names and severities of the findings."""
    if cheap:
        findings = check_cheaply(data.points, data.poses, data.intensities)
    else:
        findings = radarsdf.check(**data.arguments())
    return [(finding.name, finding.severity) for finding in findings]


if __name__ == "__main__":
    main()
