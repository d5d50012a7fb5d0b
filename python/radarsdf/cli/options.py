# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The arguments and options of each command, here and not next to the commands so that help imports none of these."""

from __future__ import annotations

import argparse
from argparse import BooleanOptionalAction
from pathlib import Path
from typing import Any, NoReturn

_SCANS = "the scans: .npz of radarsdf, a folder of point clouds, a ROS bag, or the folder of a data set"
_NO_CHECK = "do not refuse scans in which radarsdf check would find an error"


class UsageError(Exception):
    """The command line is wrong: exit status 2."""


class Parser(argparse.ArgumentParser):
    """The options of one command, a group of options by each method."""

    def error(self, message: str) -> NoReturn:
        msg = f"{message}; {self.prog} --help lists the options"
        raise UsageError(msg)

    # fmt: off
    def add_map(self) -> None:
        self.add_argument("map", type=Path, help="the map: .safetensors of radarsdf fit, or the folder of radarsdf tiles")

    def add_out(self, text: str, **options: Any) -> None:
        self.add_argument("-o", "--out", type=Path, help=text, **{"required": True} | options)

    def add_flag(self, name: str, text: str) -> None:
        self.add_argument(name, action="store_true", help=text)

    def add_recording(self, scans: str = _SCANS, **options: Any) -> None:
        self.add_argument("scans", type=Path, help=scans, **options)
        self.add_argument("poses", type=Path, nargs="?", help="their poses, if they have none: TUM, KITTI, 4 x 4 matrices")
        add = self.add_argument_group("reading").add_argument
        add("--extrinsic", type=Path, metavar="FILE", help="T_base_sensor, 4 x 4, if the poses are those of another frame")
        add("--topic", action="append", help="in a bag: the topic of the scans; may be repeated")
        add("--pose-topic", metavar="TOPIC", help="in a bag: the topic of the poses")
        add("--imu-topic", metavar="TOPIC", help="in a bag: the topic of the IMU, for poses that are found")
        add("--imu-rotation", type=Path, metavar="FILE", help="R_sensor_imu, 3 x 3; default: of the bag, or found")
        add("--field", action="append", metavar="ROLE=NAME",
            help="which field holds x, y, z, intensity or doppler, such as intensity=Power; may be repeated")
        add("--columns", help="in files without a header: how many, or their names, such as x,y,z,intensity,doppler")
        add("--max-gap", type=float, default=0.5, metavar="S", help="longest gap between poses to interpolate; default: 0.5 s")
        add("--world-frame", metavar="FRAME", help="in a bag with TF: the frame of the world")
        add("--stamps", choices=("header", "record"), help="in a bag: whether a scan has the time of its header or record")

    def add_settings(self) -> None:
        group = self.add_argument_group("settings")
        add = group.add_mutually_exclusive_group().add_argument
        add("--paper", action="store_true", help="use the published configuration: slower, for comparison")
        add("--quick", action="store_true",
            help="average distances instead of training: less accurate, but under a second; mesh with --voxel 0.2")
        group.add_argument("--config", type=Path, metavar="FILE", help="a TOML file, as radarsdf config prints it")
        group.add_argument("--set", action="append", metavar="NAME=VALUE",
            help="change one setting, such as leaf_size_m=0.3 or training.sdf_iterations=200; may be repeated")

    def add_surface(self) -> None:
        add = self.add_argument_group("surface").add_argument
        add("--voxel", type=float, default=0.1, metavar="M", help="edge length of a voxel; default: 0.1 m")
        add("--min-confidence", type=float, metavar="P",
            help="leave out surface with a confidence below this, 0 to 1; default: that of the highest expected F-score")
        add("--max-uncertainty", type=float, metavar="M", help="leave out surface with a standard error above this")
        add("--min-component", type=int, metavar="N",
            help="leave out components of fewer triangles; default: 30, and fewer in voxels above 0.1 m")

    def add_box(self) -> None:
        self.add_argument("--box", type=float, nargs=6, action=_Corners, metavar=("X0", "Y0", "Z0", "X1", "Y1", "Z1"),
            help="use only the part between these two corners: lower, upper, world frame, m")

    def add_holdout(self) -> None:
        self.add_argument("--holdout", type=int, metavar="N",
            help="compare intensities with the scans that radarsdf fit --holdout N left out")

    def add_address(self) -> None:
        add = self.add_argument_group("page").add_argument
        add("--host", default="127.0.0.1",
            help="address to listen on; default: 127.0.0.1; with 0.0.0.0, everyone who reaches this machine sees the map")
        add("--port", type=int, help="port to listen on; default: 8080, or the next that is free")

    def add_results(self) -> None:
        self.add_flag("--quiet", "show no progress bar")
        self.add_flag("--json", "print the results as one JSON object, lengths in m; all else goes to standard error")

    def demo(self) -> None:
        add = self.add_argument
        add("--scene", choices=("hugin", "oculii", "wall", "astyx"), default="hugin", help="the radar and the place")
        add("--frames", type=int, metavar="N", help="number of scans; default: depends on the scene")
        self.add_out("the folder to write", required=False, default=Path("radarsdf_demo"))
        add("--view", action=BooleanOptionalAction,
            help="show the map in the browser at the end; default: in a terminal of a machine with a screen")
        self.add_results()
        self.add_surface()
        self.add_settings()

    def check(self) -> None:
        self.add_results()
        self.add_recording()
        self.add_settings()

    def fit(self) -> None:
        add = self.add_argument
        self.add_out("the map to write, .safetensors", required=False)
        self.add_flag("--dry-run", "only estimate memory and time")
        add("--holdout", type=int, metavar="N",
            help="leave out the first scan and then every N-th scan, for radarsdf eval --holdout N")
        self.add_flag("--refine", "refine the poses by the returns first; radarsdf poses writes refined poses")
        self.add_flag("--geometry-only", "do not use the intensities")
        self.add_flag("--no-check", _NO_CHECK)
        add("--checkpoint", type=Path, metavar="FILE",
            help="save the state of the fit from time to time, and continue from it; it is removed with the map written")
        add("--report", type=Path, metavar="PAGE", help="also write a page about the map, .html")
        self.check()

    def mesh(self) -> None:
        add = self.add_argument
        self.add_map()
        self.add_out("the mesh to write: .ply, .obj, .stl, .glb")
        self.add_box()
        add("--viewpoint", type=float, nargs=3, metavar=("X", "Y", "Z"),
            help="colour the mesh by the intensity seen from here, world frame, m")
        add("--picture", type=Path, help="also draw the mesh, as .png")
        self.add_results()
        self.add_surface()

    def poses(self) -> None:
        self.add_out("the poses to write: .tum (with times), .kitti, .npy; or .npz: the scans with these poses")
        self.add_flag("--find", "do not use the poses of the scans: find them from returns and Doppler")
        self.add_argument("--picture", type=Path, help="also draw the trajectory from above, before and after, as .png")
        self.check()

    def live(self) -> None:
        add = self.add_argument
        self.add_out("the map to write in the end, .safetensors", required=False)
        add("--trajectory", type=Path, help="also write where the scans were placed: .tum, .kitti or .npy")
        add("--rate", type=float, default=1.0,
            help="multiplies the recorded speed, which is 0.1 s a scan without times; 0: as fast as possible")
        self.add_flag("--find", "do not use the poses of the scans: track each scan on the last ones")
        self.add_flag("--view", "show the map in the browser while it grows")
        self.add_address()
        self.check()

    def view(self) -> None:
        self.add_map()
        self.add_argument("--open", action=BooleanOptionalAction, help="open a browser here; default: if there is a screen")
        self.add_argument("--max-vertices", type=int, default=500_000, metavar="N", help="simplify a mesh that has more")
        self.add_box()
        self.add_flag("--quiet", "show no progress bar")
        self.add_recording(nargs="?")
        self.add_address()
        self.add_surface()

    def report(self) -> None:
        self.add_map()
        self.add_out("the page to write, .html")
        self.add_holdout()
        self.add_box()
        self.add_results()
        self.add_recording(nargs="?")
        self.add_surface()

    def eval(self) -> None:
        self.add_argument("what", type=Path, help="a mesh, or a map")
        self.add_argument("--samples", type=int, default=10_000_000, metavar="N", help="points sampled on the mesh")
        self.add_box()
        self.add_holdout()
        self.add_results()
        self.add_recording("the truth: lidar points (.ply, .pcd, .las, .laz, .npy, .npz, .csv, .xyz, .txt, .bin), a surface "
            "(.ply, .obj, .off, .stl, .glb), or scans as for radarsdf fit, with lidar points or with --holdout")
        self.add_surface()

    def render(self) -> None:
        add = self.add_argument
        self.add_map()
        add("--pose", nargs="+", action="append", required=True, metavar="P",
            help="where the sensor is, world frame: x y z, m, or x y z qx qy qz qw, or a file of poses; may be repeated")
        self.add_out("what to write: .npz, scans for radarsdf fit; .ply, points in the world frame; .png, a picture")
        add("--returns", type=float, metavar="N", help="number of returns in a scan; default: that of the map's sensor")
        self.add_flag("--noise", "add the noise of the sensor")
        add("--seed", type=int, default=0, help="seed of the noise")
        self.add_results()

    def compare(self) -> None:
        add = self.add_argument
        self.add_map()
        self.add_out("a mesh in colours to write, such as changes.ply, or .npz with all arrays", required=False)
        add("--report", type=Path, metavar="PAGE", help="also write a page about what changed, such as changes.html")
        self.add_flag("--view", "show what changed in the browser at the end, until Ctrl-C")
        add("--align", action=BooleanOptionalAction, default=True,
            help="move the later map as a whole if its surface is then nearer to the earlier one")
        add("--min-area", type=float, default=0.1, metavar="M2", help="smallest region that is listed; default: 0.1 m2")
        self.add_box()
        self.add_results()
        self.add_recording("the later map, or later scans, as for radarsdf fit")
        self.add_address()

    def grid(self) -> None:
        add = self.add_argument
        self.add_map()
        self.add_out("a file to write, may be repeated: .npz with all arrays, .ply of the voxels' centres, .bt for OctoMap, "
            ".yaml and .pgm for ROS's map_server", action="append")
        add("--voxel", type=float, default=0.2, metavar="M", help="edge length of a voxel; default: 0.2 m")
        self.add_box()
        add("--heights", type=float, nargs=2, default=(0.3, 2.0), metavar=("LOW", "HIGH"),
            help="range of heights above the ground that the .yaml map covers, m; default: 0.3 2.0")
        add("--distances", type=Path, help="also write the Euclidean distance field of the grid, as .npz")
        add("--costmap", type=Path, help="also write heights, slopes, steps and costs for wheels, as .npz")
        add("--picture", type=Path, help="also draw heights, costs and free space, as .png")
        self.add_results()

    def convert(self) -> None:
        self.add_out(".npz: the scans with their poses; .ply, .pcd, .las, .laz, .npy, .csv: all returns in the world frame, "
            "with intensity, doppler, number and time of the scan; of a mesh, a mesh")
        self.add_results()
        self.add_recording("the scans, as for radarsdf fit; or a mesh: .ply, .obj, .off, .stl, .glb")

    def config(self) -> None:
        self.add_settings()

    def info(self) -> None:
        self.add_argument("map", type=Path, nargs="?", help="also report what is in this map")
        self.add_results()

    def tiles_plan(self) -> None:
        add = self.add_argument
        self.add_out("the folder to write")
        add("--tile-size", type=float, metavar="M", help="edge of a tile; default: 512 leaf cells")
        add("--halo", type=float, metavar="M", help="margin around a tile that its fit sees")
        self.add_flag("--refine", "refine the poses by the returns first, and write them into the folder, poses.tum")
        self.add_flag("--geometry-only", "do not use the intensities")
        self.add_flag("--no-check", _NO_CHECK)
        self._add_where()
        self.check()

    def tiles_run(self) -> None:
        self.tiles_plan()
        self.add_surface()

    def tiles_fit(self) -> None:
        self._add_where()
        self.tiles_status()

    def tiles_mesh(self) -> None:
        self.add_out("a .ply file, or a .json file for 3D Tiles; default: mesh.ply in the folder", required=False)
        self._add_where()
        self.tiles_clean()
        self.add_surface()

    def tiles_status(self) -> None:
        self.add_argument("--tile", action="append", metavar="NAME", help="only the tile of this name; may be repeated")
        self.tiles_clean()

    def tiles_clean(self) -> None:
        self.add_argument("folder", type=Path, help="the folder that radarsdf tiles plan wrote")
        self.add_results()

    def _add_where(self) -> None:
        add = self.add_mutually_exclusive_group().add_argument
        add("--processes", type=int, metavar="N", help="worker processes; each fits one tile at a time")
        add("--cluster", metavar="ADDRESS", help="of dask.distributed's scheduler, such as tcp://host:8786")
    # fmt: on


class _Corners(argparse.Action):
    """The lower and the upper corner of six numbers."""

    def __call__(self, _parser: Any, namespace: Any, values: Any, _option: Any = None) -> None:
        setattr(namespace, self.dest, [values[:3], values[3:]])
