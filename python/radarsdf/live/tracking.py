"""Online tracking: registers scans without poses with the last ones, predicted by Doppler or the motion so far."""

import contextlib
import dataclasses
import itertools
import operator
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from radarsdf.arrays import Floats
from radarsdf.config.fit_config import FitConfig
from radarsdf.live.store import LoggedScan, ScanId, ScanLog
from radarsdf.poses.agreement import CLEAR, ERRORS, sign_significance, turns_fast
from radarsdf.poses.consistency import Consistency
from radarsdf.poses.doppler import (
    LEAST_MPS,
    NOT_USED,
    BodyVelocities,
    NoVelocityError,
    SensorVelocities,
    upright,
)
from radarsdf.poses.imu import FIRST_BIAS_RAD_S, Gyroscope, Inertial
from radarsdf.poses.motion import MotionRate, PredictedStep
from radarsdf.poses.planes import LEAST_OBSERVED, Tracked, plane_cell_m
from radarsdf.poses.rigid import rotation_vector, step_vectors
from radarsdf.poses.search import Lost
from radarsdf.poses.tracking import MOVES, TURNS, WINDOW, Drive, Rates, Tracker, rates_of, track_drive
from radarsdf.returns.moving import SensorVelocity, sensor_velocities
from radarsdf.rig import Label, Rig

_STEPS = 100  # steps from which the motion prior is learnt
# Scans of the initialisation, re-estimated after 2, 4 and 8 with motion, and those of a single radar after each while the sign is open.
_START = 8
_KNOWN_STEPS = 2  # previous steps that make an initialisation unnecessary
# Least share of returns of a known radar that agree while the sign of the Doppler is open: a wrong one places scans metres off.
_LEAST_AGREEING = 0.1
_COMPARED = 24  # last scans whose Doppler is compared with the returns
# A comparison of half of them leaves scales open that place scans 5 % of the path off.
_NOT_COMPARED = "Assumed: the Doppler is right; its comparison with the returns is not complete."
_STEPS_AT_ONCE = 1  # of a comparison at a scan of a rig, about 2 ms
_PARTED = 3  # last scans that suggest this by agreeing less than those before
_PULLED = 0.1  # relative difference of the motion by returns and by Doppler that suggests it
_LEAST_GAIN, _LEAST_STEP_M = 1e-5, 0.1  # of a step whose difference is known
# A leap of the velocity: more than three times the acceleration of gravity, and than this multiple of the earlier changes.
_FASTEST_MPS2, _LEAP, _FEWEST_CHANGES = 30.0, 4.0, 4
_MOVES = 5.0  # standard deviations of a significant velocity
_OBSERVED_STEPS = 10  # steps over which returns alone must observe the motion of the sensor
_GIVEN = np.diag([0.01**2] * 3 + [0.001**2] * 3)  # approximate covariance of a step between given poses


class Elsewhere(Lost):
    """The scan may be anywhere in the map."""


@dataclass(frozen=True)
class Step:
    """Scan with its estimated pose."""

    scan_id: ScanId
    logged: LoggedScan  # with its time. Its current pose in the map is in `found`
    velocity: SensorVelocity | None  # from its Doppler, if that yields one
    found: Tracked
    given: bool = True  # whether the pose was given, and is not re-estimated
    # Relative difference of the motion that the returns show from that by Doppler. NaN if unknown.
    pull: float = np.nan
    sign: int = 0  # sign of the Doppler as known then: -1 if positive for approaching objects, 0 if unknown
    rates: Rates = dataclasses.field(default_factory=Rates)  # since the previous scan of its radar

    @property
    def time_s(self) -> float:
        assert self.logged.time_s is not None
        return self.logged.time_s

    @property
    def sensor_scan(self) -> Floats:
        """(N, 3) static returns, sensor frame, m."""
        return np.ascontiguousarray(self.logged.static.points, np.float64)

    @property
    def scan(self) -> Floats:
        """(N, 3) static returns, frame of the poses, m."""
        radar, scan = self.logged.radar, self.sensor_scan
        return scan if radar is None else scan @ radar.T_body_sensor[:3, :3].T + radar.T_body_sensor[:3, 3]

    @cached_property
    def moves(self) -> bool:
        """Whether the sensor may move: False if its Doppler shows that it is stationary."""
        if self.velocity is None:
            return True
        v = self.velocity.velocity_mps
        return float(v @ np.linalg.solve(_covariance(self.velocity), v)) > _MOVES**2


@dataclass(frozen=True)
class Track:
    """Scans from which tracking continues."""

    steps: tuple[Step, ...] = ()
    given: tuple[tuple[ScanId, LoggedScan], ...] = ()  # later ones with given poses

    def placed(self, scan_id: ScanId, logged: LoggedScan) -> "Track":
        """Return the track with a scan at a given pose. It is processed before the next one without."""
        if logged.time_s is None:
            return self
        return dataclasses.replace(self, given=(*self.given, (scan_id, logged))[-WINDOW:])


@dataclass
class _DopplerCheck:
    """Comparison of the Doppler of a radar with its returns."""

    label: Label | None
    time_s: float = -np.inf  # of the last scan compared
    patience: int = _START // 2  # scans until the next comparison
    compared: int = 0  # scans
    doubts: tuple[str, ...] = ()
    refused: bool = False  # whether the returns excluded the Doppler: the next scans are compared at once
    under_way: Iterator[tuple[Floats, SensorVelocities, Consistency] | None] | None = None

    def begin(self, steps: list[Step], config: FitConfig) -> None:
        """Begin to compare the last scans of the radar, if due."""
        without = [i for i, step in enumerate(steps) if step.velocity is None or step.given]
        steps = steps[max(without, default=-1) + 1 :][-_COMPARED:]
        count, since = len(steps), sum(step.time_s > self.time_s for step in steps)
        due = self.refused or count == _START or count >= 2 * _START > self.compared
        if self.under_way or count < _START:
            return
        if not due and (since < self.patience or not self._suspects(steps)):
            return
        # Tracking of sparse scans often differs from right Doppler: of such scans, ever fewer are compared.
        self.time_s, self.patience = steps[-1].time_s, self.patience * (1 if due else 2)
        self.under_way = _compare(steps, config)

    def proceed(self, most: int | None) -> None:
        """Continue the comparison by `most` steps. Raise Lost if the returns exclude the Doppler."""
        # If this is interrupted, so is the comparison.
        under_way, self.under_way = self.under_way, None
        for found in filter(None, itertools.islice(under_way or (), most)):
            self._decide(*found)
            break
        else:
            self.under_way = under_way

    def _suspects(self, steps: list[Step]) -> bool:
        pulls = np.array([step.pull for step in steps if np.isfinite(step.pull)])[-_START:]
        agreeing = np.array([step.found.agreeing for step in steps])
        pulled = len(pulls) == _START and abs(pulls.mean()) > _PULLED + ERRORS * pulls.std() / np.sqrt(_START)
        parted = np.median(agreeing[-_PARTED:]) < 0.5 * np.median(agreeing[1:-_PARTED])
        return bool(pulled or parted or self.doubts or not self.compared)

    def _decide(self, times_s: Floats, velocities: SensorVelocities, tested: Consistency) -> None:
        of = "" if self.label is None else f" of {self.label}"
        begin = f"Scan 0 of these is that{of} at {times_s[0]:.6f} s."
        other = tested.contradicted if velocities.offset is None else None
        trusted, notes = tested.applied(velocities)
        if other is not None and not other.confirmed:
            notes = [f"Assumed: the Doppler is right; {other.words('the returns')}."]
        elif trusted is None:
            self.refused = True
            msg = f"{notes[-1]} {begin} Give the poses of this scan and the next ones, or leave their Doppler out"
            raise Lost(msg)
        self.refused, self.compared = False, len(times_s)
        self.doubts = tuple(f"{note} {begin}" for note in notes)


class Follower:
    """Tracker of the sensor. A cache: the map owns the track and the poses, which are read before each scan."""

    def __init__(self, config: FitConfig, num_radars: int) -> None:
        self.config, self.num_radars = config, num_radars
        self._checks: dict[Label | None, _DopplerCheck] = {}  # by radar
        self._edits = 0  # of the log, when the poses were read
        self._complete = False  # False while the attributes below change, or if that was interrupted
        self._steps: deque[Step] = deque(maxlen=_STEPS * num_radars)

    def seek(self, track: Track, log: ScanLog, scan_id: ScanId, logged: LoggedScan) -> list[Step]:
        """Register a scan, ignoring its own pose: the last of the steps returned. Those before it are re-estimated scans."""
        self._synchronise(track, log)
        logged = dataclasses.replace(logged, tracked=len(self._steps) > 0)  # the first one defines the world
        new = Step(scan_id, logged, self._velocity(logged), Tracked(np.eye(4)), given=False)
        if not self._steps:
            if len(log):
                msg = "the map has scans, but none with a time to continue from: give the pose of the scan, and its time"
                raise Elsewhere(msg)
            return [new]
        last = self._steps[-1]
        if new.time_s < last.time_s or (new.time_s == last.time_s and new.logged.label == last.logged.label):
            msg = f"a scan without a pose must be later than the one before it, at {last.time_s:.6f} s"
            raise ValueError(msg)
        sign = next((step.sign for step in reversed(self._steps) if step.sign), 0)
        found = self._start(log, new, sign) or [self._next(new, sign)]
        self._refuse_unobserved(new, found)
        self._refuse_leap(new)
        own = self._checks.setdefault(new.logged.label, _DopplerCheck(new.logged.label))
        own.begin(self._of_radar(found[-1]), self.config)
        # Scans of a rig follow each other closely: a comparison is spread over the next ones of all radars.
        waiting = [check for check in self._checks.values() if check.under_way]
        first = own if own.refused else min(waiting, key=operator.attrgetter("time_s"), default=own)
        first.proceed(None if first.refused or self.num_radars == 1 else _STEPS_AT_ONCE)
        return found

    def _refuse_unobserved(self, new: Step, found: list[Step]) -> None:
        """Raise Lost if the returns show the pose of a scan nowhere, or neither they nor its Doppler show the motion."""
        by_doppler = new.velocity is not None and (found[-1].sign != 0 or not new.moves)
        fewest = _OBSERVED_STEPS * self.num_radars  # beyond the initialisation, which decides the sign
        observed = [step.found.observed[0] for step in self._steps if not step.given][-fewest:]
        unobserved = len(observed) == fewest and np.median(observed) < LEAST_OBSERVED
        unsigned = new.velocity is not None and not by_doppler and len(self._of_radar(new)) > 1
        unlike = unsigned and found[-1].found.agreeing < _LEAST_AGREEING
        elsewhere = unlike or any(step.found.segment for step in found)
        if not elsewhere and (by_doppler or not unobserved):
            return
        nowhere = f"the scan at {new.time_s:.6f} s agrees with the last ones nowhere near its predicted pose, or in several places"
        why = nowhere if elsewhere else "the returns alone do not observe the motion of the sensor"
        msg = f"{why}: give its pose, or its Doppler (doppler_mps)"
        if new.logged.doppler_mps is not None and not by_doppler:
            msg += f". {NOT_USED}: scans agree on no velocity, or its sign is not known yet"
        raise (Elsewhere if elsewhere else Lost)(msg)

    def _refuse_leap(self, new: Step) -> None:
        steps = self._of_radar(new)
        known = [(one.time_s, one.velocity.velocity_mps) for one in steps if one.velocity]
        if new.velocity is None or len(known) < _FEWEST_CHANGES + 2 or not steps[-2].moves:
            return
        times_s, velocities = (np.array(columns) for columns in zip(*known, strict=True))
        changes = np.linalg.norm(np.diff(velocities, axis=0), axis=1) / np.sqrt(np.diff(times_s))
        usual = float(np.sqrt((changes[:-1] ** 2).mean()))
        leap_mps = float(np.linalg.norm(velocities[-1] - velocities[-2]))
        if leap_mps > _FASTEST_MPS2 * (times_s[-1] - times_s[-2]) and changes[-1] > _LEAP * usual:
            msg = f"{NOT_USED}: its velocity changes by {leap_mps:.1f} m/s, far more than before: give the pose of the scan"
            raise Lost(msg)

    def doubts(self, step: Step) -> tuple[str, ...]:
        """Return what its pose assumes of the Doppler. In a rig, that of the other radars moves the body, too."""
        used = [step, *reversed(self._steps)][: 3 * self.num_radars - 2]
        notes = list[str]()
        for label in dict.fromkeys(one.logged.label for one in used if one.velocity and not one.given):
            check = self._checks.get(label, _DopplerCheck(label))
            known = check.compared >= 2 * _START and not check.under_way and not check.refused
            doubts = check.doubts or (() if known else (_NOT_COMPARED,))
            notes += [note if label is None else f"{label}: {note}" for note in doubts]
        return tuple(notes)

    def _of_radar(self, new: Step) -> list[Step]:
        return [step for step in [*self._steps, new] if step.logged.label == new.logged.label]

    def track(self, found: list[Step]) -> Track:
        """Return the track that continues with the scans returned by :meth:`seek`."""
        again = {step.scan_id for step in found}
        kept = (*(step for step in self._steps if step.scan_id not in again), *found)
        return Track(kept[-_STEPS * self.num_radars :])

    def _synchronise(self, track: Track, log: ScanLog) -> None:
        """Read the poses of the map: scans may have been added, moved or removed."""
        steps = [*track.steps]
        if log.edits != self._edits:
            steps = [now for step in steps if (now := _now(step, log)) is not None]
        new = next((more for more in (0, 1) if self._complete and self._continued_by(steps, more)), None)
        self._complete = False
        if new is None:  # reset to the state after only these scans
            self._steps.clear()
            new = len(steps)
        if not self._steps or track.given:  # comparisons under way may be of other scans
            for check in self._checks.values():
                check.under_way = None
        for i in range(len(steps) - new, len(steps)):
            self._add(steps[i], planes=i >= len(steps) - WINDOW * self.num_radars)
        for scan_id, logged in track.given:
            found = Tracked(logged.pose, _GIVEN, 1.0)
            now = _now(Step(scan_id, logged, self._velocity(logged), found), log)
            if now is not None and not (self._steps and now.time_s <= self._steps[-1].time_s):
                self._add(now)
        self._complete, self._edits = True, log.edits

    def _continued_by(self, steps: list[Step], new: int) -> bool:
        """Whether steps are the present ones, without the oldest if there are too many, and `new` ones."""
        before = [*self._steps][max(0, len(self._steps) + new - _STEPS * self.num_radars) :]
        poses = ([step.found.pose for step in each] for each in (before, steps[: len(steps) - new]))
        return len(before) + new == len(steps) and all(map(operator.is_, *poses))

    def _add(self, step: Step, *, planes: bool = True) -> None:
        if self._steps:
            before, found = self._steps[-1], step.found
            turn = rotation_vector(before.found.pose[:3, :3].T @ found.pose[:3, :3], found.turn)
            step = self._with_rates(dataclasses.replace(step, found=dataclasses.replace(found, turn=turn)))
        else:
            cell_m = plane_cell_m([step.scan], self.config.leaf_size_m)
            self._tracker = Tracker(cell_m, self.config, WINDOW * self.num_radars)
        self._steps.append(step)
        if planes:
            self._tracker.add(step.scan, step.found)

    def _with_rates(self, step: Step) -> Step:
        """Return a step with its rates. Narrow radars differ: between two of them, steps of 17 ms turned by 15 degrees in pitch."""
        own = self._of_radar(step)
        if len(own) < 2:
            return step
        first, duration_s = own[-2].found.pose, step.time_s - own[-2].time_s
        since = [one.found for one in [*self._steps, step] if one.time_s > own[-2].time_s]
        turn = np.sum([one.turn for one in since], axis=0)
        turn = rotation_vector(first[:3, :3].T @ step.found.pose[:3, :3], turn)
        covariance = np.sum([one.covariance for one in since], axis=0)
        found = dataclasses.replace(step.found, turn=turn, covariance=covariance)
        return dataclasses.replace(step, rates=rates_of(first, found, duration_s))

    def _velocity(self, logged: LoggedScan) -> SensorVelocity | None:
        if logged.doppler_mps is None:
            return None
        own = [step for step in self._steps if step.logged.label == logged.label]
        known = [one.logged.doppler_mps for one in own[-WINDOW:] if one.logged.doppler_mps is not None]
        found = sensor_velocities([logged.points], [logged.doppler_mps], known)[0]
        return found if found.found else None

    def _next(self, new: Step, sign: int) -> Step:
        """Register a scan from the previous one."""
        steps = [*list(self._steps)[-2 * self.num_radars :], new]
        known = [step.rates for step in self._of_radar(new)[1:-1] if step.rates.duration_s]
        durations_s = np.array([rates.duration_s for rates in known])
        # Short steps of a rig follow the prior: without their errors, it would shrink to nothing.
        turns = TURNS.learnt([rates.turn for rates in known], durations_s, with_errors=self.num_radars > 1)
        moves = MOVES.learnt([rates.move for rates in known], durations_s)
        scan, times_s = new.scan, np.array([step.time_s for step in steps])
        drive = Drive([], times_s, self._velocities(steps, sign), turns, moves, rig=_rig_of(steps))
        expected = drive.predict(len(steps) - 1, steps[-2].rates)
        found = self._tracker.register(scan, expected)
        if drive.rig is None and drive.velocities is not None and sign and not found.agreeing > 0:
            # A sensor that turns faster than predicted was dead-reckoned, or lost.
            _, yaws = sign_significance([step.scan for step in steps], drive.velocities, times_s)
            searched = dataclasses.replace(drive, yaws=yaws, turns=TURNS)
            expected = searched.predict(len(steps) - 1, steps[-2].rates)
            found = self._tracker.register(scan, expected)
        unknown = drive.velocities is None or found.segment > 0
        pull = np.nan if unknown else _pull(steps[-2].found, found, expected)
        return dataclasses.replace(new, found=found, pull=pull, sign=sign)

    def _velocities(self, steps: list[Step], sign: int) -> SensorVelocities | None:
        """Return the velocities of scans. None if one of the last two has none; of a rig, if all have none."""
        rig, measured = _rig_of(steps), np.array([step.velocity is not None for step in steps])
        if not (measured[-2:].all() if rig is None else measured.any()):
            return None
        each = [
            (np.zeros(3), np.eye(3)) if one is None else (one.velocity_mps, _covariance(one))
            for one in (step.velocity for step in steps)
        ]
        mean, covariance, _ = upright(*(np.array(columns) for columns in zip(*each, strict=True)))
        own = self._of_radar(steps[-1])
        known = [(one.time_s, one.velocity.velocity_mps) for one in own if one.velocity]
        change = MOVES.change
        if len(known) > 1:
            times_s, speeds = (np.array(columns) for columns in zip(*known, strict=True))
            change = np.square(np.diff(speeds, axis=0)).sum(axis=0) / (times_s[-1] - times_s[0])
        found = np.ones(len(steps), bool)
        velocities = _signed(SensorVelocities(mean, covariance, change + LEAST_MPS**2, found), sign)
        if rig is None:
            return velocities
        parts = [rows[measured[rows]] for rows in rig.scans_of_radars().values()]
        radars = [(rows, velocities.select(rows)) for rows in parts if len(rows)]
        return BodyVelocities.of_radars(rig, radars, np.array([step.time_s for step in steps]))

    def _start(self, log: ScanLog, new: Step, sign: int) -> list[Step] | None:
        """Re-estimate the first scans by odometry, if due. None if the next scan can be registered with the previous ones."""
        steps = [*self._steps, new]
        fixed = [i for i, step in enumerate(steps) if step.given or step.scan_id in log.sealed]
        first = max(fixed, default=0)
        moving = [i for i in range(first, len(steps)) if steps[i].moves]
        most = _START * self.num_radars
        first = max([first, len(steps) - most, *(i - 1 for i in moving[:1])])
        count, alone = len(moving), len(self._of_radar(new)) == 1  # its only scan tells no sign
        sign_open = sign == 0 and new.velocity is not None and not alone
        due = count & (count - 1) == 0 and (sign_open or (first < _KNOWN_STEPS and count <= most))
        due = due or (sign_open and (count == most or (count < most and self.num_radars == 1)))
        if not new.moves or not due:
            return None
        sign, tracked = self._followed(steps[first:], sign)
        if first >= _KNOWN_STEPS and first == len(steps) - 2:  # only the sign was missing
            return [self._next(new, sign)]
        frame = steps[first].found.pose
        both = np.kron(np.eye(2), frame[:3, :3])
        again = []
        for step, found in zip(steps[first + 1 :], tracked[1:], strict=True):
            covariance = both @ found.covariance @ both.T
            placed = dataclasses.replace(found, pose=frame @ found.pose, covariance=covariance)
            again.append(dataclasses.replace(step, found=placed, sign=sign))
        return again

    def _followed(self, steps: list[Step], sign: int) -> tuple[int, list[Tracked]]:
        """Return the sign of the Doppler, 0 if not significant, and the scans tracked by odometry, in the frame of the first."""
        rig, times_s = _rig_of(steps), np.array([step.time_s for step in steps])
        drive = Drive([step.scan for step in steps], times_s, None, rig=rig)
        radars = [np.arange(len(steps))] if rig is None else [*rig.scans_of_radars().values()]
        measured, gains, yaws = [], [], np.full((2, len(steps) - 1), np.nan)
        for rows in radars:
            own = [steps[i] for i in rows]
            speeds = [step.logged.doppler_mps for step in own if step.logged.doppler_mps is not None]
            if len(speeds) == len(own) > 1:
                with contextlib.suppress(NoVelocityError):
                    found = SensorVelocities.of([step.logged.points for step in own], speeds, times_s[rows])
                    measured.append((rows, found))
                    if rig is None or sign == 0:
                        seen = [step.sensor_scan for step in own]
                        gain, turned = sign_significance(seen, found.scaled(sign or 1.0), times_s[rows])
                        gains.append(gain)
                        yaws = turned if rig is None else yaws
        if measured:
            evidence = sum(gains) / np.sqrt(max(len(gains), 1))
            # Until the sign is clear, the scans are placed by the likelier one, and re-estimated. Where returns do not show
            # it, as in a tunnel, that of odometry is assumed: each comparison with the returns then states the doubt.
            if abs(evidence) <= CLEAR and len(steps) == _START * self.num_radars:
                evidence = np.inf
            likelier = sign or int(np.sign(evidence))
            yaws = yaws[::-1] if evidence < 0 else yaws
            sign = sign or (likelier if abs(evidence) > CLEAR else 0)
            # By the prior alone, a vehicle that turns by 13 degrees between the first scans would be lost.
            known = yaws if turns_fast(yaws[0]) else None
            signed = [(rows, _signed(found, likelier)) for rows, found in measured]
            velocities = signed[0][1] if rig is None else BodyVelocities.of_radars(rig, signed, times_s)
            drive = dataclasses.replace(drive, velocities=velocities, yaws=known)
        return sign, track_drive(drive, self.config)[1]


def _rig_of(steps: list[Step]) -> Rig | None:
    known = [step.logged.radar for step in steps if step.logged.radar is not None]
    return Rig.of([radar.label for radar in known], dict(known)) if known else None


def _compare(
    steps: list[Step], config: FitConfig
) -> Iterator[tuple[Floats, SensorVelocities, Consistency] | None]:
    """Compare the Doppler of scans of a radar with their returns; yield None after each step, and times, velocities, and result."""
    times_s, scans = np.array([step.time_s for step in steps]), [step.sensor_scan for step in steps]
    known = ((step.logged.points, step.logged.doppler_mps, step.velocity) for step in steps)
    points, speeds, each = zip(*known, strict=True)
    velocities = SensorVelocities.of(points, speeds, times_s, each).scaled(steps[-1].sign or 1.0)
    fast = turns_fast(np.array([step.found.turn[2] for step in steps[1:]]))
    yaws = sign_significance(scans, velocities, times_s)[1] if fast else None
    inertial = Inertial()
    if (radar := steps[-1].logged.radar) is not None:
        # A narrow radar hardly shows its turns, but all radars show those of the body.
        turns = step_vectors(np.stack([step.found.pose @ radar.T_body_sensor for step in steps]))[:, 3:]
        unbiased = MotionRate(np.zeros(3), FIRST_BIAS_RAD_S**2 * np.eye(3))
        inertial = Inertial(Gyroscope(turns, np.diff(times_s), unbiased))
    yield None
    drive = Drive(scans, times_s, velocities, yaws=yaws, inertial=inertial)
    for tested in Consistency.in_steps(drive, config):
        yield None if tested is None else (times_s, velocities, tested)


def _pull(before: Tracked, found: Tracked, expected: PredictedStep) -> float:
    """Return the relative difference, along the predicted step, of the motion by returns alone."""
    R, way_m = before.pose[:3, :3], expected.pose(found.turn)[:3, 3]
    length_m = float(np.linalg.norm(way_m))
    along = way_m / max(length_m, 1e-9)
    prior = along @ expected.covariance(found.turn)[:3, :3] @ along
    left = along @ R.T @ found.covariance[:3, :3] @ R @ along
    moved_m = along @ (R.T @ (found.pose[:3, 3] - before.pose[:3, 3]) - way_m)
    # The returns move the predicted step by this share of its error.
    gain = 1 - float(left) / max(float(prior), 1e-12)
    return float(moved_m / (gain * length_m)) if gain > _LEAST_GAIN and length_m > _LEAST_STEP_M else np.nan


def _covariance(velocity: SensorVelocity) -> Floats:
    """Return the covariance (3, 3), m²/s², of a velocity including systematic errors."""
    return velocity.covariance + LEAST_MPS**2 * np.eye(3)


def _now(step: Step, log: ScanLog) -> Step | None:
    """Return a scan as it is in the map. None if it was removed. A sealed one cannot have changed."""
    if step.scan_id in log.sealed:
        return step
    placed = log.placed(step.scan_id)
    if placed is None or placed.time_s != step.logged.time_s:  # another scan of this id
        return None
    if (placed.pose == step.found.pose).all():
        return step
    found = dataclasses.replace(step.found, pose=placed.pose, covariance=_GIVEN)
    return dataclasses.replace(step, found=found, given=True)


def _signed(velocities: SensorVelocities, sign: int) -> SensorVelocities:
    """Apply the sign of the Doppler. For an unknown one, 0, the mean is zero, and the speed is its deviation."""
    return dataclasses.replace(velocities.scaled(1.0, float(sign == 0)), mean_mps=sign * velocities.mean_mps)
