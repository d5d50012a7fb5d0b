"""Radar odometry: poses of scans from returns, Doppler and an IMU; and poses, refined or estimated, for maps and reports."""

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from radarsdf.arrays import ArrayLike, Floats, Ints
from radarsdf.checks import check
from radarsdf.config.fit_config import FitConfig
from radarsdf.poses.agreement import ERRORS, motion_significance
from radarsdf.poses.checked_scans import CheckedScans, checked_settings, join_radars
from radarsdf.poses.consistency import Consistency
from radarsdf.poses.doppler import NOT_USED, BodyVelocities
from radarsdf.poses.imu import Inertial, level_poses
from radarsdf.poses.loops import open_loops
from radarsdf.poses.planes import LEAST_OBSERVED, SensorReturns, Tracked, plane_cell_m
from radarsdf.poses.refine import JointEstimator, RefinedPoses
from radarsdf.poses.rigid import lengths_of_steps_m, steps
from radarsdf.poses.tracking import LATERAL_MPS2, SLOW_TURN_RAD_S, Drive, track_drive
from radarsdf.returns.rays import within_ranges
from radarsdf.rig import Imu
from radarsdf.scans import Scans, filled


class UnobservedMotionError(ValueError):
    """Neither the returns nor another source observe the motion of the sensor."""


@dataclass(frozen=True)
class Odometry:
    """Poses estimated from the radar alone."""

    poses: Floats
    """(F, 4, 4) T_world_sensor, m; of a rig, T_world_body. The world is the frame of the first scan; with an accelerometer,
    rotated so that z points up."""
    covariance: Floats
    """(F, 6, 6) as in :class:`RefinedPoses`, relative to the middle scan of each segment."""
    segments: Ints
    """(F,) segment of the drive of each scan. A new segment begins where tracking was lost, mostly over a gap in time: its
    position relative to the previous one is dead reckoning, and no map should join them."""
    report: dict[str, Any]
    """`verdict` in words; `length_m` of the trajectory; `segments`, their number; `doppler` and `gyroscope`, whether used;
    `doppler_sign`, -1 if Doppler is positive for approaching objects; `gyroscope_bias`, rad/s; `imu`, None or its `R_sensor_imu`
    with `sigma_rad`, `time_offset_s`, the delay of the times of scans in its clock, and `lever_m`, from it to the radar in its
    axes; `moving`, number of moving returns; `notes` on unused input, assumptions and open loops; `scans`, `seconds`."""

    def longest_segment(self) -> slice:
        """Return the scans of the segment with the most scans, from which to fit a map."""
        counts = np.bincount(self.segments)
        first = int(np.searchsorted(self.segments, np.argmax(counts)))
        return slice(first, first + int(counts.max()))


def odometry(
    points: Iterable[ArrayLike] | Scans,
    *,
    doppler_mps: Sequence[ArrayLike] | None = None,
    times_s: ArrayLike | None = None,
    imu: Imu | None = None,
    config: FitConfig | None = None,
    progress: bool | None = None,
) -> Odometry:
    """Estimate the poses of scans from the radar alone.

    Registers each scan with the planes of the previous scans, starting from Doppler, a gyroscope or the motion so far, or from a
    search over a gap. Then adjusts all scans jointly, as :func:`refine_poses` does. The motion prior, the noise of the sensor and
    the bias of its gyroscope are estimated from the drive.

    Parameters
    ----------
    points : iterable of F arrays, or Scans
        (N_i, 3) each: the returns of one scan, sensor frame, m, of any real dtype. :class:`radarsdf.io.Scans` supply times and
        Doppler unless these are passed separately. Of a rig, whose radars need not measure at the same times, they give
        the poses of the body.
    doppler_mps : sequence of F arrays, optional
        (N_i,) each, radial speed, m/s, of either sign, aliased or not; NaN where it was not measured.
    times_s : (F,) array_like
        Times of the scans, s.
    imu : Imu, optional
        A gyroscope, optionally with an accelerometer. Default: that of `Scans`. Without `R_sensor_imu` (of a rig, to the body), its
        mounting rotation is estimated, and with an accelerometer and Doppler its time offset and the vertical, too.
    config : FitConfig, optional
        Settings, of which ranges, noise, leaf cells and threads are used.
    progress : bool, optional
        Whether to show a progress bar. Default: only on a terminal.

    Returns
    -------
    Odometry
        Bit-identical with any number of threads.

    Raises
    ------
    TypeError
        If an argument has the wrong type.
    ValueError
        If scans, Doppler, times or rates are invalid, times are missing, or a part of the motion is not observable: without
        Doppler, the position along a wall; without a gyroscope, the turns of a radar with few returns that is slower than
        20 m/s. If Doppler was passed but not used, the message gives the reason.

    Notes
    -----
    The scale follows the radar's ranges and, with Doppler, its speeds. Without an accelerometer, the first scan is assumed to
    be level.

    Examples
    --------
    >>> import radarsdf
    >>> scans = radarsdf.simulate.wall(frames=6)
    >>> motion = radarsdf.simulate.measured_motion(scans)
    >>> found = radarsdf.odometry(scans.points, doppler_mps=motion.doppler_mps, times_s=motion.times_s)
    >>> found.poses.shape, found.report["segments"]
    ((6, 4, 4), 1)
    """
    begin = time.perf_counter()
    config = checked_settings(config)
    drive, tracked, compared, scans = track_scans(points, doppler_mps, times_s, imu, config, progress)
    velocities, inertial, notes = drive.velocities, drive.inertial, scans.notes
    notes += check_observed(tracked, drive, notes)
    segments = np.array([found.segment for found in tracked])
    poses, covariance, loops = _estimate_jointly(drive, tracked, segments, config)
    notes += loops
    if velocities is not None:
        known = [(each.rows, tested) for each, tested in compared if each.velocities is not None]
        # Radars of a rig move together: the best known one decides.
        rows, least = min(known, key=lambda radar: len(radar[1].doubts or ()))
        covariance = least.widened(rows, poses, covariance, segments, drive)
    if inertial.alignment is not None:
        poses, covariance = level_poses(poses, covariance, inertial.alignment.up)
    length_m = float(lengths_of_steps_m(poses)[np.diff(segments) == 0].sum())
    gyroscope = inertial.gyroscope
    report = {
        "verdict": _summarize(segments, length_m, velocities is not None, inertial),
        "length_m": length_m,
        "segments": int(segments[-1]) + 1,
        "doppler": velocities is not None,
        "doppler_sign": scans.sign,
        "gyroscope": gyroscope is not None,
        "gyroscope_bias": None if gyroscope is None else gyroscope.bias.mean.tolist(),
        "imu": None if inertial.alignment is None else inertial.alignment.report,
        "moving": scans.moving,
        "notes": notes,
        "scans": len(tracked),
        "seconds": time.perf_counter() - begin,
    }
    return Odometry(poses, covariance, segments, report)


def track_scans(
    points: Iterable[ArrayLike] | Scans,
    doppler_mps: Sequence[ArrayLike] | None,
    times_s: ArrayLike | None,
    imu: Imu | None,
    config: FitConfig,
    progress: bool | None,
) -> tuple[Drive, list[Tracked], list[tuple[CheckedScans, Consistency]], CheckedScans]:
    """Check scans, compare their Doppler with their returns, and track them. Arguments and errors are those of :func:`odometry`.

    Returns the drive, its tracked scans, the scans of each radar with that comparison, and the scans of all radars.
    """
    rig, radars = CheckedScans.of_radars(points, doppler_mps, times_s)
    _, _, times_s, imu = filled(points, times_s=times_s, imu=imu)
    check(times_s is not None, "times_s are missing: the time of each scan, s")
    compared = [_compare(checked, config) for checked in radars]
    scans = join_radars(rig, [each for each, _ in compared])
    times, velocities = scans.times_s, scans.velocities
    # An IMU has one lever arm to each radar: it is aligned with the one of the most scans.
    of_radars = [each.rows for each, _ in compared if each.velocities is not None]
    radar = max(of_radars, key=len, default=np.arange(len(times)))
    inertial = Inertial.of(imu, velocities, times, float(np.asarray(times_s)[0]), radar)
    drive = Drive(scans.scans, times, velocities, inertial=inertial, yaws=scans.yaws, rig=rig)
    drive, tracked = track_drive(drive, config, progress)
    scans.notes.extend(drive.inertial.notes)
    return drive, tracked, compared, scans


def _compare(checked: CheckedScans, config: FitConfig) -> tuple[CheckedScans, Consistency]:
    """Compare the Doppler of a radar with its returns within the ranges of the settings."""
    checked.check_intervals()
    limits, checked = config.returns, checked.signed()
    scans = [scan[within_ranges(scan, limits.min_range_m, limits.max_range_m)] for scan in checked.scans]
    checked = replace(checked, scans=scans)
    drive = Drive(scans, checked.times_s, checked.velocities, yaws=checked.yaws)
    tested = next(filter(None, Consistency.of_returns(drive, config)))
    return tested.corrected(checked), tested


def _estimate_jointly(
    drive: Drive, tracked: list[Tracked], segments: Ints, config: FitConfig
) -> tuple[Floats, Floats, list[str]]:
    """Jointly estimate poses and covariances of all scans of each segment; return them with notes on open loops."""
    poses, turns = (np.stack([getattr(found, name) for found in tracked]) for name in ("pose", "turn"))
    covariance, notes = np.zeros((len(poses), 6, 6)), []
    limits, cell_m = config.returns, plane_cell_m(drive.scans, config.leaf_size_m)
    for segment in range(segments[-1] + 1):
        rows = slice(*np.searchsorted(segments, [segment, segment + 1]).tolist())
        rig = None if drive.rig is None else drive.rig.select(rows)
        returns = SensorReturns.of(drive.scans[rows], limits.min_range_m, limits.max_range_m, rig)
        if rows.stop - rows.start < 2 or len(returns) == 0:
            continue
        motions = drive.motions(poses[rows], turns[rows][1:], rows)
        found = JointEstimator(returns, motions, cell_m, config).estimate_closed(poses[rows])
        poses[rows], covariance[rows] = found.poses, found.covariance
        notes += open_loops(returns, found.poses, found.noise, rows.start)
    return np.einsum("ij,fjk->fik", np.linalg.inv(poses[0]), poses), covariance, notes


def check_observed(found: list[Tracked], drive: Drive, notes: list[str], *, turns: bool = True) -> list[str]:
    """Return notes on assumptions. Raise an UnobservedMotionError if translations, or those and `turns`, are not observable."""
    if len(found) < 2:
        return []

    def refuse(moved: str, why: str, missing: str) -> None:
        msg = f"the returns alone do not observe how the sensor {moved}: {why}. Give {missing}, or poses"
        raise UnobservedMotionError(". ".join([msg, *(note.rstrip(".") for note in notes)]))

    moved, turned = np.median([one.observed for one in found[1:]], axis=0).tolist()
    removed = "of a step's variance, they remove {:.1%}, and {:.0%} is needed"
    unsure = any(note.startswith(NOT_USED) for note in notes)
    doppler = "Doppler that most returns of a scan agree on" if unsure else "their Doppler (doppler_mps)"
    # Minimum share of the prior variance of a step's rotation that the returns must remove: over the window of scans, it adds up
    # to all. A hand-held radar of 41 returns a scan, which turns by up to 100 degrees a second: 0.007; all others: 0.06 to 0.9.
    least_turned = 1 / drive.window
    if drive.velocities is None and moved < LEAST_OBSERVED:
        refuse("moved", removed.format(moved, LEAST_OBSERVED), doppler)
    durations_s, velocities = np.diff(drive.times_s), drive.velocities
    measured = isinstance(velocities, BodyVelocities) and velocities.measure_turns(durations_s, least_turned)
    unknown = turns and not measured and drive.inertial.gyroscope is None and turned < least_turned
    if unknown and drive.usual_turn_rad_s >= SLOW_TURN_RAD_S:
        refuse("turned", removed.format(turned, least_turned), "a gyroscope (imu)")
    assumed = []
    if drive.velocities is None:
        within = np.flatnonzero(np.diff([one.segment for one in found]) == 0)
        motions = steps(np.stack([one.pose for one in found]))[within]
        if (significance := motion_significance(drive.scans, within, motions)) < -ERRORS:
            refuse("moved", "scans agree better without any motion", doppler)
        if significance < ERRORS:
            assumed.append("Assumed: the sensor moved as estimated; scans agree as well without any motion.")
    if unknown:
        rate = f"{drive.usual_turn_rad_s:.2f} rad/s, as {LATERAL_MPS2:.0f} m/s² across its trajectory make of its speed"
        assumed.append(f"Assumed: the sensor turns by about {rate}; the returns of a scan hardly measure it.")
    return assumed


def _summarize(segments: Ints, length_m: float, doppler: bool, inertial: Inertial) -> str:
    sources = ["returns", *["Doppler"] * doppler, *["a gyroscope"] * (inertial.gyroscope is not None)]
    sentences = [f"{len(segments)} scans along {length_m:.1f} m were placed by {' and '.join(sources)}."]
    if inertial.alignment is not None:
        sentences.append(inertial.alignment.words)
    begins = np.flatnonzero(np.diff(segments)) + 1
    if len(begins):
        lost = f"The drive was lost before the scans {', '.join(map(str, begins))}"
        sentences.append(f"{lost}: {len(begins) + 1} segments, which do not belong together.")
    return " ".join(sentences)


_MOST = 500  # maximum number of poses in a report: enough for a plot


def pose_sigmas(covariance: Floats) -> tuple[float, float]:
    """Compute median standard deviations per axis of the position, m, and rotation, rad, of poses.

    `covariance` (F, 6, 6) is that of :class:`RefinedPoses` or :class:`Odometry`. These are the values for
    ``returns.pose_sigma_m`` and ``pose_sigma_rad`` of a :class:`FitConfig`.
    """
    position_m, turn_rad = np.median(_sigmas(covariance), axis=0).tolist()
    return position_m, turn_rad


def _sigmas(covariance: Floats) -> Floats:
    """Return standard deviations (F, 2) of positions, m, and rotations, rad, root mean square of the three axes."""
    variances = np.einsum("fii->fi", covariance).reshape(-1, 2, 3).mean(axis=2)
    return np.sqrt(np.maximum(variances, 0.0))


@dataclass(frozen=True)
class PosedScans:
    """Poses of the scans to fit a map to."""

    poses: Floats  # (K, 4, 4) T_world_sensor, m
    rows: slice  # the K scans among those of the drive: all, or the longest segment of odometry
    given: Floats | None = None  # (K, 4, 4) original poses, if any
    segments: int = 1
    # For the report of a map, as JSON values. None for original poses.
    trajectory: dict[str, Any] | None = None
    sigmas: tuple[float, float] | None = None  # standard deviations of a pose, m and rad, if known
    notes: tuple[str, ...] = ()  # sentences on unused input

    @classmethod
    def of(cls, found: RefinedPoses | Odometry, given: Floats | None = None) -> "PosedScans":
        """Build from the longest segment of odometry, or from refined poses and the original ones (F, 4, 4)."""
        rows = found.longest_segment() if isinstance(found, Odometry) else slice(0, len(found.poses))
        poses, covariance, report = found.poses[rows], found.covariance[rows], found.report
        improved = found.improved if isinstance(found, RefinedPoses) else None
        some = np.unique(np.linspace(0, len(poses) - 1, min(_MOST, len(poses))).astype(np.int64))
        of_some = _sigmas(covariance)[some]
        trajectory = {
            "verdict": report["verdict"],
            "improved": improved,
            "step_m": report.get("sigma_m"),
            "step_rad": report.get("sigma_rad"),
            "scans": some.tolist(),
            "before": None if given is None else given[rows][some, :3, 3].tolist(),
            "after": poses[some, :3, 3].tolist(),
            "sigma_m": of_some[:, 0].tolist(),
            "sigma_rad": of_some[:, 1].tolist(),
        }
        sigmas, notes = None if improved is False else pose_sigmas(covariance), tuple(report.get("notes", ()))
        return cls(poses, rows, given, report.get("segments", 1), trajectory, sigmas, notes)

    def config(self, config: FitConfig) -> FitConfig:
        """Return `config` with the errors of the poses, unless it specifies its own."""
        if self.sigmas is None or config.returns.pose_sigma_m or config.returns.pose_sigma_rad:
            return config
        sigma_m, sigma_rad = self.sigmas
        return config.override(returns={"pose_sigma_m": sigma_m, "pose_sigma_rad": min(sigma_rad, 1.0)})
