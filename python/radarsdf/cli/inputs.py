"""Inputs of a command: scans, a configuration, a map."""

import dataclasses
from argparse import Namespace
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Any

from radarsdf.checks import check_pose
from radarsdf.cli import warn
from radarsdf.cli.options import GROUPS, LIMITS, refuse_if
from radarsdf.evaluation import holdout
from radarsdf.extras import require
from radarsdf.io.columns import read_numbers
from radarsdf.io.files import checked_suffix
from radarsdf.io.poses import MAX_GAP_S, UNPOSED, NoPoses, StampedPoses
from radarsdf.io.read import read
from radarsdf.io.recordings import Request
from radarsdf.map.map import Map
from radarsdf.scans import Notes, Scans
from radarsdf.tiles.tiled_map import TiledMap, load

MAP_SUFFIX = ".safetensors"


def is_map(path: Path) -> bool:
    """Whether a path looks like a map and not like scans or a mesh."""
    return path.is_dir() or path.suffix == MAP_SUFFIX


def load_map(path: Path) -> Map:
    radar_map = load(path)
    if isinstance(radar_map, TiledMap) and (missing := radar_map.missing):
        tiles = f"{len(missing)} of {len(radar_map.plan.tiles)} tiles"
        warn(f"warning: {path} lacks {tiles}: radarsdf tiles status {path} lists the reasons")
    return radar_map


def read_scans(given: Namespace, poses: StampedPoses | None = None) -> Scans:
    """Read the scans, with `poses` instead of theirs if passed. Assumptions and omissions are logged on standard error."""
    columns = given.columns
    names = ("topic", "pose_topic", "imu_topic")
    rotation = given.imu_rotation and read_numbers(given.imu_rotation, 3)
    return read(
        given.scans,
        given.poses if poses is None else poses,
        R_sensor_imu=rotation,
        columns=int(columns) if columns and columns.isdecimal() else columns and columns.split(","),
        **_roles_and_frames(given),
        **{name: getattr(given, name) for name in names},
    )


def _roles_and_frames(given: Namespace) -> dict[str, Any]:
    """Arguments of :func:`radarsdf.io.read` that topics of running nodes need, too."""
    fields = [text.partition("=") for text in given.field or ()]
    for role, _, name in fields:
        refuse_if(not (role and name), f"--field takes ROLE=NAME, not {role!r:.50}")
    return {
        "extrinsic": given.extrinsic and read_numbers(given.extrinsic, 4),
        "fields": {role: name for role, _, name in fields} or None,
        "max_gap_s": given.max_gap,
        "world_frame": given.world_frame,
        "stamps": given.stamps,
    }


def request_of_topics(given: Namespace) -> Request | None:
    """Check the options of running topics; None if there are none."""
    one = bool(given.ros2) != (given.scans is not None)
    refuse_if(not one, "give either a recording or, as --ros2 TOPIC, topics of running nodes")
    if given.scans:
        refuse_if(given.ros2_odom or given.ros2_domain, "--ros2-odom and --ros2-domain need --ros2")
        return None
    of_files = "--topic", "--pose-topic", "--imu-topic", "--imu-rotation", "--columns"
    _refuse_useless(given, of_files, "--ros2 reads no file")
    refuse_if(given.rate != 1, f"--ros2 maps scans as they come: --rate {given.rate} would have no effect")
    wrong = [topic for topic in (*given.ros2, given.ros2_odom or "/") if not topic.startswith("/")]
    refuse_if(wrong, f"the name of a topic begins with /, unlike {wrong}")
    useless = given.find and given.ros2_odom
    refuse_if(useless, f"with --find, --ros2-odom {given.ros2_odom} would have no effect")
    refuse_if(not 0 <= given.ros2_domain <= 230, f"--ros2-domain must be 0 to 230, not {given.ros2_domain}")
    arguments = _roles_and_frames(given)
    if given.extrinsic:
        arguments["extrinsic"] = check_pose(arguments["extrinsic"], "extrinsic T_base_sensor")
    return Request(**arguments, pose_topic=given.ros2_odom, notes=Notes("the topics"))


def scans_or_unposed(given: Namespace, *, find: bool = False) -> tuple[Scans, bool]:
    """Read scans; also return whether their poses must be estimated: with `find`, or if there are none."""
    if not find:
        try:
            return read_scans(given), False
        except NoPoses:
            warn(f"note: {given.scans} has no poses: they are estimated from the radar alone")
    return read_scans(given, UNPOSED), True


def scans_if(wanted: object, given: Namespace) -> Scans | None:
    """Read the scans, or refuse the options for reading them if none are `wanted`."""
    if wanted:
        return read_scans(given)
    _refuse_useless(given, GROUPS["reading"].split()[1:], "no scans are read")
    return None


def _refuse_useless(given: Namespace, options: Iterable[str], why: str) -> None:
    for option in options:
        value = vars(given)[option.lstrip("-").replace("-", "_")]
        refuse_if(value not in (None, MAX_GAP_S), f"{why}: {option} {value} would have no effect")


def without_intensities(scans: Scans) -> Scans:
    without = partial(dataclasses.replace, intensities=None)
    return Scans.of_source(lambda: map(without, scans), Notes(), mountings=lambda: scans.T_body_sensor)


def split(scans: Scans, every: int | None) -> tuple[Scans, Scans | None]:
    """Split scans into those to fit and those that ``--holdout`` leaves out."""
    if every is None:
        return scans, None
    train, test = holdout(len(scans.points), every)
    return scans.select(train), scans.select(test)


def inputs_of(given: Namespace) -> list[Path | None]:
    """The input files and folders, which no output may overwrite."""
    return [vars(given).get("map"), given.scans, given.poses, given.extrinsic, given.imu_rotation]


def check_picture(path: Path | None) -> None:
    """Raise, before the work, unless a picture, if any, can be drawn."""
    checked_suffix(path, (".png",), "pictures")
    if path is not None:
        require("matplotlib", what="pictures need")


def mesh_limits(given: Namespace) -> dict[str, Any]:
    return {name: getattr(given, name) for name in LIMITS}
