# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Figures of the returns of a drive: where they are, how noisy along each axis, and how many are of no surface."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from .drives import MIN_RANGE_M, Drive

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

BANDS_M = ((MIN_RANGE_M, 10.0), (10.0, 20.0), (20.0, 30.0), (30.0, 45.0), (45.0, 60.0))
AXES = ("beam", "azimuth", "elevation")
_FEWEST = 50  # returns for a figure; of fewer there is none
_CONE_RAD = np.deg2rad(1.5)  # the lidar covers a direction if it has points this near to it,
_CONE_POINTS = 3  # at least so many in the same scan
_GATE_M = 1.5  # returns farther from their plane say nothing of the noise
_TOGETHER = 1000  # returns whose pieces are in memory at once
_ALONG_NORMAL = 0.85  # a plane measures the axis whose share in its normal is at least this
_FALSE_M = 1.0  # a return farther from every lidar point is called false
_REPEAT_PER_M = 0.02  # returns of two scans agree if they are nearer than this share of the range


def figures(drive: Drive) -> dict[str, float]:
    """The figures by name, each followed by its range band, such as `median distance m 10-20`.

    NaN where fewer than 50 returns tell it. Distances are those to the nearest lidar point. Deviations are those from
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
    """Mask (N,) of the returns in whose direction the lidar has points in the same scan."""
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
    """Signed distances of returns to flat pieces of the lidar's surface, and which axis of the sensor they measure.

    A piece is all lidar points within 0.4 m, or 2.5 % of the range if that is more, of the point nearest to the return.
    It is flat if its thickness is below 6 cm and below 0.22 of its width.

    Parameters
    ----------
    drive : Drive
        N returns.
    world : (N, 3) float64
        The returns, world frame, m.
    nearest : (N,) int64
        Index of the lidar point nearest to each return.

    Returns
    -------
    errors_m : (N,) float64
        Distance along the normal of the plane, m.
    axis : (N,) int64
        0: the normal is along the beam, 1: along the azimuth, 2: along the elevation; -1: oblique, or no plane.
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
    """Count (n,), mean (n, 3), least axis (n, 3) and ascending variances (n, 3) of the points in n balls, none empty."""
    own = tree.query_ball_point(middle, radius_m, return_sorted=False)
    count = np.array([len(rows) for rows in own])
    first = np.cumsum(count) - count
    # From the middle, or UTM coordinates would cost digits.
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
    """The stronger and the weaker half of some returns."""
    middle = _median(intensities[rows])
    return rows & (intensities > middle), rows & (intensities <= middle)


def _median(values: FloatArray) -> float:
    return float(np.median(values)) if len(values) >= _FEWEST else float("nan")


def _mean(values: FloatArray | BoolArray) -> float:
    return float(np.mean(values)) if len(values) >= _FEWEST else float("nan")
