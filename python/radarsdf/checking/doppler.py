"""Checks of Doppler velocities: their consistency, and their agreement with poses, axes and intensities."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from radarsdf.arrays import Array, Floats, Ints
from radarsdf.checking.recording import Finding, ascending_times_s, some_scans
from radarsdf.poses.displacements import compare_with_poses, contradiction
from radarsdf.poses.doppler import LEAST_MPS, NoVelocityError, SensorVelocities, radial_offset_mps
from radarsdf.poses.rigid import rotation, step_vectors
from radarsdf.returns.moving import MIN_DOPPLER_RETURNS, SensorVelocity, sensor_velocities
from radarsdf.scans import Scans

_STILL_MPS = 0.3  # slower velocities have no reliable direction
_MIN_SCANS = 4
_MIN_SIGNIFICANCE = 4.0
_MIN_YAW_RAD = np.radians(3)
_MANY_MOVE = 0.4
_BLOCK = 40  # successive scans to compare


def check_doppler(recording: Scans) -> Iterator[Finding]:
    """Check the agreement of Doppler, intensities, poses and axes. The poses must be rigid transforms."""
    if recording.intensities is not None and _are_speeds(recording, recording.intensities):
        evidence = "In most scans the intensities fit one velocity of the sensor, as Doppler values do."
        yield Finding("intensity_is_doppler", "error", evidence)
    if recording.doppler_mps is None:
        return
    scans, velocities = velocities_of_some(recording, recording.doppler_mps)
    good = np.array([velocity.found for velocity in velocities], bool)
    tried, without = len(scans), int((~good).sum())
    if tried - without < max(_MIN_SCANS, tried // 2):
        if tried >= _MIN_SCANS:
            evidence = f"In {without} of {tried} scans no velocity fits 40 % of the Doppler values."
            yield Finding("doppler_without_velocity", "warning", evidence)
        return
    static = np.concatenate([velocity.static for velocity in velocities if velocity.found])
    moving = 1 - static.mean()
    evidence = f"According to their Doppler, {moving:.1%} of the returns move."
    yield Finding("moving_share", "warning" if moving > _MANY_MOVE else "note", evidence)
    by_doppler = np.array([velocity.velocity_mps for velocity in velocities if velocity.found])
    yield from _compared_with_poses(recording, scans[good], by_doppler)


def velocities_of_some(recording: Scans, values: list[Array]) -> tuple[Ints, list[SensorVelocity]]:
    """Velocities of some scans from `values`, which may be Doppler, and the scans."""
    scans = [i for i in some_scans(recording) if len(recording.points[i]) >= MIN_DOPPLER_RETURNS]
    found = sensor_velocities([recording.points[i] for i in scans], [values[i] for i in scans])
    return np.array(scans, np.int64), found


def _are_speeds(recording: Scans, values: list[Array]) -> bool:
    """Whether values (N_i,) of the scans are Doppler: most scans fit a velocity, which is not zero in all."""
    if min(float(np.min(value, initial=0)) for value in values) >= 0:
        return False  # Doppler has both signs, or a negative one for approaching returns
    scans, velocities = velocities_of_some(recording, values)
    found = [velocity.velocity_mps for velocity in velocities if velocity.found]
    if len(scans) < _MIN_SCANS or len(found) < 0.7 * len(scans):
        return False
    return bool(np.median(np.linalg.norm(found, axis=1)) > _STILL_MPS)


def _compared_with_poses(recording: Scans, scans: Ints, by_doppler: Floats) -> Iterator[Finding]:
    """Compare the directions of velocities (K, 3) of scans (K,) from Doppler with those from poses: sign and yaw."""
    times = ascending_times_s(recording)
    knots = np.arange(len(recording), dtype=np.float64) if times is None else times
    if len(recording) < _MIN_SCANS:
        return
    by_poses = velocity_of_poses(recording.poses, knots)[scans]
    used = (scans > 0) & (scans < len(recording) - 1)
    used &= (np.linalg.norm(by_poses, axis=1) > 0) & (np.linalg.norm(by_doppler, axis=1) > _STILL_MPS)
    if used.sum() < _MIN_SCANS:
        if times is not None:
            yield from _compared_speeds(recording, scans, by_poses, by_doppler)
        return
    a, b = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (by_doppler[used], by_poses[used]))
    cosine = float(np.median(np.einsum("na,na->n", a, b)))
    sign = -1.0 if cosine < -0.8 else 1.0
    if times is not None:
        found = list(_compared_speeds(recording, scans, by_poses, sign * by_doppler))
        yield from found
        yield from _compared_in_block(recording, times, sign, known=bool(found))
    if cosine < -0.8:
        # Sign conventions differ, and moving returns are found with either: so this is not a fault of the data.
        evidence = f"By its Doppler the sensor moves backwards where its poses move forwards (median cosine {cosine:.2f})."
        yield Finding("doppler_sign", "note", evidence)
        a = -a
    # Yaw between the two, in each scan.
    yaws = np.arctan2(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0], np.einsum("na,na->n", a[:, :2], b[:, :2]))
    yaw = float(np.median(yaws))
    spread = 1.4826 * float(np.median(np.abs(yaws - yaw))) * np.sqrt(np.pi / 2 / len(yaws))
    if abs(yaw) > max(_MIN_YAW_RAD, _MIN_SIGNIFICANCE * spread):
        degrees, over = np.degrees(yaw), f"the median of {len(yaws)} scans"
        evidence = f"The poses move {degrees:+.1f} degrees to the left of the Doppler velocity, {over}."
        yield Finding("sensor_turned", "warning", evidence)


def _compared_speeds(
    recording: Scans, scans: Ints, by_poses: Floats, by_doppler: Floats
) -> Iterator[Finding]:
    """Compare velocities (K, 3) of scans (K,), sensor frame, m/s, by window."""
    used = (scans > 0) & (scans < len(recording) - 1)
    variances = np.full(int(used.sum()), LEAST_MPS**2)
    scans = np.append(scans[used], scans[used][-1:])
    found = contradiction(by_poses[used], by_doppler[used], variances, scans)
    if found is not None:
        yield _contradiction(found.words("the poses"))


def _compared_in_block(recording: Scans, times_s: Floats, sign: float, *, known: bool) -> Iterator[Finding]:
    """Compare successive scans in the middle: times with even ones, and Doppler with that of a velocity alone."""
    assert recording.doppler_mps is not None
    begin = max(0, (len(recording) - _BLOCK) // 2)
    rows = slice(begin, begin + _BLOCK)
    points = [np.asarray(scan, np.float64) for scan in recording.points[rows]]
    speeds = [sign * np.asarray(values, np.float64) for values in recording.doppler_mps[rows]]
    try:
        velocities = SensorVelocities.of(points, speeds, times_s[rows])
    except NoVelocityError:
        return
    if offset_mps := radial_offset_mps(points, speeds, velocities):
        evidence = f"{sign * offset_mps:+.2f} m/s are added to the Doppler of all returns."
        yield Finding("doppler_offset", "warning", evidence)
    contradicted, clock = compare_with_poses(velocities, times_s[rows], recording.poses[rows])
    if contradicted is not None and not known:
        yield _contradiction(contradicted)
    if contradicted is None and clock.note:
        yield Finding("times_uneven", "warning", clock.note[0])


def _contradiction(words: str) -> Finding:
    return Finding("doppler_contradicts_poses", "warning", f"{words[0].upper()}{words[1:]}.")


def velocity_of_poses(T_world_sensor: Floats, times_s: Floats) -> Floats:
    """(F, 3) velocities of the sensor in its own frame at the poses (F, 4, 4), m/s, from central differences."""
    moves = step_vectors(T_world_sensor)
    between = np.einsum("fji,fj->fi", rotation(moves[:, 3:] / 2), moves[:, :3]) / np.diff(times_s)[:, None]
    return np.concatenate([between[:1], (between[1:] + between[:-1]) / 2, between[-1:]])
