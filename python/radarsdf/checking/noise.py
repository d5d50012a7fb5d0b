"""Elevation, ground, noise and drift of a recording, and the cost of a fit."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from radarsdf.checking.piecewise import changed_mounting
from radarsdf.checking.recording import Finding, FloatArray, ascending_times_s, some_points, some_scans
from radarsdf.config.fit_config import FitConfig
from radarsdf.fitting.estimate import check_extent, estimate_rays
from radarsdf.poses.checked_scans import median_range_m
from radarsdf.poses.refine import RefinedPoses, refine_poses
from radarsdf.poses.rigid import step_vectors
from radarsdf.returns.noise import SensorNoise, sensor_noise, variances_across
from radarsdf.returns.planes import Surfels
from radarsdf.returns.rays import Rays, prepare
from radarsdf.scans import Scans

_FEW_RETURNS = 100
_FLAT = 1e-5  # thickness of the plane of the returns over its extent: float32 rounds to 1e-7
_CLOSE_M = 25.0  # noise in elevation puts farther returns below the ground
_BIN_M = 0.25
_DEPTH_M, _DEPTH_PER_M = 1.0, 0.1  # margins below the ground: a constant, and a share of the range
_SOME, _MANY = 0.01, 0.1  # shares of the close returns. Six real drives have up to 0.063

_SIGMAS = 3.0  # returns farther from their surfel are outliers
_SIGNIFICANCE = 3.0  # standard errors
_PARTS = 20  # groups of neighbouring surfels for the jackknife standard error
_MIN_SURFELS = 10 * _PARTS

# Sizes of a sample of windows, scans and returns, evenly spread, so that a large recording takes no longer than a small one.
_WINDOWS, _SCANS, _RETURNS = 3, 60, 60_000
_LEAST_SCANS = 4
# Smallest displacement of returns, as a share of their standard deviation. Measured: true poses of slow sensors with cells
# of 0.5 m: up to 0.09; a detected drift of 0.01 m and 0.05 degrees per step: 0.27 and more.
_LEAST_MOVED = 0.15
# Share of the gain of refined poses that is left if a changed mounting explains it. Measured on six kinds: at most 0.56 for
# changes of 2 degrees or 0.25 m and more; at least 0.76 for drifts and time offsets.
# In a short window, one step has a large share of a drift too.
_EXPLAINED = 0.65 / 60  # per scan of a window
# Ratio of squared differences of steps. Measured: at most 0.9 for time offsets, at least 3 for drifts.
_SHIFTED = 0.9
_CONCENTRATED = (
    1.25  # margin over the expected share. Measured: at most 0.95 for drifts; 1.1 to 3 for single steps
)


def check_elevation(recording: Scans) -> Iterator[Finding]:
    """Check for a sensor without elevation, whose returns all lie in one plane of its frame."""
    points = np.concatenate(some_points(recording))
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if len(points) >= _FEW_RETURNS and spread[2] <= _FLAT * spread[0]:
        evidence = f"All {len(points)} returns that were compared lie in one plane of the sensor's frame."
        yield Finding("no_elevation", "warning", evidence)


def check_ground(recording: Scans) -> Iterator[Finding]:
    """Check the share of returns below the ground, such as reflections in it. The z axis of the world must be up.

    The ground is the most frequent height of close returns below the sensor.
    """
    scans, upwards = some_points(recording), recording.poses[some_scans(recording), 2, :3]
    distance = np.concatenate([np.linalg.norm(scan, axis=1) for scan in scans])
    height = np.concatenate([scan @ up for scan, up in zip(scans, upwards, strict=True)])
    height, distance = height[distance < _CLOSE_M], distance[distance < _CLOSE_M]
    below = height[height < -_BIN_M]
    if len(below) < _FEW_RETURNS:
        return
    counts, edges = np.histogram(below, np.arange(-5, 0, _BIN_M))
    ground = float(edges[np.argmax(counts)]) + _BIN_M / 2
    share = float((height < ground - _DEPTH_M - _DEPTH_PER_M * distance).mean())
    if share >= _SOME:
        evidence = (
            f"{share:.1%} of the returns closer than {_CLOSE_M:g} m lie clearly below the ground, which is {-ground:.1f} m below "
            "the sensor."
        )
        yield Finding("below_ground", "warning" if share > _MANY else "note", evidence)


def check_noise_and_cost(recording: Scans, config: FitConfig) -> Iterator[Finding]:
    """Report the noise of the sensor and of the poses, and the cost of a fit, or why it would be refused."""
    try:
        rays = prepare(recording.points, recording.poses, recording.intensities, **config.preparation)
        check_extent(rays, config)
    except ValueError as error:
        yield Finding("fit_refuses", "error", f"A fit would refuse these scans: {error}.")
        return
    surfels = Surfels.of(rays, config.leaf_size_m)
    noise = sensor_noise(surfels, rays, config.returns)
    yield from _check_poses(rays, surfels, noise)
    evidence = (
        f"The noise of the sensor is about {noise.range_m:.3f} m along the beam, {np.degrees(noise.azimuth_rad):.2f} "
        f"degrees in azimuth and {np.degrees(noise.elevation_rad):.2f} degrees in elevation."
    )
    yield Finding("noise", "note", evidence)
    yield Finding("cost", "note", f"A fit has {estimate_rays(rays, config)}.")


def _check_poses(rays: Rays, surfels: Surfels, noise: SensorNoise) -> Iterator[Finding]:
    """Check for returns of different scans that are farther apart across a surface than those of one scan."""
    # Two returns of one scan on the same surfel differ only by the noise of the sensor; two of different scans also by the
    # errors of their poses. So the ratio of the mean squared differences is 1 if the poses are right, whatever the noise,
    # density and roughness. Measured: 0.93 to 1.10 in 30 good recordings of six simulated kinds; 1.3 to 1.6 on five real
    # drives, where errors of a scan's returns from one object are correlated.
    plane = surfels.flat_planes_at(rays.points)
    rows = np.flatnonzero(plane >= 0)
    plane = plane[rows]
    normals = surfels.normals[plane]
    off_m = np.einsum("ni,ni->n", rays.points[rows] - surfels.centres[plane], normals)
    sigmas = off_m / np.sqrt(variances_across(rays, rows, normals, noise))
    near = np.abs(sigmas) < _SIGMAS
    sigmas, plane, scans = sigmas[near], plane[near].astype(np.int64), rays.scans[rows[near]]
    if not len(sigmas):
        return
    num_scans, num_planes = int(scans.max()) + 1, int(plane.max()) + 1
    groups, group = np.unique(plane * num_scans + scans, return_inverse=True)
    own = _of_pairs(sigmas, group.ravel(), len(groups))
    within = np.stack([np.bincount(groups // num_scans, sums, num_planes) for sums in own])
    between = _of_pairs(sigmas, plane, num_planes) - within
    both = np.flatnonzero((within[0] > 0) & (between[0] > 0))
    if len(both) < _MIN_SURFELS:
        return
    # A surfel has the same weight in both, set by the smaller number of its pairs.
    weights = np.minimum(within[0], between[0])[both]
    means = np.stack([weights * part[1, both] / part[0, both] for part in (within, between)])
    part_of = np.arange(len(both)) * _PARTS // len(both)
    sums = np.stack([np.bincount(part_of, row, _PARTS) for row in means])
    left = np.log(np.divide(*(sums.sum(axis=1, keepdims=True) - sums)[::-1]))
    error = max(float(np.sqrt((_PARTS - 1) * left.var())), 1e-6)  # jackknife
    one, other = (sums.sum(axis=1) / weights.sum() / 2).tolist()
    log_ratio = np.log(other / one)
    if log_ratio < _SIGNIFICANCE * error:
        return
    typical_m2 = float(np.median(noise.variances_m2(rays.ranges_m)))
    own_m, added_m = np.sqrt(one * typical_m2), np.sqrt((other - one) * typical_m2)
    evidence = (
        f"Across the surfaces that scans have in common, poses add about {added_m:.3f} m to the {own_m:.3f} m by which "
        f"returns of one scan differ ({len(both)} surfaces, {log_ratio / error:.0f} standard errors)."
    )
    # At a ratio of 2, the poses add as much as the sensor itself.
    yield Finding("poses_disagree", "warning" if other > 2 * one else "note", evidence)


def _of_pairs(values: FloatArray, group: NDArray[np.int64], count: int) -> FloatArray:
    """(2, G) number of pairs, and sum of their squared differences, of values (N,) in G groups."""
    sums = [np.bincount(group, weights, count) for weights in (None, values, values**2)]
    return np.stack([sums[0] * (sums[0] - 1) / 2, sums[0] * sums[2] - sums[1] ** 2])


def check_drift(
    recording: Scans, config: FitConfig, numbers: NDArray[np.int64] | None = None
) -> Iterator[Finding]:
    """Check whether held-out returns agree better with refined poses, and whether the poses drift or differ otherwise.

    Compares the clearest of some windows of scans. `numbers` (F,): of the scans, for messages.
    """
    count = len(recording)
    if count < _LEAST_SCANS:
        return
    named = np.arange(count) if numbers is None else numbers
    begins = np.linspace(0, max(count - _SCANS, 0), min(_WINDOWS, max(1, count // _SCANS))).astype(np.int64)
    improved, others = [], []
    for begin in begins.tolist():
        part = slice(begin, begin + _SCANS)
        refined, lever_m = _refined(recording, recording.poses, part, config)
        report, noise = refined.report, SensorNoise(**refined.report["noise"])
        moved_m = np.hypot(report["moved_m"], lever_m * report["moved_rad"])
        if refined.improved and moved_m > _LEAST_MOVED * np.hypot(noise.range_m, lever_m * noise.angle_rad):
            improved.append((report["gain"] / report["gain_error"], begin, report))
            vectors = [
                step_vectors(poses) * np.repeat([1.0, lever_m], 3)
                for poses in (refined.poses, recording.poses[part])
            ]
            others.append(_other_than_drift(*vectors, named[part]))
    if improved:
        mounted = changed_mounting(recording)
        if mounted is not None:
            scan, vector, poses = mounted
            part = slice(*(np.clip(scan - _SCANS // 2, 0, max(count - _SCANS, 0)) + [0, _SCANS]))
            gains = [
                _refined(recording, given, part, config)[0].report["gain"]
                for given in (recording.poses, poses)
            ]
            if gains[1] < _EXPLAINED * min(count, _SCANS) * gains[0]:
                evidence = (
                    f"From scan {named[scan]} on, scans agree better if the sensor is mounted {np.linalg.norm(vector[3:]):.2g} m and "
                    f"{np.degrees(np.linalg.norm(vector[:3])):.2g} degrees otherwise; it explains {1 - gains[1] / gains[0]:.0%} of what "
                    "refined poses gain."
                )
                yield Finding("mounting_changed", "warning", evidence)
                return
        other = next(filter(None, others), None)
        if other is not None:
            yield other
            return
        significance, _, best = max(improved, key=lambda one: one[:2])
        evidence = (
            f"With refined poses, returns of other scans are {np.expm1(best['gain']):.1%} denser at held-out returns "
            f"({significance:.0f} standard errors): steps have errors of {best['sigma_m']:.3f} m and "
            f"{np.degrees(best['sigma_rad']):.2f} degrees ({len(improved)} of {len(begins)} windows of the recording)."
        )
        yield Finding("poses_drift", "warning", evidence)


def _other_than_drift(
    refined_m: FloatArray, given_m: FloatArray, numbers: NDArray[np.int64]
) -> Finding | None:
    """Whether refined and given steps (K, 6), m, differ by a time offset or at few scans, unlike a drift."""
    count = len(given_m)
    off_m2 = ((refined_m - given_m) ** 2).sum(axis=1)
    for shift in range(-(count // 2), count // 2 + 1):
        here, there = (
            slice(max(-shift, 0), count - max(shift, 0)),
            slice(max(shift, 0), count + min(shift, 0)),
        )
        ratio = np.median(((refined_m[here] - given_m[there]) ** 2).sum(axis=1)) / np.median(off_m2[here])
        if ratio < _SHIFTED:
            evidence = (
                f"The refined step of a scan is closer to that of the poses {abs(shift)} scans "
                f"{'later' if shift > 0 else 'earlier'}: the median squared difference is {ratio:.2f} times that to its own."
            )
            return Finding("clock_offset", "error", evidence)
    # Of exponentially distributed squares, the four largest of K have a share of about 4 ln(K) / K.
    share, worst = np.sort(off_m2)[-4:].sum() / off_m2.sum(), int(np.argmax(off_m2))
    if share > _CONCENTRATED * 4 * np.log(count) / count:
        evidence = (
            f"Refined poses differ from the given ones at few steps: four of {count} have {share:.0%} of the squared differences, "
            f"most after scan {numbers[worst]}. A drift, a changed mounting or exchanged scans cannot be told apart."
        )
        return Finding("undecided", "warning", evidence)
    return None


def _refined(
    recording: Scans, poses: FloatArray, rows: slice, config: FitConfig
) -> tuple[RefinedPoses, float]:
    """Refined poses of some scans, and the median range of their returns, m."""
    part = recording.select(np.arange(len(recording))[rows])
    # Every n-th return, since returns of a scan are ordered by angle.
    every = max(1, -(-sum(map(len, part.points)) // _RETURNS))
    points = [np.asarray(scan[::every], np.float64) for scan in part.points]
    times_s, doppler_mps = ascending_times_s(part), None
    if part.doppler_mps is not None and times_s is not None:
        doppler_mps = [speeds[::every] for speeds in part.doppler_mps]
    refined = refine_poses(
        points, poses[rows], doppler_mps=doppler_mps, times_s=times_s, config=config, progress=False
    )
    return refined, median_range_m(points)
