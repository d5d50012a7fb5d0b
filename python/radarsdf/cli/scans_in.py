# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Scans on the command line: the same arguments for every command that reads some."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from radarsdf.io.poses.trajectory import StampedPoses
    from radarsdf.io.scans import Scans


SCANS = ".npz of radarsdf, a folder of point clouds, a ROS bag, or the folder of a data set"


def add_scans(parser: argparse.ArgumentParser, *, also: str = "", required: bool = True) -> None:
    """Add the arguments that :func:`scans_of` reads; `also` says what else the command takes for scans.

    If they are not `required`, ``options.scans`` may be None.
    """
    parser.add_argument("scans", type=Path, nargs=None if required else "?", help=f"the scans: {SCANS}{also}")
    add_poses(parser)


def add_poses(parser: argparse.ArgumentParser) -> None:
    """Add all of them but the scans themselves."""
    parser.add_argument(
        "poses",
        type=Path,
        nargs="?",
        help="their poses, where the scans have none: a file in TUM or KITTI format, or of 4 x 4 matrices",
    )
    add_scan_options(parser)


def add_scan_options(parser: argparse.ArgumentParser) -> None:
    """Add all of them but the scans and the poses."""
    parser.add_argument(
        "--extrinsic",
        type=Path,
        metavar="FILE",
        help="4 x 4 matrix from the sensor's frame to that of the poses, T_base_sensor, if they differ",
    )
    parser.add_argument(
        "--topic", action="append", metavar="NAME", help="in a bag: the topic of the scans; may be repeated"
    )
    parser.add_argument("--pose-topic", metavar="NAME", help="in a bag: the topic of the poses")
    parser.add_argument(
        "--imu-topic",
        metavar="NAME",
        help="in a bag: the topic of the inertial measurements, for poses that are found",
    )
    parser.add_argument(
        "--imu-rotation",
        type=Path,
        metavar="FILE",
        help="3 x 3 matrix from the axes of the IMU to those of the radar, R_sensor_imu; default: of the bag, or found",
    )
    parser.add_argument(
        "--field",
        action="append",
        default=[],
        metavar="ROLE=NAME",
        help="the field of the file for x, y, z, intensity or doppler, such as intensity=Power; may be repeated",
    )
    parser.add_argument(
        "--columns",
        type=_columns,
        metavar="N",
        help="of files without names: how many numbers a return has, or their names, such as x,y,z,intensity,doppler",
    )
    parser.add_argument(
        "--max-gap",
        type=float,
        metavar="S",
        help="longest time between two poses over which poses are interpolated, s; default: 0.5",
    )
    parser.add_argument("--world-frame", metavar="NAME", help="in a bag with TF: the frame of the world")
    parser.add_argument(
        "--stamps",
        choices=("header", "record"),
        help="in a bag: the time of a scan; default: of its header, unless stamps are zero or stand still",
    )


def inputs_of(options: argparse.Namespace) -> list[Path]:
    """The files and folders that :func:`scans_of` reads."""
    return [
        path
        for path in (options.scans, options.poses, options.extrinsic, options.imu_rotation)
        if path is not None
    ]


def scans_of(options: argparse.Namespace, poses: StampedPoses | None = None) -> Scans:
    """The scans of the command, with `poses` in place of theirs. What was assumed or left out is said on standard error."""
    from radarsdf.io.read import read

    given: Any = options.poses if poses is None else poses
    return read(
        options.scans,
        given,
        extrinsic=_matrix(
            options.extrinsic,
            4,
            "extrinsic: that is a 4 x 4 matrix T_base_sensor, four lines of four numbers",
        ),
        topic=options.topic,
        pose_topic=options.pose_topic,
        imu_topic=options.imu_topic,
        R_sensor_imu=_matrix(
            options.imu_rotation,
            3,
            "rotation: that is a 3 x 3 matrix R_sensor_imu, three lines of three numbers",
        ),
        fields=dict(_field(text) for text in options.field) or None,
        columns=options.columns,
        world_frame=options.world_frame,
        stamps=options.stamps,
        **({} if options.max_gap is None else {"max_gap_s": options.max_gap}),
    )


def _matrix(path: Path | None, size: int, what: str) -> Any:
    """What a file holds, if there is one. `what` it should be is said if it is no square of this size."""
    from radarsdf.io.text import read_numbers

    try:
        return None if path is None else read_numbers(path, size)
    except ValueError as error:
        msg = f"{path} is no {what}"
        raise ValueError(msg) from error


def _columns(text: str) -> int | list[str]:
    """A number of columns, or their names."""
    return int(text) if text.isdecimal() else text.split(",")


def _field(text: str) -> tuple[str, str]:
    role, equals, name = text.partition("=")
    if not equals or not role or not name:
        msg = f"--field takes ROLE=NAME, not {text!r:.50}"
        raise ValueError(msg)
    return role, name


def words_of(options: argparse.Namespace) -> list[str]:
    """The same arguments, as one would type them again."""
    words = [options.scans, options.poses]
    for name in ("extrinsic", "pose_topic", "imu_topic", "imu_rotation"):
        value = getattr(options, name)
        words += [f"--{name.replace('_', '-')}", value] if value is not None else []
    for option, texts in (("--topic", options.topic or []), ("--field", options.field)):
        words += [word for text in texts for word in (option, text)]
    for name in ("columns", "max_gap", "world_frame", "stamps"):
        value = getattr(options, name)
        text = ",".join(value) if isinstance(value, list) else value
        words += [] if value is None else [f"--{name.replace('_', '-')}", text]
    return [str(word) for word in words if word is not None]
