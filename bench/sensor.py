"""Noise and false returns of a radar, measured against lidar, on recorded and simulated drives.

`python -m bench.sensor FILE.npz ...`.
"""

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from radarsdf.simulate import SCENES, Simulation
from scipy.spatial import cKDTree

from bench.runner import Experiment, Row, main

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

MIN_RANGE_M = 2.5
# A lidar like those of the recorded drives: 16 rings. Weak echoes are lost: half of the drives' lidar points are within
# 18 m, and a twentieth beyond 45 m.
_RINGS_RAD = np.deg2rad(np.arange(-15.0, 15.1, 2.0))
_COLUMN_RAD = np.deg2rad(0.3)
_LIDAR_ABOVE_RADAR_M = 0.4
_LIDAR_MAX_RANGE_M = 100.0
_LIDAR_SIGMA_M = 0.02
_LIDAR_SURE_M = (
    100.0  # a matt surface seen straight on is always found up to here; the power falls with range squared
)


BANDS_M = ((MIN_RANGE_M, 10.0), (10.0, 20.0), (20.0, 30.0), (30.0, 45.0), (45.0, 60.0))
AXES = ("beam", "azimuth", "elevation")
_FEWEST = 50  # smallest number of returns for a figure
_CONE_RAD = np.deg2rad(1.5)  # the lidar covers a direction if it has points this close to it,
_CONE_POINTS = 3  # at least this many in the same scan
_GATE_M = 1.5  # gate: returns farther from their plane carry no information on the noise
_TOGETHER = 1000  # returns whose neighbourhoods are in memory at once
_ALONG_NORMAL = 0.85  # a plane measures the axis with at least this share in its normal
_FALSE_M = 1.0  # returns farther from every lidar point are false
_REPEAT_PER_M = 0.02  # returns of two scans agree within this share of the range


@dataclass(frozen=True, eq=False)
class Drive:
    """N returns of F radar scans and M lidar points."""

    name: str
    points: FloatArray  # (N, 3) sensor frame, m
    intensities: FloatArray  # (N,) dB
    frame: NDArray[np.int64]  # (N,) number of the scan
    poses: FloatArray  # (F, 4, 4) T_world_sensor
    lidar: FloatArray  # (M, 3) world frame, m
    lidar_frame: NDArray[np.int64]  # (M,)

    def range_m(self) -> FloatArray:
        """Distance (N,) from the sensor, m."""
        range_m: FloatArray = np.linalg.norm(self.points, axis=1)
        return range_m

    def in_world(self, vectors: FloatArray) -> FloatArray:
        """Rotate vectors (N, 3), one per return, from the sensor frame into the world frame."""
        turned: FloatArray = np.einsum("nij,nj->ni", self.poses[self.frame, :3, :3], vectors)
        return turned

    def world_points(self) -> FloatArray:
        """The returns (N, 3) in the world frame, m."""
        return self.in_world(self.points) + self.poses[self.frame, :3, 3]


def recorded(path: Path) -> Drive:
    """Load a drive from an .npz file with `lidar_frame` and the arrays of `read_scans`; static returns only."""
    with np.load(path) as arrays:
        used = arrays["static"] & (np.linalg.norm(arrays["points"], axis=1) >= MIN_RANGE_M)
        return Drive(
            name=path.stem,
            points=arrays["points"][used].astype(np.float64),
            intensities=arrays["intensity"][used].astype(np.float64),
            frame=arrays["frame"][used].astype(np.int64),
            poses=arrays["poses"].astype(np.float64),
            lidar=arrays["lidar_points"].astype(np.float64),
            lidar_frame=arrays["lidar_frame"].astype(np.int64),
        )


def with_lidar(simulation: Simulation, same_lidar: Drive | None = None) -> Drive:
    """Build a simulated drive, with the points of a lidar of 16 rings on its surfaces.

    They do not depend on the radar, so they can be shared by drives through the same scene with the same poses.
    """
    points = np.concatenate(simulation.points).astype(np.float64)
    used = np.linalg.norm(points, axis=1) >= MIN_RANGE_M
    if same_lidar is None:
        scans = [_lidar_scan(simulation, frame) for frame in range(len(simulation))]
        lidar, lidar_frame = (
            np.concatenate(scans),
            np.repeat(np.arange(len(scans)), [len(scan) for scan in scans]),
        )
    else:
        lidar, lidar_frame = same_lidar.lidar, same_lidar.lidar_frame
    return Drive(
        name=f"{simulation.name}, seed {simulation.seed}",
        points=points[used],
        intensities=np.concatenate(simulation.intensities).astype(np.float64)[used],
        frame=np.repeat(np.arange(len(simulation)), [len(scan) for scan in simulation.points])[used],
        poses=simulation.poses,
        lidar=lidar,
        lidar_frame=lidar_frame,
    )


def _lidar_scan(simulation: Simulation, frame: int) -> FloatArray:
    rng = np.random.default_rng([simulation.seed, frame])
    azimuth = np.arange(-np.pi, np.pi, _COLUMN_RAD)
    angles = np.stack(np.meshgrid(azimuth, _RINGS_RAD), axis=-1).reshape(-1, 2)
    cos = np.cos(angles[:, 1])
    ahead, left, up = cos * np.cos(angles[:, 0]), cos * np.sin(angles[:, 0]), np.sin(angles[:, 1])
    T_world_sensor = simulation.poses[frame]
    directions = np.stack([ahead, left, up], axis=1) @ T_world_sensor[:3, :3].T
    origin = T_world_sensor[:3, 3] + _LIDAR_ABOVE_RADAR_M * T_world_sensor[:3, 2]
    hits = simulation.scene.raycast(origin, directions, _LIDAR_MAX_RANGE_M)
    cos_incidence = np.abs(np.einsum("ni,ni->n", hits.normals, directions))
    found = rng.random(len(directions)) < cos_incidence * (_LIDAR_SURE_M / hits.range_m) ** 2
    range_m = hits.range_m[found] + _LIDAR_SIGMA_M * rng.standard_normal(int(found.sum()))
    points: FloatArray = origin + range_m[:, None] * directions[found]
    return points


def figures(drive: Drive) -> dict[str, float]:
    """Figures by name, each followed by its range band, such as `median distance m 10-20`.

    NaN for fewer than 50 returns. Distances are those to the nearest lidar point. Deviations are relative to
    planes through lidar points; see `plane_errors`.
    """
    range_m, world = drive.range_m(), drive.world_points()
    distance_m, nearest = cKDTree(drive.lidar).query(world)
    covered = is_covered(drive)
    false = distance_m > _FALSE_M
    repeats = _repeats(drive, world)
    errors_m, axis = plane_errors(drive, world, nearest)
    scans = len(drive.poses)
    found = {
        "returns per scan": len(range_m) / scans,
        "intensity dB, median": float(np.median(drive.intensities)),
        "intensity dB, 90 %": float(np.percentile(drive.intensities, 90)),
    }
    for low, high in (*BANDS_M, (BANDS_M[-1][1], np.inf)):
        rows = (range_m >= low) & (range_m < high)
        name = f"{low:g}-{high:g}"
        found[f"returns per scan {name}"] = int(rows.sum()) / scans
        if high == np.inf:
            break
        found[f"median distance m {name}"] = _median(distance_m[rows])
        for limit_m in (0.4, 1.0, 2.0):
            found[f"share farther than {limit_m:g} m {name}"] = _mean(distance_m[rows & covered] > limit_m)
        strong, weak = _halves(drive.intensities, rows)
        found[f"distance, strong / weak {name}"] = _median(distance_m[strong]) / _median(distance_m[weak])
        found[f"false returns seen again {name}"] = _mean(repeats[rows & false])
        for k, axis_name in enumerate(AXES):
            own = rows & (axis == k)
            per = range_m if k else np.ones_like(range_m)  # angles in rad, the beam in m
            unit = "rad" if k else "m"
            found[f"deviation {axis_name} {unit} {name}"] = deviation(
                errors_m[own] / per[own], _gate(per[own])
            )
            strong, weak = _halves(drive.intensities, own)
            found[f"deviation {axis_name}, strong / weak {name}"] = deviation(
                errors_m[strong] / per[strong], _gate(per[strong])
            ) / deviation(errors_m[weak] / per[weak], _gate(per[weak]))
    return found


def is_covered(drive: Drive) -> BoolArray:
    """Mask (N,) of the returns in directions where the lidar has points in the same scan."""
    range_m = drive.range_m()
    covered = np.zeros(len(range_m), dtype=bool)
    for frame, T_world_sensor in enumerate(drive.poses):
        rows = np.flatnonzero(drive.frame == frame)
        lidar = (drive.lidar[drive.lidar_frame == frame] - T_world_sensor[:3, 3]) @ T_world_sensor[:3, :3]
        tree = cKDTree(lidar / np.linalg.norm(lidar, axis=1, keepdims=True))
        near = tree.query_ball_point(drive.points[rows] / range_m[rows, None], _CONE_RAD, return_length=True)
        covered[rows] = near >= _CONE_POINTS
    return covered


def plane_errors(
    drive: Drive, world: FloatArray, nearest: NDArray[np.int64]
) -> tuple[FloatArray, NDArray[np.int64]]:
    """Signed distances (N,), m, of returns to flat neighbourhoods of the lidar's surface, and the sensor axis they measure (N,).

    A neighbourhood is all lidar points within 0.4 m, or 2.5 % of the range if that is more, of the point `nearest` (N,) to the
    return. It is flat if its thickness is below 6 cm and below 0.22 of its width. Axis 0: its normal is along the beam, 1: along
    the azimuth, 2: along the elevation, -1: oblique, or no plane.
    """
    range_m = drive.range_m()
    beam = drive.points / range_m[:, None]
    left = np.stack([-beam[:, 1], beam[:, 0], np.zeros(len(beam))], axis=1)
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    axes = np.stack([drive.in_world(v) for v in (beam, left, np.cross(beam, left))], axis=1)
    tree, errors_m = cKDTree(drive.lidar), np.full(len(world), np.nan)
    axis = np.full(len(world), -1)
    near = np.flatnonzero(np.linalg.norm(world - drive.lidar[nearest], axis=1) < 2.0)
    for rows in np.split(near, range(_TOGETHER, len(near), _TOGETHER)):
        middle, radius_m = drive.lidar[nearest[rows]], np.maximum(0.4, 0.025 * range_m[rows])
        count, centre, normal, variances = _pieces(drive.lidar, tree, middle, radius_m)
        thin, wide = variances[:, 0], variances[:, 1]
        flat = (count >= 10) & (wide > 0.03 * radius_m**2) & (thin < 0.06**2) & (thin < 0.05 * wide)
        error_m = np.einsum("ni,ni->n", normal, world[rows] - centre)
        shares = np.abs(np.einsum("nai,ni->na", axes[rows], normal))
        used = flat & (np.abs(error_m) < _GATE_M) & (shares.max(axis=1) > _ALONG_NORMAL)
        errors_m[rows[used]], axis[rows[used]] = error_m[used], shares[used].argmax(axis=1)
    return errors_m, axis


def _pieces(
    points: FloatArray, tree: cKDTree, middle: FloatArray, radius_m: FloatArray
) -> tuple[NDArray[np.int64], FloatArray, FloatArray, FloatArray]:
    """Count (n,), mean (n, 3), smallest axis (n, 3) and ascending variances (n, 3) of the points in n balls, none empty."""
    own = tree.query_ball_point(middle, radius_m, return_sorted=False)
    count = np.array([len(rows) for rows in own])
    first = np.cumsum(count) - count
    # Relative to the mean, since UTM coordinates would lose precision.
    spread_m = points[np.concatenate(own).astype(np.int64)] - np.repeat(middle, count, axis=0)
    mean = np.add.reduceat(spread_m, first) / count[:, None]
    spread_m -= np.repeat(mean, count, axis=0)
    products = [np.add.reduceat(spread_m * spread_m[:, k, None], first) for k in range(3)]
    covariance = np.stack(products, axis=1) / np.maximum(count - 1, 1)[:, None, None]
    variances, directions = np.linalg.eigh(covariance)
    return count, middle + mean, directions[:, :, 0], variances


def deviation(errors: FloatArray, gate: float) -> float:
    """Standard deviation of a Gaussian in a uniform background of [-gate, gate], by maximum likelihood."""
    if len(errors) < _FEWEST:
        return float("nan")
    sigma, share = 0.3 * gate, 0.7
    for _ in range(200):
        bell = share * np.exp(-0.5 * (errors / sigma) ** 2) / (sigma * np.sqrt(2 * np.pi))
        member = bell / (bell + (1 - share) / (2 * gate))
        sigma, share = float(np.sqrt((member * errors**2).sum() / member.sum())), float(member.mean())
    return sigma


def _gate(per: FloatArray) -> float:
    return _GATE_M / float(np.median(per)) if len(per) else _GATE_M


def _repeats(drive: Drive, world: FloatArray) -> FloatArray:
    """Share (N,) of the other scans that have a return near each return."""
    reach_m = _REPEAT_PER_M * drive.range_m()
    near = cKDTree(world).query_ball_point(world, reach_m)
    count = [len(set(drive.frame[rows].tolist())) - 1 for rows in near]
    shares: FloatArray = np.asarray(count, dtype=np.float64) / (len(drive.poses) - 1)
    return shares


def _halves(intensities: FloatArray, rows: BoolArray) -> tuple[BoolArray, BoolArray]:
    """Masks of the stronger and the weaker half of some returns."""
    middle = _median(intensities[rows])
    return rows & (intensities > middle), rows & (intensities <= middle)


def _median(values: FloatArray) -> float:
    return float(np.median(values)) if len(values) >= _FEWEST else float("nan")


def _mean(values: FloatArray | BoolArray) -> float:
    return float(np.mean(values)) if len(values) >= _FEWEST else float("nan")


def medians(found: Sequence[dict[str, float]]) -> dict[str, float]:
    """Median of each figure over the drives that have it, NaN if none has."""
    values = {name: np.array([one[name] for one in found]) for name in found[0]}
    return {
        name: float(np.nanmedian(own)) if np.isfinite(own).any() else float("nan")
        for name, own in values.items()
    }


def rows(options: argparse.Namespace) -> Iterator[Row]:
    """Yield a row per figure: recorded drives (median, minimum, maximum), simulations (median), and their ratio."""
    drives = [figures(recorded(Path(path))) for path in options.cases]
    simulations = [figures(with_lidar(SCENES["astyx"](seed=seed))) for seed in options.seeds]
    simulated = medians(simulations)
    for name, real in medians(drives).items():
        own = [found[name] for found in drives if np.isfinite(found[name])]
        yield {
            "figure": name,
            "drives, median": _number(real),
            "least…most": f"{min(own):.3g}…{max(own):.3g}" if own else "–",
            "simulated, median": _number(simulated[name]),
            "ratio": _number(simulated[name] / real if real > 0 else np.nan),
        }


def _number(value: float) -> str:
    return f"{value:.3g}" if np.isfinite(value) else "–"


EXPERIMENT = Experiment(
    "Recorded and simulated returns", rows, options=("seeds",), defaults={"seeds": [0, 1, 2, 3, 4]}
)

if __name__ == "__main__":
    main("bench.sensor", EXPERIMENT)
