"""Odometry compared with that of peers on the same scans: `python -m bench.peers.odometry [FILE.npz ...]`.

`kiss-icp` and `small_gicp` come from their wheels (`python -m bench.peers.install odometry`). Both are made for lidars, so
each runs with several voxel sizes; the best one per drive, chosen by the true poses, is reported, in their favour.
"""

import argparse
import itertools
import subprocess
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import radarsdf
from numpy.typing import NDArray
from radarsdf.evaluation import trajectory_metrics
from radarsdf.io import Imu
from radarsdf.simulate import SCENES, measured_motion

from bench.measure import ROOT, failure
from bench.peers.interface import ODOMETRY_ENVIRONMENT
from bench.runner import Experiment, Row, main

_VOXELS_M = (0.5, 1.0, 2.0)
_PEERS = ("kiss-icp", "small_gicp")
_KINDS = ("hugin", "oculii", "wall", "astyx")


@dataclass(frozen=True)
class Drive:
    """Scans with true poses, and motion measurements."""

    name: str
    points: Sequence[NDArray[Any]]
    poses: NDArray[np.float64]
    times_s: NDArray[np.float64]
    doppler_mps: Sequence[NDArray[Any]]
    rates: NDArray[np.float64] | None
    """(F, 3) gyroscope rates, rad/s. None: there is no gyroscope."""


def simulated(seeds: Iterable[int]) -> Iterator[Drive]:
    """Yield a drive per kind and seed."""
    for kind in _KINDS:
        for seed in seeds:
            drive = SCENES[kind](seed=seed)
            motion = measured_motion(drive, seed=seed)
            yield Drive(
                f"{kind} {seed}",
                drive.points,
                drive.poses,
                motion.times_s,
                motion.doppler_mps,
                motion.angular_velocity,
            )


def recorded(path: Path) -> Drive:
    """Load an .npz with times and Doppler, and the poses of a lidar."""
    scans = radarsdf.io.read_scans(path)
    assert scans.times_s is not None
    assert scans.doppler_mps is not None
    return Drive(path.stem, scans.points, scans.poses, scans.times_s, scans.doppler_mps, None)


def rows(options: argparse.Namespace) -> Iterator[Row]:
    """Yield a row per drive: position errors in % of the path, errors of 10 to 50 % segments in % of them and degrees per metre."""
    for drive in itertools.chain(map(recorded, map(Path, options.cases)), simulated(options.seeds)):
        row: Row = {"drive": drive.name, "scans": len(drive.points)}
        for name, given in _OURS.items():
            row[name] = _ours(drive, **given)
        for name in _PEERS:
            row[name] = _best([_peer(name, drive, voxel_m) for voxel_m in _VOXELS_M])
        yield row


_OURS: dict[str, dict[str, bool]] = {
    "radarsdf, Doppler": {"doppler": True, "gyroscope": False},
    "radarsdf, Doppler, gyroscope": {"doppler": True, "gyroscope": True},
    "radarsdf, returns alone": {"doppler": False, "gyroscope": False},
}


def _ours(drive: Drive, *, doppler: bool, gyroscope: bool) -> str:
    if gyroscope and drive.rates is None:
        return "–"
    imu = None
    if gyroscope and drive.rates is not None:
        imu = Imu(drive.times_s, drive.rates, R_sensor_imu=np.eye(3))
    try:
        found = radarsdf.odometry(
            drive.points, times_s=drive.times_s, doppler_mps=drive.doppler_mps if doppler else None, imu=imu
        )
    except ValueError:
        return "refused"
    part = found.longest_segment()
    words = _words(_errors(found.poses[part], drive.poses[part]))
    count = part.stop - part.start
    return words if count == len(drive.points) else f"{words} ({count} scans in one segment)"


def _peer(name: str, drive: Drive, voxel_m: float) -> tuple[float, float, float] | str:
    """Errors of a peer, or the reason why there are none."""
    python = ODOMETRY_ENVIRONMENT / "bin" / "python"
    if not python.exists():
        return "not installed"
    with tempfile.TemporaryDirectory() as folder:
        scans, poses = Path(folder) / "scans.npz", Path(folder) / "poses.npy"
        np.savez(scans, points=np.concatenate(drive.points), counts=[len(scan) for scan in drive.points])
        command = [
            str(python),
            "-m",
            "bench.peers.odometry_child",
            name,
            str(voxel_m),
            str(scans),
            str(poses),
        ]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            return failure(done)
        return _errors(np.load(poses), drive.poses)


def _errors(poses: NDArray[np.float64], true: NDArray[np.float64]) -> tuple[float, float, float]:
    """Errors of all positions, % of the path; of motions along 10 to 50 % of it, % of them and degrees per metre."""
    metrics = trajectory_metrics(poses, true)
    ratio, rad_per_m = metrics["relative_ratio"], metrics["relative_rad_per_m"]
    assert ratio is not None
    assert rad_per_m is not None
    return 100 * metrics["absolute_m"] / metrics["length_m"], 100 * ratio, float(np.degrees(rad_per_m))


def _best(found: list[tuple[float, float, float] | str]) -> str:
    observed = [errors for errors in found if not isinstance(errors, str)]
    return _words(min(observed)) if observed else str(found[0])


def _words(errors: tuple[float, float, float]) -> str:
    return f"{errors[0]:.2f}; {errors[1]:.2f}; {errors[2]:.3f}"


EXPERIMENT = Experiment("Odometry", rows, options=("seeds",), defaults={"seeds": [91, 92, 93]})

if __name__ == "__main__":
    main("bench.peers.odometry", EXPERIMENT)
