"""Commands, their arguments and options, as tables apart from the commands, so that help imports none of them."""

import argparse
import re
from pathlib import Path
from typing import Any, NoReturn


class UsageError(Exception):
    """The command line is wrong: exit status 2."""


def refuse_if(wrong: object, message: str) -> None:
    if wrong:
        raise UsageError(message)


class Parser(argparse.ArgumentParser):
    def __init__(self, command: str) -> None:
        _, arguments, text, names_and_groups = ENTRIES[command]
        usage = " ".join(filter(None, ("radarsdf", command, arguments, "[OPTIONS]...")))
        super().__init__(f"radarsdf {command}", usage, text, allow_abbrev=False)
        # Before Python 3.14, argparse takes -1e-5 for an option.
        self._negative_number_matcher = re.compile(r"-\.?\d")
        for group in names_and_groups.split():
            options = self.add_argument_group(group) if group in GROUPS else self
            for name in GROUPS.get(group, group).split():
                kind, text = OPTIONS.get(f"{command} {name}") or OPTIONS[name]
                names = ("-o", "--out") if name == "-o" else (name,)
                (options if name.startswith("-") else self).add_argument(*names, help=text, **kind)

    def error(self, message: str) -> NoReturn:
        msg = f"{message}; {self.prog} --help lists the options"
        raise UsageError(msg)


class _Corners(argparse.Action):
    def __call__(self, _parser: Any, namespace: Any, values: Any, _option: Any = None) -> None:
        setattr(namespace, self.dest, [values[:3], values[3:]])


GROUPS = {
    "results": "--quiet --json",
    "reading": "scans poses --extrinsic --topic --pose-topic --imu-topic --imu-rotation --field --columns --max-gap "
    "--world-frame --stamps",
    "settings": "--paper --quick --config --set",
    "surface": "--voxel --min-confidence --max-uncertainty --min-component",
    "page": "--host --port",
    "tiles": "--tile-size --halo --geometry-only --no-check",
    "workers": "--processes --cluster",
}

# Options of "surface" that are arguments of Map.mesh.
LIMITS = ("min_confidence", "max_uncertainty", "min_component_triangles")

_Kind = dict[str, Any]
_FLAG: _Kind = {"action": "store_true"}
_SWITCH: _Kind = {"action": argparse.BooleanOptionalAction}
_FILE: _Kind = {"type": Path, "metavar": "FILE"}
_OUT: _Kind = _FILE | {"required": True}
_FOLDER: _Kind = _FILE | {"metavar": "FOLDER"}
_PATH: _Kind = {"type": Path}
_MAYBE: _Kind = _PATH | {"nargs": "?"}
_COUNT: _Kind = {"type": int, "metavar": "N"}
_FLOAT: _Kind = {"type": float, "metavar": "M"}
_NAME: _Kind = {"metavar": "NAME"}
_NAMES: _Kind = _NAME | {"action": "append"}
_POINT: _Kind = {"type": float, "nargs": 3, "metavar": ("X", "Y", "Z")}
_BOX: _Kind = {"type": float, "nargs": 6, "action": _Corners, "metavar": ("X0", "Y0", "Z0", "X1", "Y1", "Z1")}

# fmt: off
OPTIONS: dict[str, tuple[_Kind, str]] = {  # by option, or by command and option: "fit -o"
    "map": (_PATH, "the map: .safetensors of radarsdf fit, or the folder of radarsdf tiles"),
    "info map": (_MAYBE, "also report the contents of this map"),
    "what": (_PATH | {"metavar": "map|mesh"}, "a map, or a mesh"),
    "folder": (_PATH, "the folder written by radarsdf tiles plan"),

    "scans": (_PATH, "the scans: .npz of radarsdf, a folder of point clouds, a ROS bag, or the folder of a data set"),
    "live scans": (_MAYBE, "the scans, as for radarsdf fit; or --ros2"),
    "view scans": (_MAYBE, "scans to browse, as for radarsdf fit"),
    "report scans": (_MAYBE, "the scans of the map, as for radarsdf fit"),
    "eval scans": (_PATH | {"metavar": "truth"}, ("the ground truth: lidar points (.ply, .pcd, .las, .laz, .npy, .npz, .csv, .xyz, .txt, .bin), a surface "
                   "(.ply, .obj, .off, .stl, .glb), or scans as for radarsdf fit, with lidar points or with --holdout")),
    "compare scans": (_PATH | {"metavar": "later"}, "the later map, or later scans, as for radarsdf fit"),
    "convert scans": (_PATH, "the scans, as for radarsdf fit; or a mesh: .ply, .obj, .off, .stl, .glb"),
    "sessions": (_PATH | {"nargs": "+", "metavar": "scans"}, "the sessions, as the scans of radarsdf fit; the first one's frame is kept"),
    "poses": (_MAYBE, "file of poses, if the scans have none: TUM, KITTI, 4 x 4 matrices"),
    "locate poses": (_MAYBE, argparse.SUPPRESS),  # refused
    "--extrinsic": (_FILE, "T_base_sensor, 4 x 4, if the poses are those of another frame than the sensor's"),
    "--topic": (_NAMES, "in a bag: the topic of the scans; may be repeated"),
    "--pose-topic": (_NAME, "in a bag: the topic of the poses"),
    "--imu-topic": (_NAME, "in a bag: the topic of the IMU, used to estimate poses"),
    "--imu-rotation": (_FILE, "R_sensor_imu, 3 x 3; default: from the bag, or estimated"),
    "--field": (_NAMES | {"metavar": "ROLE=NAME"},
                "field for a role: x, y, z, range, azimuth, elevation, intensity or doppler; may be repeated"),
    "--columns": (_NAME | {"metavar": "N|NAMES"}, "in files without a header: number of columns, or their names, such as x,y,z,intensity,doppler"),
    "--max-gap": (_FLOAT | {"metavar": "S", "default": 0.5}, "longest gap between poses to interpolate; default: 0.5 s"),
    "--world-frame": (_NAME, "with poses from TF: the world frame"),
    "--stamps": ({"choices": ("header", "record")}, "for messages of ROS: clock of the scans"),

    "fit -o": (_FILE, "the map to write, .safetensors"),
    "live -o": (_FILE, "the map to write at the end, .safetensors"),
    "mesh -o": (_OUT, "the mesh to write: .ply, .obj, .off, .stl, .glb"),
    "poses -o": (_OUT, "the poses to write: .tum (with times), .kitti, .npy; or .npz: the scans with these poses"),
    "calibrate -o": (_FILE, "the mountings to write, .json: by label T_body_sensor, covariance, time offset; null: unobserved"),
    "locate -o": (_OUT, "the poses to write, of the scans that were found: .tum (with times), .kitti, .npy; or .npz: these scans with poses"),
    "join -o": (_FOLDER | {"required": True}, "the folder to write: of each session that was joined, the scans with their poses, .npz"),
    "report -o": (_OUT, "the page to write, .html"),
    "render -o": (_OUT, ".npz, scans for radarsdf fit; .ply, points in the world frame; .png, a picture"),
    "compare -o": (_FILE, "coloured mesh to write, such as changes.ply"),
    "grid -o": (_OUT | {"action": "append"}, ("a file to write, may be repeated: .npz with all arrays, .bt for OctoMap, "
                ".yaml and .pgm for ROS's map_server")),
    "convert -o": (_OUT, (".npz: the scans with their poses; .ply, .pcd, .las, .laz, .npy, .csv: all returns in the world "
                   "frame, with intensity, doppler, index and time of the scan; or a mesh")),
    "demo -o": (_FOLDER | {"default": Path("radarsdf_demo")}, "the folder to write; default: radarsdf_demo"),
    "tiles mesh -o": (_FILE, "mesh to write; .json for 3D Tiles; default: mesh.ply in the folder"),
    "-o": (_FOLDER | {"required": True}, "the folder to write"),

    "--quiet": (_FLAG, "hide progress bars"),
    "--json": (_FLAG, "print the results as one JSON object, lengths in m; everything else goes to standard error"),
    "--paper": (_FLAG, "use the published settings: slower, for comparison"),
    "--quick": (_FLAG, "average distances instead of training: takes under a second, keeps no free space; mesh with --voxel 0.2"),
    "--config": (_FILE, "read settings from this TOML file; radarsdf config prints all of them"),
    "--set": (_NAMES | {"metavar": "NAME=VALUE"}, "change a setting, such as training.sdf_iterations=200; may be repeated"),
    "--voxel": (_FLOAT | {"default": 0.1}, "edge length of a voxel; default: 0.1 m"),
    "grid --voxel": (_FLOAT | {"default": 0.2}, "edge length of a voxel; default: 0.2 m"),
    "--min-confidence": (_FLOAT | {"metavar": "P"},
                         "leave out surface below this, 0 to 1; default: maximises the expected F-score"),
    "--max-uncertainty": (_FLOAT, "leave out surface with a standard error above this; default: no limit"),
    "--min-component": (_COUNT | {"dest": "min_component_triangles"}, "leave out components of fewer triangles; default: 30, fewer for large voxels"),
    "--host": ({"default": "127.0.0.1"}, ("address to listen on; default: 127.0.0.1, this machine alone; with 0.0.0.0, "
               "anyone who can reach this machine sees the map")),
    "--port": ({"type": int}, "port to listen on; default: 8080, or the next free one"),
    "--box": (_BOX, "use only the part between these two corners: lower, upper, world frame, m"),
    "--holdout": (_COUNT, "compare intensities with the scans left out by radarsdf fit --holdout N"),
    "fit --holdout": (_COUNT, "leave out the first and then every N-th scan, for radarsdf eval --holdout N"),
    "--refine": (_FLAG, "refine the poses first; radarsdf poses writes refined poses"),
    "--geometry-only": (_FLAG, "do not use the intensities"),
    "--no-check": (_FLAG, "fit even if radarsdf check would find an error"),

    "--scene": ({"choices": ("hugin", "oculii", "wall", "astyx"), "default": "hugin"}, "radar and scene"),
    "--frames": (_COUNT, "number of scans; default: depends on the scene"),
    "demo --view": (_SWITCH, "show the map in the browser at the end; default: in a terminal with a display"),
    "--view": (_FLAG, "show the result in the browser, until Ctrl-C"),
    "--foxglove": (_FLAG, "show the growing map in Foxglove: a WebSocket on this machine, until Ctrl-C"),
    "--mcap": (_FILE, "also write what Foxglove shows, as .mcap"),
    "--rerun": (_FLAG, "show the growing map in rerun's web viewer on this machine, until Ctrl-C"),
    "--rrd": (_FILE, "also write what rerun shows, as .rrd"),
    "--dry-run": (_FLAG, "only estimate memory and time"),
    "--checkpoint": (_FILE, "save the state of the fit here periodically, and resume from it"),
    "--report": (_FILE, "also write a page, .html: pictures, errors, plots"),
    "compare --report": (_FILE, "also write a page, .html: pictures and the regions that changed"),
    "--viewpoint": (_POINT, "colour the mesh by the intensity seen from this position, world frame, m"),
    "--picture": (_FILE, "also draw a picture, .png"),
    "--find": (_FLAG, "ignore the poses of the scans: estimate them from returns and Doppler"),
    "--trajectory": (_FILE, "also write the trajectory of the scans: .tum, .kitti or .npy"),
    "--in": (_FILE | {"dest": "map"}, "continue this map of LiveMap.save, in which scans without poses are searched"),
    "--ros2": (_NAMES | {"metavar": "TOPIC"}, "map this topic of running ROS 2 nodes until Ctrl-C, and publish the map as /radarsdf/...; may be repeated"),
    "--ros2-odom": (_NAME | {"metavar": "TOPIC"}, "with --ros2: the topic of the poses; default: TF, else they are estimated"),
    "--ros2-domain": (_COUNT | {"default": 0}, "with --ros2: the DDS domain, ROS_DOMAIN_ID of the nodes, at the interface of --host; default: 0"),
    "--rate": ({"type": float, "default": 1.0},
               "factor on the recorded speed, or on 0.1 s per scan without times; 0: as fast as possible"),
    "--open": (_SWITCH, "open the page in a local browser; default: if there is a display"),
    "--locate": (_FLAG, "find the poses of the scans in the map, as radarsdf locate"),
    "--guess": ({"type": float, "nargs": 4, "metavar": ("X", "Y", "Z", "YAW")},
                "pose of the first scan in the map, m and degrees, to about 0.5 m and 3 degrees; default: searched"),
    "--samples": (_COUNT | {"default": 10_000_000}, "points sampled on the mesh; default: 10000000"),
    "--pose": ({"nargs": "+", "action": "append", "required": True, "metavar": "P"}, ("pose of the sensor, world frame: "
               "x y z, m, or x y z qx qy qz qw, or a file of poses as for radarsdf fit; may be repeated")),
    "--returns": (_FLOAT | {"metavar": "N"}, "returns per scan; default: as the map's sensor"),
    "--noise": (_FLAG, "add the noise of the sensor"),
    "--seed": (_COUNT | {"default": 0}, "seed of the noise"),
    "--align": (_SWITCH | {"default": True}, "align the later map if the surfaces show an offset between the frames"),
    "--min-area": (_FLOAT | {"metavar": "M2", "default": 0.1}, "smallest region to list; default: 0.1 m2"),
    "--heights": ({"type": float, "nargs": 2, "default": (0.3, 2.0), "metavar": ("LOW", "HIGH")},
                  "range of heights above the ground that the .yaml map covers, m; default: 0.3 2.0"),
    "--distances": (_FILE, "also write the Euclidean distances of the grid: .npz, or .vdb for OpenVDB"),
    "--costmap": (_FILE, "also write heights, slopes, steps and traversal costs, as .npz"),
    "--tile-size": (_FLOAT, "edge of a tile; default: 512 leaf cells"),
    "--halo": (_FLOAT, "margin of returns around a tile that are fitted, too; default: 64 leaf cells"),
    "--tile": (_NAMES, "only the tile of this name; may be repeated"),
    "--processes": (_COUNT, "worker processes; each fits one tile at a time"),
    "--cluster": ({"metavar": "ADDRESS"}, "address of the dask.distributed scheduler, such as tcp://host:8786"),
}

COMMANDS = {
    "Start here": {
        "demo": ("fits.demo", "", "Simulate a drive, fit a map to it, and compare the map with the truth.", "--scene --frames -o --view results surface settings"),
        "check": ("scans.check", "SCANS [POSES]", "Find mistakes in scans and poses before a fit.", "results reading settings"),
        "fit": ("fits.fit", "SCANS [POSES] -o MAP", "Fit a map to scans.",
                "-o --dry-run --holdout --refine --geometry-only --no-check --checkpoint --report results reading settings"),
        "mesh": ("maps.mesh", "MAP -o MESH", "Extract the surface of a map as a triangle mesh.", "map -o --box --viewpoint --picture results surface"),
    },
    "Poses, recordings and large maps": {
        "poses": ("scans.poses", "SCANS [POSES] -o POSES", "Refine the poses of scans, or estimate them from the radar alone.",
                  "-o --find --picture results reading settings"),
        "calibrate": ("scans.calibrate", "SCANS [POSES] [-o MOUNTINGS]", "Estimate how several radars are mounted, and their time offsets.",
                      "-o results reading settings"),
        "locate": ("scans.locate", "MAP SCANS -o POSES", "Find the poses of scans in a map that was made before.", "map -o --guess results reading"),
        "join": ("scans.join", "SCANS SCANS... -o FOLDER", "Place several sessions at one place in one frame.", "sessions -o results settings"),
        "live": ("live.live", "[SCANS [POSES]]", "Replay a recording into a growing map, or map running ROS 2 topics.",
                 "-o --ros2 --ros2-odom --ros2-domain --in --trajectory --rate --find --view --foxglove --mcap --rerun --rrd results reading page settings"),
        "tiles": ("tiles", "SCANS [POSES] -o FOLDER", "Fit a map larger than memory in tiles, locally or on a cluster.", ""),
    },
    "Uses of a map": {
        "view": ("maps.view", "MAP [SCANS [POSES]]", "Show a map in the browser, with a draggable sensor.", "map --locate --open --box --quiet reading page surface"),
        "report": ("maps.report", "MAP [SCANS [POSES]] -o PAGE", "Write a page about a map: pictures, errors, plots, settings.",
                   "map -o --locate --holdout --box results reading surface"),
        "eval": ("maps.evaluate", "MAP|MESH TRUTH [POSES]", "Print the errors of a mesh or a map.", "what --samples --holdout --box results reading surface"),
        "render": ("maps.render", "MAP --pose X Y Z -o VIEW", "Predict the scan that the radar would get from other poses.",
                   "map --pose -o --returns --noise --seed results"),
        "compare": ("maps.compare", "MAP LATER [POSES]", "Report what appeared, disappeared, moved or changed its reflectance.",
                    "map -o --report --view --align --min-area --box results reading page"),
        "grid": ("maps.grid", "MAP -o GRID", "Write occupied, free and unknown space for planners: OctoMap, map_server, costmap.",
                 "map -o --voxel --box --heights --distances --costmap --picture results"),
    },
    "Files and settings": {
        "convert": ("scans.convert", "SCANS [POSES] -o FILE", "Write scans as one file or one point cloud, or a mesh in another format.", "-o results reading"),
        "config": ("settings.config", "", "Print every setting of a fit with its meaning, as a TOML file for --config.", "settings"),
        "info": ("settings.info", "[MAP]", "Print versions and threads for bug reports, and the contents of a map.", "map results"),
    },
}
"""Function in the package, arguments, help and options of each command, by heading of the overview."""

TILE_STEPS = {
    "run": ("tiles.run", "SCANS [POSES] -o FOLDER", "Plan, fit and mesh in one go; run is the default step.", "-o tiles workers results reading surface settings"),
    "plan": ("tiles.plan", "SCANS [POSES] -o FOLDER", "Read the scans once, and write the rays of each tile.", "-o tiles workers results reading settings"),
    "fit": ("tiles.fit", "FOLDER", "Fit the tiles of a plan; finished ones are kept.", "folder --tile workers results"),
    "mesh": ("tiles.mesh", "FOLDER", "Write the surface of all tiles as one mesh.", "folder -o results surface"),
    "status": ("tiles.status", "FOLDER", "List unfinished tiles with the reasons; exit status 1 if there are any.", "folder --tile results"),
}
"""The same of each step of ``radarsdf tiles``."""
# fmt: on

ENTRIES = {name: entry for commands in COMMANDS.values() for name, entry in commands.items()}
ENTRIES |= {f"tiles {step}": entry for step, entry in TILE_STEPS.items()}


def overview() -> str:
    lists = "\n\n".join(f"{heading}:\n{_rows(commands)}" for heading, commands in COMMANDS.items())
    return f"""\
Usage: radarsdf COMMAND [OPTIONS]...

From 3D radar scans to a surface and a reflectance map, on a CPU.

{lists}

radarsdf COMMAND --help lists the options of a command; radarsdf --version prints the version."""


def steps() -> str:
    return f"""\
Usage: radarsdf tiles [STEP] [OPTIONS]...

{_rows(TILE_STEPS)}

radarsdf tiles STEP --help lists the options of a step."""


def _rows(commands: dict[str, tuple[str, str, str, str]]) -> str:
    return "\n".join(f"  {name:<11}{text}" for name, (_, _, text, _) in commands.items())
