"""Calibration of several radars on one body: mountings and time offsets, from their Doppler and the surfaces that they share."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from radarsdf.arrays import Floats, Ints
from radarsdf.checks import check, instance
from radarsdf.config.fit_config import FitConfig
from radarsdf.poses.body_path import BodyPath
from radarsdf.poses.checked_scans import CheckedScans, checked_settings
from radarsdf.poses.consistency import Consistency
from radarsdf.poses.doppler import LEAST_MPS, SensorVelocities
from radarsdf.poses.imu import Inertial
from radarsdf.poses.motion import Motion, unsteadiness
from radarsdf.poses.mounting_equations import RadarsOfBody
from radarsdf.poses.mountings import PRIOR, estimate_mountings
from radarsdf.poses.odometry import odometry
from radarsdf.poses.planes import SensorReturns, plane_cell_m
from radarsdf.poses.rigid import assembled, increments, moved, skew, step_vectors
from radarsdf.rig import Imu, Label, Rig
from radarsdf.scans import Scans, chosen

_ROUNDING = 1e-11  # covariances of what is fixed
_MOST_KNOTS = 200
_ANY_MPS2 = 1e12  # variance of an unknown velocity
_UNOBSERVED = np.repeat([0.1, np.radians(2.0), 0.02], [3, 3, 1])  # standard deviations: m, rad, s
# Names, units, and why a drive does not show them.
_COMPONENTS = (
    ("lever arm along {}", 1.0, "m", "the drive turns too little about other axes"),
    ("rotation about {}", np.degrees(1.0), "degrees", "it is kept as given, since nothing shows it"),
    ("time offset", 1.0, "s", "the velocity changes too little"),
)


@dataclass(frozen=True)
class Mounting:
    """Mounting of a radar or IMU on the body. What the drive does not show is NaN, for the reason in `unobserved`."""

    T_body_sensor: Floats
    """(4, 4) m."""
    covariance: Floats
    """(6, 6) of the translation, m, and the rotation vector about the sensor, rad, in the axes of the body."""
    time_offset_s: float
    """Delay of its times, to be subtracted from them, s."""
    time_offset_sigma_s: float
    """Its standard deviation, s. 0: it defines the clock."""
    unobserved: tuple[str, ...] = ()
    """Why values are NaN, in words."""

    @classmethod
    def of(cls, given: Floats, T: Floats, covariance: Floats, late_s: float) -> "Mounting":
        """Build from a covariance (7, 7) that includes the time offset, without what it leaves open."""
        covariance = np.where(np.abs(covariance) < _ROUNDING, 0.0, covariance)
        sigmas = np.sqrt(covariance.diagonal())
        unknown = sigmas > _UNOBSERVED
        found = np.where(unknown | (sigmas == 0), 0.0, np.append(increments(given, T), late_s))
        T = moved(given, found[:6])
        T[:3, 3][unknown[:3]] = np.nan
        if unknown[3:6].all():
            T[:3, :3] = np.nan
        why = []
        for i in np.flatnonzero(unknown):
            name, scale, unit, reason = _COMPONENTS[i // 3]
            many = f"a deviation of {scale * sigmas[i]:.2g} {unit} for {scale * _UNOBSERVED[i]:.2g} {unit}"
            why.append(f"{name.format('xyz'[i % 3])}: {many}: {reason}")
        covariance[unknown], covariance[:, unknown] = np.nan, np.nan
        late_s = np.nan if unknown[6] else float(found[6])
        return cls(T, covariance[:6, :6], late_s, float(np.sqrt(covariance[6, 6])), tuple(why))


@dataclass(frozen=True)
class Calibration:
    """Mountings of the radars of a recording."""

    mountings: dict[Label, Mounting]
    """By label of the radar."""
    imu: Mounting | None
    """That of the IMU, if there is one that the Doppler of the reference observes."""
    against: str
    """Label of the first radar, to which the mountings are relative: its own is kept."""
    notes: list[str]
    """Unused input, in words."""


def calibrate(scans: Scans, *, imu: Imu | None = None, config: FitConfig | None = None) -> Calibration:
    """Estimate how the radars of a recording are mounted, and their time offsets.

    Velocities by Doppler and common surfaces of all radars are fitted jointly with the trajectory of the body. Where the drive
    turns, and for all rotations about directions of motion, their surfaces must overlap.

    Parameters
    ----------
    scans : Scans
        Scans of several radars, with `sensors` and times. `T_body_sensor`, rough mountings, may be wrong by several degrees and
        decimetres; default: the identity. All are relative to the first radar,
        whose mounting is kept, since the trajectory absorbs a change of all of them. Poses T_world_body of its scans help.
    imu : Imu, optional
        An accelerometer and gyroscope to calibrate as well, whose `R_sensor_imu`, if known, is its rotation on the body. Default:
        that of the scans.
    config : FitConfig, optional
        Settings, of which ranges, noise, leaf cells and threads are used.

    Returns
    -------
    Calibration
        Values that the drive does not show are NaN. At most the 200 scan intervals with the most turns are used.

    Raises
    ------
    TypeError
        If an argument has the wrong type.
    ValueError
        If there are no labels of several radars, no times, or the motion of the first radar is not observable.
    """
    config = checked_settings(config)
    rig, limits = instance(scans, Scans, "scans").rig, config.returns
    several = rig is not None and len(np.unique(rig.of_scan)) > 1
    check(several, "calibrate needs scans of several radars: Scans(..., sensors=labels)")
    check((times_s := scans.times_s) is not None, "times_s are missing: the time of each scan, s")
    assert rig is not None
    assert times_s is not None
    order = np.argsort(times_s, kind="stable")
    scans, rig, times_s = scans.select(order), rig.select(order), times_s[order]
    labels, reference, mountings = rig.labels, int(rig.of_scan[0]), rig.T_body_sensor
    if mountings is None:
        mountings = np.tile(np.eye(4), (len(labels), 1, 1))
    imu = scans.imu if imu is None else imu
    if imu is not None and imu.R_sensor_imu is not None:
        imu = replace(imu, R_sensor_imu=mountings[reference, :3, :3].T @ imu.R_sensor_imu)
    checked, undecided = CheckedScans.of_radars(scans, None, None, mounted=False)[1], Consistency(doubts=())
    radars = [undecided.corrected(radar.signed()) for radar in checked]
    of_radars = {labels[rig.of_scan[radar.rows[0]]]: radar for radar in radars}
    notes = [f"{label}: {note}" for label, radar in of_radars.items() for note in radar.notes]
    static = {i: scan for radar in radars for i, scan in zip(radar.rows.tolist(), radar.scans, strict=True)}
    mean_mps, whitening = _velocities(radars, len(times_s))
    first = np.flatnonzero(rig.of_scan == reference)
    at_s, path, given, on_path = _body_path(scans, first, times_s[first], mountings[reference], imu, config)
    interval_s = float(np.median(np.diff(times_s[first])))
    # The part that turns most.
    turned = np.append(0.0, np.cumsum(np.linalg.norm(step_vectors(path)[:, 3:], axis=1)))
    last = np.searchsorted(at_s, at_s + _MOST_KNOTS * interval_s, side="right") - 1
    begin = int(np.argmax(turned[last] - turned))
    begin_s, end_s = at_s[[begin, last[begin]]].tolist()
    kept = np.flatnonzero((times_s >= begin_s) & (times_s <= end_s))
    points, of_scan = [static[i] for i in kept.tolist()], rig.of_scan[kept]
    returns = SensorReturns.of(points, limits.min_range_m, limits.max_range_m, Rig(labels, of_scan, None))
    cell_m, velocities = plane_cell_m(points, config.leaf_size_m), (mean_mps[kept], whitening[kept])
    measured = RadarsOfBody(of_scan, times_s[kept] - begin_s, returns, *velocities, cell_m, reference)
    body = BodyPath.of(at_s - begin_s, path, end_s - begin_s, interval_s, mountings)
    steps = None
    if given:
        rows = (at_s >= begin_s) & (at_s <= end_s)
        motion = Motion.of(path[rows], *unsteadiness(path[rows], at_s[rows]), at_s[rows])
        steps = motion, at_s[rows] - begin_s
    body, covariance = estimate_mountings(body, measured, steps, config)
    each = zip(mountings, body.mountings, covariance, body.late_s, strict=True)
    found = {label: Mounting.of(*own) for label, own in zip(labels, each, strict=True)}
    own = of_radars[labels[reference]].velocities
    of_imu, on_imu = _imu_mounting(imu, own, times_s[first], mountings[reference])
    return Calibration(found, of_imu, str(labels[reference]), [*notes, *on_path, *on_imu])


def _velocities(radars: Sequence[CheckedScans], count: int) -> tuple[Floats, Floats]:
    """Return velocities by Doppler (F, 3) of `count` scans in their sensor frames, and matrices (F, 3, 3) that whiten them."""
    mean, covariance = np.zeros((count, 3)), np.tile(_ANY_MPS2 * np.eye(3), (count, 1, 1))
    for radar in radars:
        # Those of single scans have no prior of the vertical: a sensor may be mounted in any direction.
        each = () if radar.velocities is None else radar.velocities.of_scans
        for i, velocity in zip(radar.rows, each, strict=False):
            if velocity.found:
                mean[i], covariance[i] = radar.sign * velocity.velocity_mps, velocity.covariance
    least = np.full((count, 3), LEAST_MPS)
    least[:, 2] = np.hypot(LEAST_MPS, PRIOR[-1] * np.linalg.norm(mean, axis=1))
    information = np.linalg.inv(covariance + least[:, :, None] ** 2 * np.eye(3))
    return mean, np.linalg.cholesky(information).swapaxes(1, 2)


def _body_path(
    scans: Scans, rows: Ints, times_s: Floats, T_body_sensor: Floats, imu: Imu | None, config: FitConfig
) -> tuple[Floats, Floats, bool, list[str]]:
    """Return ascending times and poses of the body at scans `rows` (K,) of one radar, at `times_s` (K,), whether they are given,
    else by odometry, and notes."""
    given, notes = True, list[str]()
    try:
        path = scans.poses[rows]
    except ValueError:
        own, speeds = [scans.points[i] for i in rows], chosen(scans.doppler_mps, rows)
        found = odometry(own, doppler_mps=speeds, times_s=times_s, imu=imu, config=config, progress=False)
        part = found.longest_segment()
        given, notes, times_s = False, found.report["notes"], times_s[part]
        path = found.poses[part] @ np.linalg.inv(T_body_sensor)
    rising = np.append(True, np.diff(times_s) > 0)
    return times_s[rising], path[rising], given, notes


def _imu_mounting(
    imu: Imu | None, velocities: SensorVelocities | None, times_s: Floats, T_body_sensor: Floats
) -> tuple[Mounting | None, tuple[str, ...]]:
    """Align the IMU with a radar of known mounting, and return its mounting and notes."""
    inertial = Inertial.of(imu, velocities, times_s - times_s[0], float(times_s[0]))
    if (found := inertial.alignment) is None:
        return None, inertial.notes
    T = assembled(T_body_sensor[:3, :3] @ found.R_sensor_imu)
    lever_m = T[:3, :3] @ found.lever_m
    T[:3, 3] = T_body_sensor[:3, 3] - lever_m
    J = np.eye(7)
    J[:3, :3], J[3:6, 3:6], J[:3, 3:6] = -T[:3, :3], T[:3, :3], skew(lever_m[None])[0] @ T[:3, :3]
    # The alignment states the delay of scans in the clock of the IMU.
    return Mounting.of(T, T, J @ found.covariance @ J.T, -found.time_offset_s), inertial.notes
