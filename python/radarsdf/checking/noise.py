"""Checks of elevation, ground, noise and intensities, and the cost of a fit."""

from collections.abc import Iterator

import numpy as np

from radarsdf.arrays import Floats, Ints
from radarsdf.checking.recording import Finding, some_points, some_scans
from radarsdf.config.fit_config import FitConfig
from radarsdf.fitting.estimate import check_extent, estimate_rays
from radarsdf.returns.intensities import Plausible
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


def check_elevation(recording: Scans) -> Iterator[Finding]:
    """Check for a sensor without elevation, whose returns all lie in one plane of its frame."""
    points = np.concatenate(some_points(recording))
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if len(points) >= _FEW_RETURNS and spread[2] <= _FLAT * spread[0]:
        evidence = f"All {len(points)} returns that were compared lie in one plane of the sensor's frame."
        yield Finding("no_elevation", "warning", evidence)


def check_ground(recording: Scans) -> Iterator[Finding]:
    """Check the share of returns below the ground, the most frequent height of close returns. The z axis of the world must be up."""
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
        evidence = f"{share:.1%} of returns within {_CLOSE_M:g} m are clearly below the ground, {-ground:.1f} m below the sensor."
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
    azimuth, elevation = (f"{np.degrees(of):.2f} degrees" for of in (noise.azimuth_rad, noise.elevation_rad))
    beam = f"The noise of the sensor is about {noise.range_m:.3f} m along the beam"
    evidence = f"{beam}, {azimuth} in azimuth and {elevation} in elevation."
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


def _of_pairs(values: Floats, group: Ints, count: int) -> Floats:
    """(2, G) number of pairs, and sum of their squared differences, of values (N,) in G groups."""
    sums = [np.bincount(group, weights, count) for weights in (None, values, values**2)]
    return np.stack([sums[0] * (sums[0] - 1) / 2, sums[0] * sums[2] - sums[1] ** 2])


_SOME_CLIPPED, _MANY_CLIPPED = 0.005, 0.05  # shares of returns at the highest value for a note and a warning
_ABOVE_NEXT = 5.0  # ratio to the share at each of the next values
_FEW_VALUES = 1000  # distinct values: with more, quantisation does not matter
_RCS_OFFSET = 128  # added to radar cross sections in dBsm to store them in a byte
_NAMED = 3  # largest number of values in a message


def check_intensities(recording: Scans) -> Iterator[Finding]:
    if recording.intensities is None:
        return
    whole = np.concatenate(recording.intensities)  # one value in any scan can stretch the common scale
    finite = np.isfinite(whole)
    if not finite.all():
        evidence = f"{1 - finite.mean():.2%} of the intensities are not finite."
        yield Finding("intensity_not_finite", "note" if finite.any() else "error", evidence)
        whole = whole[finite]
    if not len(whole):
        return
    plausible = Plausible.of(whole)
    held = plausible.holds(whole)
    if not held.all():
        yield from _outliers(whole[~held], whole[held])
    scans = [np.asarray(recording.intensities[i], np.float64) for i in some_scans(recording)]
    scans = [scan[plausible.holds(scan)] for scan in scans]
    values = np.concatenate(scans)
    if len(values) == 0:
        return
    constant = float(np.mean([scan.min() == scan.max() for scan in scans if len(scan) > 1] or [False]))
    if values.min() == values.max():
        yield Finding("intensity_constant", "error", f"All intensities are {values[0]:g}.")
    elif constant > 0.5:
        evidence = f"In {constant:.0%} of the scans all returns have the same intensity."
        yield Finding("intensity_constant_in_scans", "warning", evidence)
    elif len(values) >= _FEW_RETURNS:
        yield from _scale(values)


def _outliers(outliers: Floats, usual: Floats) -> Iterator[Finding]:
    """Report outliers: repeated values mark missing measurements, single ones are faults."""
    levels, counts = np.unique(outliers, return_counts=True)
    total, rest = len(outliers) + len(usual), f"the others, which are {usual.min():g} to {usual.max():g}"
    for name, chosen in (("intensity_sentinel", counts > 1), ("intensity_outliers", counts == 1)):
        if chosen.any():
            most = levels[chosen][np.argsort(-counts[chosen], kind="stable")]
            named = ", ".join(f"{level:g}" for level in most[:_NAMED]) + ", …" * (len(most) > _NAMED)
            evidence = f"{counts[chosen].sum()} of {total} intensities are {named}, far from {rest}."
            yield Finding(name, "warning", evidence)


def _scale(values: Floats) -> Iterator[Finding]:
    """Report quantisation, an offset, and clipping at the end of the scale."""
    levels, counts = np.unique(values, return_counts=True)
    shares = counts / len(values)
    low, middle = np.percentile(values, [5, 50])
    few = len(levels) < _FEW_VALUES
    if few:
        step = np.median(np.diff(levels))
        evidence = f"Intensities are {levels[0]:g} to {levels[-1]:g}, in steps of {step:.3g}."
        yield Finding("intensity_steps", "note", evidence)
    bytes_ = (values == np.round(values)).all() and levels[0] >= 0 and levels[-1] <= 255
    if few and bytes_ and low > 64 and abs(middle - _RCS_OFFSET) < 40:
        like = f"like dBsm with {_RCS_OFFSET} added"
        evidence = f"Intensities are whole numbers with the median {middle:g}, {like}."
        yield Finding("intensity_offset", "note", evidence)
    if len(levels) > 4 and shares[-1] > max(_SOME_CLIPPED, _ABOVE_NEXT * float(shares[-4:-1].mean())):
        evidence = f"{shares[-1]:.1%} of the intensities have the highest value, {levels[-1]:g}."
        yield Finding("intensity_clipped", "warning" if shares[-1] > _MANY_CLIPPED else "note", evidence)
