"""Input of a check, with consistent shapes, and its findings."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from radarsdf import checks
from radarsdf.arrays import Array, ArrayLike, Floats
from radarsdf.scans import Scans

Severity = Literal["error", "warning", "note"]
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")  # worst first

COARSE_M = 0.01  # smaller errors of positions, by rounding or by times, are below the noise of any radar
_SAMPLE = 40  # scans from which properties of the sensor are estimated

_LEFT_OUT = "No action needed: a fit leaves them out."
_FRAME = "Pass points of the sensor frame in metres, x forward, y left, z up, and T_world_sensor."
_ANGLES = "Recompute the rotations of the poses from angles in rad or unit quaternions x y z w."
_UNDECIDED = "Check frames and clock by other means: these scans do not show them."
_NO_VALUE = "Look up their meaning in the driver. A fit leaves them out of the reflectance."
FIXES = {
    "returns_not_finite": _LEFT_OUT,
    "padding": _LEFT_OUT,
    "empty_scans": f"Pass the returns. {_LEFT_OUT}",
    "intensity_not_finite": "Fit without intensities, if there are hardly any. A fit leaves them out of the reflectance.",
    "no_elevation": "Read the map from above only: its heights are those of the sensor, not of the scene.",
    "far_returns": "A fit leaves them out.",
    "range_sentinel": "Leave them out, if they mark directions without a return: a fit keeps those near other returns.",
    "positions_rounded": "Keep poses in float64, or subtract an origin before they become float32.",
    "poses_not_rigid": f"A fit leaves out their scans. {_ANGLES}",
    "poses_transposed": "Transpose each pose: poses.transpose(0, 2, 1).",
    "poses_inverted": "Invert each pose: np.linalg.inv(poses).",
    "points_in_world_frame": "Transform them back: (points - pose[:3, 3]) @ pose[:3, :3], or pass points of the sensor frame.",
    "camera_frame": _FRAME,
    "axes_swapped": _FRAME,
    "mirrored": f"{_FRAME} Frames are right-handed.",
    "units": "Pass points and positions in metres.",
    "angles_in_degrees": _ANGLES,
    "quaternion_order": _ANGLES,
    "sensor_turned": "Pass poses of the sensor: poses @ T_vehicle_sensor, by its calibration.",
    "mounting_mirrored": "Change that sign where the returns are read: angles may be positive downwards, or to the right.",
    "mounting_upside_down": "Turn its mounting by 180 degrees about its x axis.",
    "mounting_rotation": "Use the mounting that radarsdf calibrate finds, or measure it again.",
    "mounting_lever": "Use the mounting that radarsdf calibrate finds, or measure it again.",
    "poses_stand_still": "Pass the position of the sensor for each scan. If it stood still, the map shows the view from there.",
    "poses_disagree": "Use better poses, if there are any; state their errors as returns.pose_sigma_m, if not.",
    "poses_drift": "Refine them: radarsdf poses, radarsdf fit --refine, or radarsdf.refine_poses(points, poses).",
    "scans_exchanged": "Pass the scans in the order of their poses: sort both by time, and file names by number.",
    "pose_jumps": "Check the mounting of the sensor there; use poses smoothed over the whole drive, or leave out these scans.",
    "clock_offset": "Use one clock for scans and poses, and the time of measurement, not that of arrival.",
    "motion_undecided": _UNDECIDED,
    "mirroring_undecided": _UNDECIDED,
    "undecided": "Check order, mounting and clock by other means, and refine the poses only if these are right.",
    "times": "Sort scans, poses and times together, and use the record times if the header stamps were never set.",
    "times_uneven": "Pass the times of measurement, not of arrival.",
    "duplicate_scans": "Leave out the copies: they would count as independent measurements.",
    "duplicate_poses": "Interpolate the poses at the times of the scans, unless the sensor stood still.",
    "intensity_constant": "Pass another field, or fit without intensities: this one is not measured.",
    "intensity_constant_in_scans": "Look for a fault of the driver, or fit without intensities.",
    "intensity_sentinel": _NO_VALUE,
    "intensity_outliers": _NO_VALUE,
    "intensity_is_doppler": "Pass the field of the power or of the radar cross section as intensity.",
    "intensity_clipped": "Lower the gain of the sensor, or read a field that is not clipped.",
    "intensity_offset": "Subtract 128 for dBsm; a fit does not need it.",
    "intensity_steps": "No action needed.",
    "doppler_without_velocity": "Pass the measured radial velocity in m/s, without compensation of the sensor's motion.",
    "doppler_contradicts_poses": "Pass Doppler in m/s with the ego motion, of the same scan; check times in s and positions in m.",
    "doppler_offset": "Subtract it, or calibrate the sensor.",
    "doppler_sign": "Change the sign of the Doppler, so that it is negative for approaching returns.",
    "moving_share": "A fit leaves them out, unless returns.drop_moving is false.",
    "below_ground": "Leave them out if they are reflections in the ground.",
    "fit_refuses": "See the message.",
    "noise": "No action needed: a fit estimates it.",
    "cost": "Lower effort if this is too expensive.",
}
"""Remedy of each finding by name."""


@dataclass(frozen=True)
class Finding:
    """A fact about the data to consider before a fit."""

    name: str
    """Short lower-case name that is stable across versions, such as ``poses_inverted``."""
    severity: Severity
    """``error``: a map of these data would be nonsense. ``warning``: it would suffer. ``note``: for information."""
    evidence: str
    """Numerical evidence in one sentence."""
    fix: str = ""
    """Remedy in one or two sentences. Default: that of the name."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "fix", self.fix or FIXES[self.name])

    def __str__(self) -> str:
        return f"{self.severity}: {self.name}: {self.evidence} {self.fix}"


def checked_input(
    points: Sequence[ArrayLike],
    poses: ArrayLike,
    intensities: Sequence[ArrayLike] | None = None,
    doppler_mps: Sequence[ArrayLike] | None = None,
    times_s: ArrayLike | None = None,
) -> Scans:
    """Check shapes and types, with errors that name the argument, and build scans; the values themselves remain to be checked."""
    scans = [_numbers(scan, f"scan {i}") for i, scan in enumerate(checks.one_for_each_scan(points, "points"))]
    checks.check(scans, "points holds no scans")
    for i, scan in enumerate(scans):
        checks.check_scan_shape(scan, i)
    T_world_sensor = checks.pose_matrices(poses, len(scans))
    times = None if times_s is None else checks.real_array(times_s, "times_s").copy()
    if times is not None:
        one_each = times.shape == (len(scans),)
        checks.check(one_each, f"times_s must have shape ({len(scans)},), not {times.shape}")
        times[np.abs(times) > checks.MAX_TIME_S] = np.nan
    doppler, values = (
        None if given is None else checks.values_of_scans(given, scans, name, _numbers)
        for name, given in (("doppler_mps", doppler_mps), ("intensities", intensities))
    )
    return Scans(scans, T_world_sensor, values, doppler_mps=doppler, times_s=times)


def ascending_times_s(scans: Scans) -> Floats | None:
    """Times (F,) if they are strictly ascending, else None."""
    times = scans.times_s
    return times if times is not None and (np.diff(times) > 0).all() else None


def some_scans(scans: Scans) -> list[int]:
    """Indices of at most about `_SAMPLE` scans, at equal steps."""
    return list(range(0, len(scans), -(-len(scans) // _SAMPLE)))


def some_points(scans: Scans) -> list[Floats]:
    """Returns (N_i, 3) of :func:`some_scans`."""
    return [np.asarray(scans.points[i], np.float64) for i in some_scans(scans)]


def _numbers(values: ArrayLike, name: str) -> Array:
    """Convert to an array of real numbers. float32 is kept: only samples enter computations."""
    if isinstance(values, np.ndarray) and values.dtype.kind == "f":
        checks.refuse_masked(values, name)
        return values
    return checks.real_array(values, name)
