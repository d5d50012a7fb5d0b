"""Build scans with poses from the files of a recording.

Each format yields :class:`RawScan`; :func:`posed` finds the pose of each, reads its columns, and assigns their
roles. Unusable data are counted in the notes, and never abort the reading. Folders hold one scan per file.
"""

import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime, timezone
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from radarsdf.arrays import Floats
from radarsdf.checks import check
from radarsdf.io import poses as pose_files
from radarsdf.io.clouds import CLOUD_SUFFIXES, TEXT_SUFFIXES, UNNAMED, check_kitti, read_columns, read_points
from radarsdf.io.columns import Fields, in_seconds, read_numbers, read_table, scaled, unit_since_1970
from radarsdf.io.files import reading
from radarsdf.io.poses import POSE_FILES, NumberedPoses, Poses, StampedPoses, Trajectory, TransformChain
from radarsdf.rig import Label
from radarsdf.scans import Columns, Notes, Scan, Scans

BASE_T_RADAR = "base_T_radar.txt"
"""A file next to scans: 4 x 4, the pose of the radar in the frame of the poses."""

# One time per line and scan, s; of three columns, the last two are seconds and nanoseconds.
TIME_FILES = ("times.txt", "timestamps.txt", "timestamp.txt", "timestamp_radar.txt")
SCAN_FOLDERS = ("radar", "scans", "points", "pointclouds", "clouds", "pcd", "PCD", "velodyne", "data")
_NOT_SCANS = {*POSE_FILES, *TIME_FILES, "calib.txt", BASE_T_RADAR.lower(), "readme.txt", "license.txt"}
_TRUTH_STEM = "lidar"  # lidar.pcd or lidar.ply next to the scans is their ground truth

FindPoses = Callable[[str], StampedPoses | Floats | None]

# Arguments of :func:`radarsdf.io.read` that only bags, and only scans with poses, can use.
OF_BAGS = ("topic", "pose_topic", "imu_topic", "world_frame", "stamps")
OF_POSES = ("extrinsic", "pose_topic", "world_frame")

# At the end of a name: a time of day, with or without its date; s and their fraction; s, ms, µs or ns since 1970.
_DATE = re.compile(
    r"(?<!\d)(?:((?:19|20)\d\d)([-_.]?)(\d\d)\2(\d\d)[-_.T ]*)?"
    r"(\d\d)([-_.:]?)(\d\d)\6(\d\d)(?:([-_.,])(\d{1,9})|(\d{3}))?$"
)
_SECONDS = re.compile(r"(?:(\d+)(\.)|(\d{9,10})([-_]))(\d{1,9})$")
_INTEGER = re.compile(r"(?<!\d)[1-9]\d{9,}$")
_LEAST_STEP_S = 1e-3  # no radar scans as fast: numbers that are nearer to each other are indices
_DAY_S = 86_400


@dataclass(frozen=True, eq=False)
class Request:
    """Arguments of :func:`radarsdf.io.read`."""

    poses: Any = None
    extrinsic: Floats | None = None
    topic: tuple[str, ...] = ()  # empty: the only candidate
    pose_topic: str | None = None
    imu_topic: str | None = None
    R_sensor_imu: Floats | None = None
    fields: Mapping[str, Any] | None = None
    columns: int | Sequence[str] | None = None
    max_gap_s: float = pose_files.MAX_GAP_S
    stamps: str | None = None
    world_frame: str | None = None
    notes: Notes = field(default_factory=Notes)

    def refuse(self, why: str, *names: str) -> None:
        """Raise a ValueError for arguments that would have no effect."""
        given = {name: getattr(self, name) for name in names}
        useless = ", ".join(name for name, value in given.items() if value is not None and np.size(value))
        check(not useless, f"{why}: {useless} would have no effect; leave it out")


@dataclass(frozen=True, eq=False)
class RawScan:
    """A scan of a file whose points are not yet read."""

    read: Callable[[], Columns]
    time_s: float | None
    name: str  # shown in messages
    frame: str = ""  # header frame; only in bags
    topic: str = ""  # topic name; only in bags
    number: int | None = None  # index of its pose. None: the number of scans before it
    sensor: Label | None = None  # label of its radar, if there are several


def posed(raw_scans: Callable[[], Iterable[RawScan]], find: FindPoses, request: Request) -> Iterator[Scan]:
    """Yield scans with poses and at least one return, in the order of the files, for :meth:`Scans.of_source`."""
    notes = request.notes
    layouts: dict[Any, Fields] = {}
    num_posed, unposed = 0, ""
    for number, raw in enumerate(raw_scans()):
        known = find(raw.frame)
        if known is None:
            notes.count(f"scans left out: no poses lead to their frame, {raw.frame or '(unnamed)'}")
            continue
        if isinstance(known, np.ndarray):
            own = known[number if raw.number is None else raw.number :][:1]
            if not np.isfinite(own).all() or not len(own):  # reported when the poses were read
                continue
            T_world_sensor = own[0]
        else:
            found = known.pose_at(np.nan if raw.time_s is None else raw.time_s, request.max_gap_s)
            if found is None:
                notes.count(f"scans left out: no poses within {request.max_gap_s} s of each other")
                unposed = unposed or f"first scan at {raw.time_s} s, poses from {known.span()}"
                continue
            T_world_sensor = found
        num_posed += 1
        if scan := _scan(raw, T_world_sensor, layouts, request):
            yield replace(scan, sensor=raw.sensor)
    what = f"no scan has a pose: {unposed}, gaps up to {request.max_gap_s} s: do both use one clock?"
    check(num_posed or not unposed, f"{notes.about}: {what}")


def _scan(raw: RawScan, T_world_sensor: Floats, layouts: dict[Any, Fields], request: Request) -> Scan | None:
    """Read a scan; None, and counted, if it is damaged or empty. `layouts`: roles of the columns by topic and names so far."""
    notes, scan = request.notes, None
    try:
        columns = raw.read()
        layout = (raw.topic, *columns)
        if any(map(len, columns.values())):
            if layout not in layouts:
                fields = Fields.of(list(columns), request.fields).with_unit(columns, notes)
                if not request.fields and raw.topic not in {topic for topic, *_ in layouts}:
                    fields.note_use(columns, notes)
                layouts[layout] = fields
            scan = layouts[layout].scan(columns, T_world_sensor, raw.time_s, notes)
    except ValueError as error:
        known = "" if raw.name in str(error) else f"{raw.name}: "
        notes.count("scans left out: they cannot be read", example=f"{known}{error}")
        return None
    if not scan:
        notes.count("scans left out: they hold no returns")
    return scan or None


def scan_poses(
    poses: Poses, count: int, times_s: Sequence[float] | None, T_base_sensor: Floats | None, request: Request
) -> tuple[StampedPoses | Floats, Sequence[float] | None]:
    """Return the poses T_world_sensor of `count` scans, and their times, s, if known."""
    about = request.notes.about
    if isinstance(poses, NumberedPoses):
        poses = _by_number(poses, range(count), request.notes)
    if isinstance(poses, np.ndarray):
        if request.max_gap_s != pose_files.MAX_GAP_S:
            request.notes.add("max_gap_s has no effect: the poses have no times")
        what = "give as many, or poses with time stamps for scans with time stamps"
        check(len(poses) == count, f"{about}: there are {count} scans but {len(poses)} poses: {what}")
    elif times_s is None:
        if not isinstance(poses, Trajectory) or len(poses.times_s) != count:
            msg = f"{about}: {count} scans without times cannot be matched to the poses from {poses.span()}: give as many, or times.txt"
            raise ValueError(msg)
        request.notes.add(f"the scans have no time stamps: matched to the {count} poses in their order")
        times_s = poses.times_s.tolist()
        poses = poses.poses(poses.times_s)
    return poses if T_base_sensor is None else poses_on(poses, T_base_sensor), times_s


def poses_on(poses: StampedPoses | Floats, T_base_sensor: Floats) -> StampedPoses | Floats:
    """Return T_world_sensor from poses T_world_base."""
    return poses @ T_base_sensor if isinstance(poses, np.ndarray) else TransformChain((poses, T_base_sensor))


def read_files(
    files: list[Path], folder: Path, request: Request, truth: Callable[[], Floats | None] = lambda: None
) -> Scans:
    """Read scans from files, one each, with the poses of the request or those found in or near the folder."""
    check(files, f"{folder} holds no scans: neither bags nor files that end in {', '.join(CLOUD_SUFFIXES)}")
    notes, poses, T_base_sensor = request.notes, request.poses, request.extrinsic
    if poses is None:
        poses = first_file((folder, *files[0].parents[:2]), POSE_FILES)
        if poses is None:
            what = files[0] if len(files) == 1 else folder
            msg = f"{what} has no poses: give a file of poses (TUM, KITTI, 4 x 4), or an array (F, 4, 4); {pose_files.FIND_POSES}"
            raise pose_files.NoPoses(msg)
        if poses.parent != folder:
            notes.add(f"poses: of {poses}")
    known = pose_files.poses_of(poses, notes)
    files, times_s, known = _by_time(files, known, notes)
    if T_base_sensor is None:
        T_base_sensor = pose_files.read_transform(folder / BASE_T_RADAR)
    columns = request.columns
    if files[0].suffix.lower() not in UNNAMED:
        request.refuse(f"{files[0]} has names of columns", "columns")
    if columns is None and (raw := [path for path in files if path.suffix.lower() == ".bin"]):
        with reading(notes.about, "points of KITTI"):
            check_kitti(raw)
        columns = 4
    matched, known_s = scan_poses(known, len(files), times_s, T_base_sensor, request)
    stamps: Sequence[float | None] = known_s or [None] * len(files)
    reads = zip(files, stamps, strict=True)
    raw_scans = [RawScan(partial(read_columns, path, columns), time_s, str(path)) for path, time_s in reads]
    source = partial(posed, lambda: raw_scans, lambda _: matched, request)
    return Scans.of_source(source, notes, truth)


def cloud_files(folder: Path, notes: Notes) -> list[Path]:
    """Files of scans in a folder or its subfolder of `SCAN_FOLDERS`, in natural order: the longest series of one suffix.

    Notes and labels next to them are left out: text named as a scan, and single files whose names are unlike the others.
    """
    found: list[tuple[Any, ...]] = []
    for place, inner in enumerate((folder, *(folder / name for name in SCAN_FOLDERS))):
        kinds: dict[str, list[Path]] = {}
        for path in inner.iterdir() if inner.is_dir() else ():
            other = path.name.lower() in _NOT_SCANS or path.stem == _TRUTH_STEM or path.name.startswith(".")
            if path.suffix.lower() in CLOUD_SUFFIXES and not other and path.is_file():
                kinds.setdefault(path.suffix.lower(), []).append(path)
        clouds = {p.stem for suffix in kinds.keys() - set(TEXT_SUFFIXES) for p in kinds[suffix]}
        for suffix, paths in kinds.items():
            is_text = suffix in TEXT_SUFFIXES
            kept = [path for path in paths if not (is_text and path.stem in clouds)]
            length = max(Counter(map(_words, kept)).values(), default=0)
            found.append((not is_text or length > 1, -place, length, not is_text, kept))
    *_, length, _, files = max(found, key=itemgetter(0, 1, 2, 3), default=(0, None, []))
    words = Counter(map(_words, files))
    odd = [path for path in files if 2 * length > len(files) > 2 and words[_words(path)] == 1]
    if odd:
        notes.add(f"{len(odd)} files left out: their names are unlike those of scans; the first: {min(odd)}")
    return sorted(set(files) - set(odd), key=natural)


def first_file(folders: Iterable[Path], names: Sequence[str]) -> Path | None:
    """Return the first of these files that exists, folder by folder."""
    return next((folder / name for folder in folders for name in names if (folder / name).is_file()), None)


def _words(path: Path) -> str:
    """Letters of the name of a file: those of scans differ only in their digits."""
    return re.sub(r"[\d\W_]+", "", path.stem)


def natural(path: Path) -> tuple[Any, ...]:
    """Sort key for natural order: scan_9 before scan_10."""
    parts = re.split(r"(\d+)", path.name)
    return tuple((int(part), part) if i % 2 else (0, part) for i, part in enumerate(parts))


def lidar_map(folder: Path) -> Floats | None:
    """Points (M, 3), world frame, m, of ``lidar.pcd`` or ``lidar.ply``; None if there is neither."""
    path = first_file([folder], (f"{_TRUTH_STEM}.pcd", f"{_TRUTH_STEM}.ply"))
    return None if path is None else read_points(path)


def _by_time(files: list[Path], poses: Poses, notes: Notes) -> tuple[list[Path], list[float] | None, Poses]:
    # Poses without times are matched by index, in the order of the times in the names of files, or of a file of times.
    times = times_in([path.stem for path in files], notes)
    listed = None
    if times is None:
        if isinstance(poses, NumberedPoses):
            # Numbers of scans: the last ones in the names of their files that all differ, or else counted from 0.
            groups = zip(*(map(int, re.findall(r"\d+", path.stem)[::-1]) for path in files), strict=False)
            numbers = next((group for group in groups if len(set(group)) == len(files)), range(len(files)))
            poses = _by_number(poses, numbers, notes)
        listed = first_file(files[0].parents[:2], TIME_FILES)
        if listed is None:
            return files, None, poses
        times = _listed_times(listed, notes)
        check(len(times) == len(files), f"{listed} has {len(times)} times for {len(files)} scans")
    order = np.argsort(times, kind="stable")
    if listed is not None and isinstance(poses, np.ndarray) and len(poses) == len(files):
        poses = poses[order]
    return [files[i] for i in order], [times[i] for i in order], poses


def _listed_times(path: Path, notes: Notes) -> list[float]:
    """Times, s, of a file with one line per scan, in the unit of their column's name, if it has one."""
    table = read_numbers(path)
    heads, _ = read_table(path)
    names = next((head for head in reversed(heads) if len(head) == table.shape[1]), [""])
    with reading(path, "a list of times"):
        times = scaled(table[:, -1], names[-1], "time")
    times = table[:, 1] + 1e-9 * table[:, 2] if table.shape[1] == 3 else times
    return [float(time_s) for time_s in in_seconds(times, path.name, notes)]


def _by_number(poses: NumberedPoses, numbers: Sequence[int], notes: Notes) -> Floats:
    """T_world_sensor (F, 4, 4) of the scans with these numbers; NaN for those without a pose, which are counted."""
    if all(np.ptp(of) + 1 == len(numbers) == len(of) for of in (numbers, poses.numbers)):
        numbers = sorted(poses.numbers)  # one of them counts from 0, the other one from 1
    rows = dict(zip(*poses, strict=True))
    missing = len(set(numbers) - set(rows))
    check(missing < len(numbers), f"{notes.about}: no scan has a number of the poses, {poses.numbers[:3]}, …")
    if missing:
        notes.add(f"{missing} scans left out: there is no pose of their number")
    return np.array([rows.get(number, np.full((4, 4), np.nan)) for number in numbers])


def times_in(stems: list[str], notes: Notes) -> list[float] | None:
    """Return the times, s, at the ends of names, and note how they were read; None if names have none, or indices.

    Fractions of varying length are decimals, or ms, µs or ns without leading zeros: of the readings that all names allow,
    the one with the most even steps between the scans is used.
    """
    parts = [part for stem in stems if (part := _time_parts(re.sub(r"\D+$", "", stem)))]
    kinds = {part[0] for part in parts}
    if len(parts) < len(stems) or len(kinds) != 1:
        return None
    whole_s, fractions = np.array([part[1] for part in parts]), [part[3] for part in parts]
    if kinds == {"dates"} and not any(fractions) and (whole_s % _DAY_S < 60).all():
        return None  # 20240501_000007 is the seventh scan of a day, not one of its first minute
    decimal_point = all(part[2] in (".", ",") for part in parts if part[3])
    possible: list[tuple[float, Any, str]] = []  # deviation of the steps from their median, times, text
    for how, fractions_s in _readings(fractions, decimal_point).items():
        times_s = whole_s + fractions_s
        steps_s = np.diff(np.sort(times_s))
        median_s = float(np.median(steps_s)) if len(steps_s) else np.inf
        if median_s > _LEAST_STEP_S * (1 + 1e-4):  # times since 1970 are rounded to 0.2 µs
            deviations = np.abs(steps_s / median_s - 1)
            text = f"{' '.join(kinds)}{how}" + (f", {median_s:.4g} s apart" if len(steps_s) else "")
            if odd := int((deviations > 0.5).sum()):
                text += f" but for {odd} of {len(steps_s)} steps"
            possible.append((float(np.minimum(deviations, 1).sum()), times_s, text))
    if not possible or 10 * len({part[1:] for part in parts}) < 9 * len(stems):  # rounded too far
        return None
    least, times_s, text = min(possible, key=itemgetter(0))
    for cost, others_s, other in possible:
        # A step in a wrong place costs up to 1.
        if cost - least < 1 and (np.abs(others_s - times_s) > _LEAST_STEP_S).any():
            text += f"; undecided: {other} would be as even; rename the files"
    notes.add(f"times in the names of the files: {text}")
    return [float(time_s) for time_s in times_s]


def _time_parts(stem: str) -> tuple[str, float, str, str] | None:
    """Kind and whole seconds of the time at the end of a name, and the separator and digits of its fraction."""
    if (found := _DATE.search(stem)) and (found[1] or found[6]):
        month, day, hour, minute, second = (int(found[i] or 1) for i in (3, 4, 5, 7, 8))
        try:
            date = datetime(int(found[1] or 1970), month, day, hour, minute, second, tzinfo=timezone.utc)
        except ValueError:  # the 31st of February, or minute 61: an index
            return None
        return "dates", date.timestamp(), found[9] or "", found[10] or found[11] or ""
    if found := _SECONDS.search(stem):
        return "seconds", float(found[1] or found[3]), found[2] or found[4], found[5]
    if found := _INTEGER.search(stem):
        return "integers", int(found[0]) * unit_since_1970(int(found[0]))[1], "", ""
    return None


def _readings(fractions: list[str], decimal_point: bool) -> dict[str, Floats]:
    """Possible values of the digits of fractions, s, by what they are."""
    digits = [f for f in fractions if f]
    lengths = {len(f) for f in digits} or {0}
    longest, ragged = max(lengths), len(lengths) > 1
    # Ragged decimals have lost the zeros at their ends, ragged integers those at their beginnings.
    ends, begins = (any(f[i] == "0" for f in digits if len(f) > 1) for i in (-1, 0))
    values: dict[str, Floats] = {}
    if (not ends and decimal_point) if ragged else (decimal_point or longest > 2 or not longest):
        values[" with decimals" if longest else ""] = np.array([float(f"0.{f}0") for f in fractions])
    if not begins and (ragged or longest > 7):
        for unit, width in (("ns", 9), ("µs", 6), ("ms", 3)):
            if longest <= width:
                numbers = np.array([int(f or 0) for f in fractions])
                values[f" and {unit} without leading zeros"] = numbers / 10**width
    return values
