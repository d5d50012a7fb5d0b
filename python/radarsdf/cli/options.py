# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Groups of options that several commands share. The lines of a docstring are the help of its fields."""

from __future__ import annotations

import ast
import dataclasses
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from radarsdf.cli.app import refuse_if

if TYPE_CHECKING:
    from radarsdf import FitConfig
    from radarsdf.io.poses import StampedPoses
    from radarsdf.io.scans import Scans

MAP_SUFFIX = ".safetensors"
"""By which the file of a map is known from a mesh."""

Box = tuple[float, float, float, float, float, float] | None
"""The lower and the upper corner."""


def is_map(path: Path) -> bool:
    """Whether a path looks like a map and not like scans or a mesh."""
    return path.is_dir() or path.suffix == MAP_SUFFIX


def corners_of(box: Box) -> list[list[float]] | None:
    """The lower and the upper corner of ``--box``, world frame, m."""
    return None if box is None else [list(box[:3]), list(box[3:])]


@dataclass
class Recording:
    """The scans of a command, their poses, and how both are read.

    scans: The scans: .npz of radarsdf, a folder of point clouds, a ROS bag, or the folder of a data set.
    poses: Their poses, where the scans have none: a file in TUM or KITTI format, or of 4 x 4 matrices.
    extrinsic: File of the 4 x 4 matrix from the sensor's frame to that of the poses, T_base_sensor, if they differ.
    topic: In a bag: the topic of the scans; may be repeated.
    pose_topic: In a bag: the topic of the poses.
    imu_topic: In a bag: the topic of the inertial measurements, for poses that are found.
    imu_rotation: File of the 3 x 3 matrix from the axes of the IMU to those of the radar, R_sensor_imu; default: of the
        bag, or found.
    field: Which field of the file holds x, y, z, intensity or doppler, such as intensity=Power; may be repeated.
    columns: In files without a header: the number of columns, or their names, such as x,y,z,intensity,doppler.
    max_gap: Longest gap between two poses that is interpolated, s; default: 0.5.
    world_frame: In a bag with TF: the frame of the world.
    stamps: In a bag: whether a scan has the time of its header or of its record; default: header, unless its stamps are zero
        or constant.
    """

    scans: Path
    poses: Path | None = None
    _: KW_ONLY
    extrinsic: Path | None = None
    topic: list[str] | None = None
    pose_topic: str | None = None
    imu_topic: str | None = None
    imu_rotation: Path | None = None
    field: list[str] | None = None
    columns: str | None = None
    max_gap: float | None = None
    world_frame: str | None = None
    stamps: Literal["header", "record"] | None = None

    def read(self, poses: StampedPoses | None = None) -> Scans:
        """The scans, with `poses` in place of theirs. What was assumed or left out is logged on standard error."""
        from radarsdf.io.read import read
        from radarsdf.io.text import read_numbers

        columns, base, imu = self.columns, self.extrinsic, self.imu_rotation
        replaced: Any = self.poses if poses is None else poses
        return read(
            self.scans,
            replaced,
            extrinsic=None if base is None else read_numbers(base, 4),
            topic=self.topic,
            pose_topic=self.pose_topic,
            imu_topic=self.imu_topic,
            R_sensor_imu=None if imu is None else read_numbers(imu, 3),
            fields=dict(_role_and_name(text) for text in self.field or ()) or None,
            columns=int(columns) if columns and columns.isdecimal() else columns and columns.split(","),
            world_frame=self.world_frame,
            stamps=self.stamps,
            **({} if self.max_gap is None else {"max_gap_s": self.max_gap}),
        )

    @property
    def inputs(self) -> list[Path]:
        """The input files and folders, which no output may overwrite."""
        paths = (self.scans, self.poses, self.extrinsic, self.imu_rotation)
        return [path for path in paths if path is not None]


@dataclass
class MaybeRecording(Recording):
    """The same for commands that work without scans: the field `scans` may be None."""

    scans: Path | None = None  # type: ignore[assignment]


MaybeRecording.__doc__ = Recording.__doc__


def _role_and_name(text: str) -> tuple[str, str]:
    role, equals, name = text.partition("=")
    refuse_if(not (equals and role and name), f"--field takes ROLE=NAME, not {text!r:.50}")
    return role, name


@dataclass(kw_only=True)
class Settings:
    """The configuration of a fit: a preset, then the changes of a file, then single ones.

    paper: Use the published configuration: slower, for comparison.
    quick: Average distances instead of training the surface: less accurate, but done in under a second; mesh the map with
        --voxel 0.2.
    config: Change the settings that this TOML file has; radarsdf config prints all of them.
    set: Change one setting, such as leaf_size_m=0.3 or training.sdf_iterations=200; may be repeated.
    """

    paper: bool = False
    quick: bool = False
    config: Path | None = None
    set: list[str] | None = None

    def __post_init__(self) -> None:
        refuse_if(self.paper and self.quick, "--paper and --quick are two presets: leave out one of them")

    def load(self) -> FitConfig:
        """The configuration."""
        from radarsdf.config.fit_config import FitConfig
        from radarsdf.config.toml import read_toml

        config = FitConfig.paper() if self.paper else FitConfig.quick() if self.quick else FitConfig()
        if self.config is not None:
            config = config.override(**read_toml(self.config))
        for text in self.set or ():
            config = config.override(**setting_of(text))
        return config


def setting_of(text: str) -> dict[str, Any]:
    """One ``NAME=VALUE`` or ``GROUP.NAME=VALUE``. A value that is not a Python literal, such as octree, is a string."""
    path, equals, value = text.partition("=")
    refuse_if(not equals, f"--set takes NAME=VALUE, not {text!r:.50}")
    group, dot, name = path.partition(".")
    try:
        read = ast.literal_eval(value)
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError):
        read = {"true": True, "false": False}.get(value, value)  # as in TOML
    return {group: {name: read}} if dot else {path: read}


def words_of(*groups: Recording | Settings) -> list[str]:
    """Arguments and options as one would type them again."""
    words: list[str] = []
    for group in groups:
        for field in dataclasses.fields(group):
            value = getattr(group, field.name)
            option = f"--{field.name.replace('_', '-')}"
            if value in (None, False):
                continue
            if value is True:
                words.append(option)
            elif not field.kw_only:
                words.append(str(value))
            else:
                for one in value if isinstance(value, list) else [value]:
                    words += [option, str(one)]
    return words


@dataclass(kw_only=True)
class Surface:
    """The voxels of a mesh, and what it leaves out.

    voxel: Edge length of a voxel, m.
    min_confidence: Leave out surface with a confidence below this, 0 to 1; default: that of the highest expected F-score.
    max_uncertainty: Leave out surface with a standard error above this, m; default: no limit.
    min_component: Leave out connected components of fewer triangles; default: 30, and fewer in voxels above 0.1 m.
    """

    voxel: float = 0.1
    min_confidence: float | None = None
    max_uncertainty: float | None = None
    min_component: int | None = None

    @property
    def limits(self) -> dict[str, Any]:
        """What the mesh leaves out, as arguments of ``Map.mesh``."""
        return {
            "min_confidence": self.min_confidence,
            "max_uncertainty": self.max_uncertainty,
            "min_component_triangles": self.min_component,
        }


@dataclass(kw_only=True)
class Address:
    """Where a page is served.

    host: Address to listen on. 127.0.0.1 is reached from this machine alone; with 0.0.0.0 everyone who can reach the machine
        sees the map, by its address or its name.
    port: Port to listen on; default: 8080, or the next that is free.
    """

    host: str = "127.0.0.1"
    port: int | None = None

    def check(self) -> None:
        """Raises an ImportError if viser is missing, and an OSError if the address cannot be listened on."""
        from radarsdf.view.serving import free_port, require_viser

        require_viser()
        free_port(self.host, self.port)
