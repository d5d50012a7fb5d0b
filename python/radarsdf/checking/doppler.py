"""Checks of Doppler velocities: their agreement with poses, axes, intensities and the mountings of several radars."""

import contextlib
from collections.abc import Iterator

import numpy as np

from radarsdf.arrays import Array, Floats, Ints
from radarsdf.checking.recording import COARSE_M, Finding, ascending_times_s, some_scans
from radarsdf.config.fit_config import FitConfig
from radarsdf.poses.agreement import Agreement, Gain, choose_pairs
from radarsdf.poses.calibrate import calibrate
from radarsdf.poses.consistency import Consistency, contradiction
from radarsdf.poses.doppler import LEAST_MPS, NoVelocityError, SensorVelocities
from radarsdf.poses.rigid import increments, rotation, step_vectors
from radarsdf.returns.moving import MIN_DOPPLER_RETURNS, SensorVelocity, sensor_velocities
from radarsdf.rig import Label
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
    moving = 1 - np.concatenate([velocity.static for velocity in velocities if velocity.found]).mean()
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
    enough = len(scans) >= _MIN_SCANS and len(found) >= 0.7 * len(scans)
    return enough and bool(np.median(np.linalg.norm(found, axis=1)) > _STILL_MPS)


def _compared_with_poses(recording: Scans, scans: Ints, by_doppler: Floats) -> Iterator[Finding]:
    """Compare the directions of velocities (K, 3) of scans (K,) from Doppler with those from poses: sign and yaw."""
    times = ascending_times_s(recording)
    knots = np.arange(len(recording), dtype=np.float64) if times is None else times
    by_poses = velocity_of_poses(recording.poses, knots)[scans]
    inner = (scans > 0) & (scans < len(recording) - 1)
    used = inner & (np.linalg.norm(by_poses, axis=1) > 0) & (np.linalg.norm(by_doppler, axis=1) > _STILL_MPS)
    a, b = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (by_doppler[used], by_poses[used]))
    moves = used.sum() >= _MIN_SCANS
    cosine = float(np.median(np.einsum("na,na->n", a, b))) if moves else 1.0
    sign = -1.0 if cosine < -0.8 else 1.0
    if times is not None:
        variances, edges = np.full(int(inner.sum()), LEAST_MPS**2), np.append(scans[inner], scans[inner][-1:])
        found = contradiction(by_poses[inner], sign * by_doppler[inner], variances, edges)
        wrong = None if found is None else found.words("the poses")
        yield from _compare_block(recording, times, sign, wrong)
    if not moves:
        return
    if sign < 0:
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


def _compare_block(recording: Scans, times_s: Floats, sign: float, wrong: str | None) -> Iterator[Finding]:
    """Compare successive scans: times with even ones, Doppler with one velocity. `wrong`: what contradicts that of all scans."""
    begin = max(0, (len(recording) - _BLOCK) // 2)
    rows = slice(begin, begin + _BLOCK)
    points = [np.asarray(scan, np.float64) for scan in recording.points[rows]]
    speeds = [sign * np.asarray(values, np.float64) for values in (recording.doppler_mps or [])[rows]]
    with contextlib.suppress(NoVelocityError):
        velocities = SensorVelocities.of(points, speeds, times_s[rows])
        if velocities.offset is not None:
            evidence = f"{sign * velocities.offset[0]:+.2f} m/s are added to the Doppler of all returns."
            yield Finding("doppler_offset", "warning", evidence)
        tested = Consistency.of_poses(velocities, times_s[rows], recording.poses[rows])
        wrong = wrong or tested.contradiction
        clock = tested.clock
        if tested.contradiction is None and clock is not None and clock.note:
            moved_m = velocities.usual_mps * max(clock.errors_s.std(), clock.sigma_s)
            if moved_m > COARSE_M:
                yield Finding("times_uneven", "warning", clock.note[0])
    if wrong is not None:
        yield Finding("doppler_contradicts_poses", "warning", f"{wrong[0].upper()}{wrong[1:]}.")


def velocity_of_poses(T_world_sensor: Floats, times_s: Floats) -> Floats:
    """(F, 3) velocities of the sensor in its own frame at the poses (F, 4, 4), m/s, from central differences."""
    moves = step_vectors(T_world_sensor)
    between = np.einsum("fji,fj->fi", rotation(moves[:, 3:] / 2), moves[:, :3]) / np.diff(times_s)[:, None]
    return np.concatenate([between[:1], (between[1:] + between[:-1]) / 2, between[-1:]])


_READ_AS = {  # factors of y and z, the name of the finding, and what completes "agree better if"
    (1.0, -1.0): ("mounting_mirrored", "the sign of its elevation is changed"),
    (-1.0, 1.0): ("mounting_mirrored", "the sign of its azimuth is changed"),
    (-1.0, -1.0): ("mounting_upside_down", "it is mounted upside down"),
}
_PAIRS, _RETURNS, _QUERIES = 120, 2000, 200  # of scans, and returns of each
_COMMON = 0.01  # standard deviation of the systematic error of velocities, share of the speed
_SURE, _LOG_RATIO = 3.0, 8.0  # standard errors of the returns, and log likelihood ratio with the velocities
_SURE_ALONE, _GAIN = 6.0, 0.05  # of the returns where velocities do not decide
_ERRORS = 4.0  # standard deviations
_LEAST = np.repeat([0.05, np.radians(0.5)], 3)  # of an error that degrades a map, m and rad


def check_mountings(recording: Scans, config: FitConfig) -> Iterator[Finding]:
    """Compare mountings with velocities by Doppler and with the surfaces that radars share. The poses must be rigid."""
    given = recording.T_body_sensor
    assert given is not None
    try:
        found = calibrate(recording, config=config)
    except ValueError:  # there are no times, or the motion is not observable
        return
    for label, mounting in found.mountings.items():
        off = increments(given[label][None], mounting.T_body_sensor[None])[0]
        sigmas = np.sqrt(mounting.covariance.diagonal())
        wrong = (np.abs(off) > _ERRORS * sigmas) & (np.abs(off) > _LEAST)  # False where unobserved
        if wrong[3:].any():
            degrees = np.degrees([np.linalg.norm(off[3:]), np.nanmax(sigmas[3:])])
            evidence = "The rotation of {} differs by {:.1f} degrees from that found, with a deviation of {:.1f}, relative to {}."
            yield Finding("mounting_rotation", "warning", evidence.format(label, *degrees, found.against))
        if wrong[:3].any():
            axis = int(np.nanargmax(np.where(wrong[:3], np.abs(off[:3]), 0.0)))
            evidence = "The lever arm of {} along {} differs by {:.2f} m from that found, with a deviation of {:.2f}, relative to {}."
            values = label, "xyz"[axis], abs(off[axis]), sigmas[axis], found.against
            yield Finding("mounting_lever", "warning", evidence.format(*values))


def misread_radars(recording: Scans) -> Iterator[tuple[Label, Finding]]:
    """Find radars whose returns agree better with those of all scans, and with the poses, if axes are reversed."""
    rig, poses = recording.rig, recording.sensor_poses
    assert rig is not None
    pairs = choose_pairs(recording.points, poses[:, :3, 3], _PAIRS)
    agreement = Agreement(recording.points, _RETURNS, _QUERIES)
    turns = np.array([np.diag([1.0, *factors, 1.0]) for factors in ((1.0, 1.0), *_READ_AS)])
    for k, label in enumerate(rig.labels):
        own = pairs[(rig.of_scan[pairs] == k).any(axis=1)]
        if len(own) == 0:
            continue
        own_scans = (rig.of_scan == k)[:, None, None, None]
        changed = np.where(own_scans, poses[:, None] @ turns, poses[:, None]).swapaxes(0, 1)
        T_j_i = np.stack([np.linalg.inv(each[own[:, 1]]) @ each[own[:, 0]] for each in changed])
        scores = agreement.scores(own, T_j_i)
        comparison = Gain.over(scores[0], scores[1:])
        by_doppler = _log_ratios(recording.select(np.flatnonzero(rig.of_scan == k)), turns[:, :3, :3])
        evidence_of = comparison.significance**2 / 2 + by_doppler
        both = (comparison.significance > _SURE) & (by_doppler > 1) & (evidence_of > _LOG_RATIO)
        sure = comparison.significance > _SURE_ALONE
        alone = sure & (comparison.mean > _GAIN) & (by_doppler > -_LOG_RATIO)
        if not (both | alone).any():
            continue
        best = int(np.argmax(np.where(both | alone, comparison.significance + by_doppler, -np.inf)))
        name, what = list(_READ_AS.values())[best]
        evidence = (
            f"Returns of {label} agree better with the other scans if {what} ({comparison.significance[best]:.0f} standard errors), "
            f"and so do its velocities with the poses (log likelihood ratio {by_doppler[best]:.0f})."
        )
        yield label, Finding(name, "error", evidence)


def _log_ratios(recording: Scans, turns: Floats) -> Floats:
    """Log likelihood ratios (H - 1,) of mean velocities of a radar by Doppler, turned by `turns` (H, 3, 3), to those as they are."""
    times_s = ascending_times_s(recording)
    if recording.doppler_mps is None or times_s is None or len(recording) < 3:
        return np.zeros(len(turns) - 1)
    scans, found = velocities_of_some(recording, recording.doppler_mps)
    by_poses = velocity_of_poses(recording.sensor_poses, times_s)[scans]
    by_doppler = np.reshape([velocity.velocity_mps for velocity in found], (-1, 3))
    speed = np.linalg.norm(by_poses, axis=1).mean()
    if not np.isfinite(by_doppler).any() or speed == 0:
        return np.zeros(len(turns) - 1)
    # The sign of the Doppler is not known.
    turned = np.einsum("hij,nj->hni", turns, by_doppler)
    off = np.stack([np.nanmedian(sign * turned - by_poses, axis=1) for sign in (1.0, -1.0)])
    squares = np.minimum((off / (_COMMON * speed)) ** 2, 100.0).sum(axis=2).min(axis=0)
    return 0.5 * (squares[0] - squares[1:])
