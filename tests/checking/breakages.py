"""Ways to break good data, each with the finding of `radarsdf.check` that reports it, and good recordings."""

import dataclasses
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import radarsdf
from numpy.typing import NDArray
from radarsdf.checking.check import check_cheaply
from radarsdf.checking.doppler import velocity_of_poses
from radarsdf.io.poses import Trajectory
from radarsdf.simulate import SCENES
from scipy.spatial.transform import Rotation

from scenes.kinds import KINDS

FloatArray = NDArray[np.float64]

_CAMERA_OF_RADAR = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
_QUARTER_TURN = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
_TIMES_OF_STEP = 2  # clock offset in scans


@dataclass(frozen=True)
class Data:
    """The arguments of `radarsdf.check`."""

    points: list[NDArray[Any]]
    poses: FloatArray
    intensities: list[NDArray[Any]]
    doppler_mps: list[NDArray[Any]] | None = None
    times_s: FloatArray | None = None

    def scans(self, numbers: Iterable[int]) -> "Data":
        """The scans with these numbers, with the same poses and times."""
        points, intensities, doppler_mps = (
            None if values is None else [values[i] for i in numbers]
            for values in (self.points, self.intensities, self.doppler_mps)
        )
        return dataclasses.replace(self, points=points, intensities=intensities, doppler_mps=doppler_mps)

    def arguments(self) -> dict[str, Any]:
        """Names and values of the arguments."""
        return {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}


Way = Callable[[Data], Data]


def _points(change: Callable[[FloatArray], FloatArray]) -> Way:
    return lambda data: dataclasses.replace(
        data, points=[change(scan.astype(np.float64)) for scan in data.points]
    )


def _positions(change: Callable[[FloatArray], FloatArray]) -> Way:
    def broken(data: Data) -> Data:
        poses = data.poses.copy()
        poses[:, :3, 3] = change(poses[:, :3, 3])
        return dataclasses.replace(data, poses=poses)

    return broken


def _poses(change: Callable[[FloatArray], FloatArray]) -> Way:
    return lambda data: dataclasses.replace(data, poses=change(data.poses))


def _intensities(change: Callable[[NDArray[Any]], NDArray[Any]]) -> Way:
    return lambda data: dataclasses.replace(data, intensities=[change(values) for values in data.intensities])


def _in_world(data: Data) -> Data:
    moved = [scan @ pose[:3, :3].T + pose[:3, 3] for scan, pose in zip(data.points, data.poses, strict=True)]
    return dataclasses.replace(data, points=moved)


def _all_millimetres(data: Data) -> Data:
    return _positions(lambda t: 1000 * t)(_points(lambda p: 1000 * p)(data))


def _degrees_for_rad(poses: FloatArray) -> FloatArray:
    broken = poses.copy()
    degrees = Rotation.from_matrix(poses[:, :3, :3]).as_euler("ZYX", degrees=True)
    broken[:, :3, :3] = Rotation.from_euler("ZYX", degrees).as_matrix()
    return broken


def _rad_for_degrees(poses: FloatArray) -> FloatArray:
    broken = poses.copy()
    rad = Rotation.from_matrix(poses[:, :3, :3]).as_euler("ZYX")
    broken[:, :3, :3] = Rotation.from_euler("ZYX", rad, degrees=True).as_matrix()
    return broken


def _of_vehicle(axis: str, degrees: float) -> Way:
    """The poses of a vehicle on which the sensor is turned."""
    T_sensor_vehicle = np.eye(4)
    T_sensor_vehicle[:3, :3] = Rotation.from_euler(axis, -degrees, degrees=True).as_matrix()
    return _poses(lambda T: T @ T_sensor_vehicle)


def _quaternions_rolled(poses: FloatArray) -> FloatArray:
    """Quaternions w x y z, read as x y z w."""
    broken, quaternions = poses.copy(), Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    broken[:, :3, :3] = Rotation.from_quat(np.roll(quaternions, 1, axis=1)).as_matrix()
    return broken


def _drifted(way_m: float, degrees: float) -> Way:
    """Position drifts sideways and heading to the left, at a constant rate."""

    def drifted(poses: FloatArray) -> FloatArray:
        broken, share = poses.copy(), np.linspace(0, 1, len(poses))
        turns = Rotation.from_euler("z", degrees * share[:, None], degrees=True).as_matrix()
        broken[:, :3, :3] = turns @ poses[:, :3, :3]
        moved = np.einsum("nij,nj->ni", turns, poses[:, :3, 3] - poses[0, :3, 3])
        broken[:, :3, 3] = moved + poses[0, :3, 3] + way_m * share[:, None] * poses[0, :3, 1]
        return broken

    return _poses(drifted)


def _there_and_back(data: Data) -> Data:
    """The same trajectory again, backwards, with a final error of 0.4 m."""
    rng = np.random.default_rng(0)

    def again(arrays: list[NDArray[Any]], sigma: float = 0.0) -> list[NDArray[Any]]:
        return [*arrays, *(a + rng.normal(0, sigma, a.shape) for a in reversed(arrays))]

    both = dataclasses.replace(
        data,
        points=again(data.points, 1e-3),
        poses=np.concatenate([data.poses, data.poses[::-1]]),
        intensities=again(data.intensities),
        doppler_mps=None,
        times_s=None,
    )
    return _drifted(0.4, 0.0)(both)


def _turned(poses: FloatArray) -> FloatArray:
    """The drive turns by 25 degrees on the spot, halfway."""
    broken, middle = poses.copy(), len(poses) // 2
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler("z", 25, degrees=True).as_matrix()
    broken[middle:] = poses[middle] @ turn @ np.linalg.inv(poses[middle]) @ poses[middle:]
    return broken


def _moved_on(poses: FloatArray) -> FloatArray:
    """From halfway on, all poses are shifted sideways by 4 m."""
    broken, middle = poses.copy(), len(poses) // 2
    broken[middle:, :3, 3] += 4 * poses[middle, :3, 1]
    return broken


def _one_off(poses: FloatArray) -> FloatArray:
    """One pose is shifted sideways by 4 m."""
    broken, middle = poses.copy(), len(poses) // 2
    broken[middle, :3, 3] += 4 * poses[middle, :3, 1]
    return broken


def _copied(data: Data) -> Data:
    """A scan in the middle is replaced by the previous one."""
    numbers = np.arange(len(data.points))
    numbers[len(numbers) // 2] -= 1
    return data.scans(numbers)


def _late(data: Data) -> Data:
    """Each scan has the pose of two scans before."""
    times_s = None if data.times_s is None else data.times_s[:-_TIMES_OF_STEP]
    later = data.scans(range(_TIMES_OF_STEP, len(data.points)))
    return dataclasses.replace(later, poses=data.poses[:-_TIMES_OF_STEP], times_s=times_s)


def _clipped(data: Data) -> Data:
    highest = np.percentile(np.concatenate(data.intensities), 85)
    return _intensities(lambda values: np.minimum(values, highest))(data)


def _replaced(share: float, low: float, high: float) -> Way:
    """A `share` of the intensities, at least one, is replaced by values between `low` and `high`."""

    def broken(data: Data) -> Data:
        whole = np.concatenate(data.intensities).astype(np.float64)
        rng, count = np.random.default_rng(0), max(1, round(share * len(whole)))
        whole[rng.choice(len(whole), count, replace=False)] = rng.uniform(low, high, count)
        ends = np.cumsum([len(values) for values in data.intensities])
        return dataclasses.replace(data, intensities=np.split(whole, ends[:-1]))

    return broken


def _below_ground(data: Data) -> Data:
    def mirrored(scan: FloatArray) -> FloatArray:
        lower = scan.copy()
        lower[::4, 2] = -3.6 - np.abs(lower[::4, 2] + 1.2)
        lower[::4, 2] -= 0.1 * np.linalg.norm(scan[::4], axis=1)
        return lower

    return _points(mirrored)(data)


def _doppler_as_intensity(data: Data) -> Data:
    return dataclasses.replace(data, intensities=data.doppler_mps)


def _with_other_sign(data: Data) -> Data:
    return dataclasses.replace(data, doppler_mps=[-speeds for speeds in data.doppler_mps])


def _sensor_turned(data: Data) -> Data:
    turn = Rotation.from_euler("z", 8, degrees=True).as_matrix()
    return _points(lambda p: p @ turn.T)(data)


WAYS: dict[str, tuple[str, Way]] = {
    "points in the world frame": ("points_in_world_frame", _in_world),
    "poses inverted": ("poses_inverted", _poses(lambda T: np.asarray(np.linalg.inv(T)))),
    "poses transposed": ("poses_transposed", _poses(lambda T: T.transpose(0, 2, 1))),
    "poses scaled": ("poses_not_rigid", _poses(lambda T: T * [1.1, 1.1, 1.1, 1])),
    "points in mm": ("units", _points(lambda p: 1000 * p)),
    "positions in mm": ("units", _positions(lambda t: 1000 * t)),
    "positions in cm": ("units", _positions(lambda t: 100 * t)),
    "all in mm": ("units", _all_millimetres),
    "degrees taken for rad": ("angles_in_degrees", _poses(_degrees_for_rad)),
    "rad taken for degrees": ("angles_in_degrees", _poses(_rad_for_degrees)),
    "points in a camera frame": ("camera_frame", _points(lambda p: p @ _CAMERA_OF_RADAR.T)),
    "x and y swapped": ("axes_swapped", _points(lambda p: p[:, [1, 0, 2]])),
    "points turned by 90 degrees": ("axes_swapped", _points(lambda p: p @ _QUARTER_TURN.T)),
    "points with y right, z down": ("axes_swapped", _points(lambda p: p * [1, -1, -1])),
    "positions turned by 90 degrees": ("axes_swapped", _positions(lambda t: t @ _QUARTER_TURN.T)),
    "points mirrored": ("mirrored", _points(lambda p: p * [1, -1, 1])),
    "positions mirrored": ("mirrored", _positions(lambda t: t * [1, -1, 1])),
    "poses left-handed": ("mirrored", _poses(lambda T: T @ np.diag([1.0, -1, 1, 1]))),
    "all poses equal": ("poses_stand_still", _poses(lambda T: np.repeat(T[:1], len(T), axis=0))),
    "all positions 0": ("poses_stand_still", _positions(np.zeros_like)),
    "quaternions w x y z read as x y z w": ("quaternion_order", _poses(_quaternions_rolled)),
    **{
        f"poses of a vehicle, sensor turned by {degrees} degrees of yaw": (
            "sensor_turned",
            _of_vehicle("z", degrees),
        )
        for degrees in (10, 20, 30, 45)
    },
    "poses of a vehicle, sensor turned by 15 degrees of pitch": ("sensor_turned", _of_vehicle("y", 15)),
    "drift of 1.5 m and 6 degrees": ("poses_disagree", _drifted(1.5, 6.0)),
    "there and back, drift of 0.4 m": ("poses_disagree", _there_and_back),
    "4 m to the side from halfway": ("pose_jumps", _poses(_moved_on)),
    "one pose 4 m to the side": ("pose_jumps", _poses(_one_off)),
    "25 degrees to the side from halfway": ("pose_jumps", _poses(_turned)),
    "every pose held for two scans": (
        "duplicate_poses",
        _poses(lambda T: np.repeat(T[::2], 2, axis=0)[: len(T)]),
    ),
    "a scan twice": ("duplicate_scans", _copied),
    "poses of two scans before": ("clock_offset", _late),
    "intensity constant": ("intensity_constant", _intensities(lambda v: np.full_like(v, 7))),
    "intensity constant in each scan": (
        "intensity_constant_in_scans",
        _intensities(lambda v: np.full_like(v, v[0])),
    ),
    "intensity in steps of 0.5": ("intensity_steps", _intensities(lambda v: np.round(2 * v) / 2)),
    "intensity clipped": ("intensity_clipped", _clipped),
    "intensity is RCS + 128": ("intensity_offset", _intensities(lambda v: np.round(v - np.median(v)) + 128)),
    "intensity -9999 in 1 of 100 returns": ("intensity_sentinel", _replaced(0.01, -9999, -9999)),
    "intensity 65535 in 1 of 5 returns": ("intensity_sentinel", _replaced(0.2, 65535, 65535)),
    "one intensity of 1e9": ("intensity_outliers", _replaced(0, 1e9, 1e9)),
    "garbage in 1 of 100 intensities": ("intensity_outliers", _replaced(0.01, -1e9, 1e9)),
    "Doppler as intensity": ("intensity_is_doppler", _doppler_as_intensity),
    "Doppler with the other sign": ("doppler_sign", _with_other_sign),
    "sensor turned by 8 degrees": ("sensor_turned", _sensor_turned),
    "no elevations": ("no_elevation", _points(lambda p: p * [1, 1, 0])),
    "reflections below the ground": ("below_ground", _below_ground),
}
"""What is broken, and the name of its finding and how to break it."""

_STEP_S = 0.1  # between scans, or more
_FASTEST_MPS = 55.0


def simulated(name: str, frames: int, seed: int = 0) -> Data:
    """A simulated scene, with Doppler of its poses and a tenth of the returns moving at 3 m/s."""
    scans = SCENES[name](seed=seed, frames=frames)
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
    """A simulated place from a sensor that is stationary for 12 scans and then moves `step_m` between 12 scans.

    `cell`: resolution of ranges, m, and angles, 0.1 rad, 0 for exact values.
    """
    drive = (SCENES | KINDS)[name](seed=seed, frames=12)
    usual_m = np.linalg.norm(np.diff(drive.poses[:2, :3, 3], axis=0))
    at = np.maximum(np.arange(24.0) - 12, 0) * min(step_m / usual_m, 1)
    along = Trajectory(np.arange(12.0), drive.poses[:, :3, 3], Rotation.from_matrix(drive.poses[:, :3, :3]))
    scans = radarsdf.simulate.simulate(drive.scene, drive.sensor, along.poses(at), name=name, seed=seed)
    points = scans.points
    if cell:
        points = [_rounded(scan, cell) for scan in points]
    intensities = [values[: len(scan)] for values, scan in zip(scans.intensities, points, strict=True)]
    return Data(points, scans.poses, intensities)


def _rounded(scan: np.ndarray, cell_m: float) -> np.ndarray:
    """A scan (N, 3) of a sensor with resolution cells that report one return each."""
    range_m = np.linalg.norm(scan, axis=1)
    angles = np.stack([np.arctan2(scan[:, 1], scan[:, 0]), np.arcsin(scan[:, 2] / range_m)])
    azimuth, elevation = 0.1 * np.round(angles / 0.1)
    range_m = cell_m * np.maximum(np.round(range_m / cell_m), 1)
    cells = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )
    return np.unique(np.float32(range_m * cells).T, axis=0)


def found_in(data: Data, cheap: bool) -> list[tuple[str, str]]:
    """Names and severities of the findings."""
    if cheap:
        findings = check_cheaply(data.points, data.poses, data.intensities)
    else:
        findings = radarsdf.check(**data.arguments())
    return [(finding.name, finding.severity) for finding in findings]
