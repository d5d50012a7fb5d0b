# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The command line: words in, words out."""

from __future__ import annotations

import argparse
import ast
import platform
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

import radarsdf
from radarsdf import FitConfig, Interrupted, RadarMap, _core
from radarsdf.evaluation import KNNIntensity, format_metrics, holdout, intensity_metrics, surface_metrics
from radarsdf.interrupts import whole_import
from radarsdf.io.scans import Scans, read_scans, write_scans
from radarsdf.render.picture import save_picture

with whole_import():
    import trimesh


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one command; returns the exit status. Errors of the user's are one line on standard error."""
    options = _parser().parse_args(arguments)
    try:
        options.run(options)
    except (ValueError, OSError, ImportError, FloatingPointError, MemoryError) as error:
        print(f"radarsdf {options.command}: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt as interruption:
        print(f"radarsdf {options.command}: {interruption or 'interrupted'}", file=sys.stderr)
        return 130  # as shells have it: 128 and the number of the signal
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="radarsdf",
        description="From 3D radar scans with known poses to a surface and a reflectance map, on a CPU.",
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    demo = _command(
        commands, "demo", _demo, "simulate a drive, fit it, write map, mesh and picture, print the errors"
    )
    demo.add_argument(
        "--scene", choices=sorted(radarsdf.simulate.SCENES), default="hugin", help="default: hugin"
    )
    demo.add_argument("--frames", type=int, help="number of scans; default: the scene's own")
    demo.add_argument(
        "--out", type=Path, default=Path("radarsdf_demo"), help="folder; default: radarsdf_demo"
    )
    _fit_options(demo)

    fit = _command(commands, "fit", _fit, "fit a map to scans")
    fit.add_argument("scans", type=Path, help=".npz with points, frame, poses and, if any, intensity, static")
    out = fit.add_mutually_exclusive_group(required=True)
    out.add_argument("-o", "--out", type=Path, help="the map, .safetensors")
    out.add_argument("--dry-run", action="store_true", help="only estimate memory and time")
    fit.add_argument("--holdout", type=int, metavar="N", help="leave out the first and then every N-th scan")
    fit.add_argument("--geometry-only", action="store_true", help="do not use the intensities")
    fit.add_argument(
        "--checkpoint",
        type=Path,
        metavar="PATH",
        help="write the state there on the way, and go on from it if it exists; removed once the map is written",
    )
    _fit_options(fit)

    mesh = _command(commands, "mesh", _mesh, "turn a map into triangles")
    mesh.add_argument("map", type=Path, help="what fit wrote")
    mesh.add_argument("-o", "--out", type=Path, required=True, help="the mesh: .ply, .obj, .stl, .glb")
    mesh.add_argument(
        "--voxel", type=float, default=0.1, metavar="M", help="edge of a voxel, m; default: 0.1"
    )
    mesh.add_argument(
        "--box", type=float, nargs=6, metavar=("X0", "Y0", "Z0", "X1", "Y1", "Z1"), help="world, m"
    )
    mesh.add_argument(
        "--viewpoint",
        type=float,
        nargs=3,
        metavar=("X", "Y", "Z"),
        help="colour by the intensity seen from here",
    )
    mesh.add_argument(
        "--min-confidence", type=float, default=0.0, metavar="C", help="leave out what is less sure, 0 to 1"
    )
    mesh.add_argument("--picture", type=Path, metavar="PNG", help="draw it, too")
    mesh.add_argument("--quiet", action="store_true", help="no progress bar")

    evaluate = _command(commands, "eval", _eval, "errors of a mesh or a map")
    evaluate.add_argument("what", type=Path, help="a mesh, or a map (.safetensors)")
    evaluate.add_argument("truth", type=Path, help="lidar points (.ply, .npy, .xyz), or scans (.npz)")
    evaluate.add_argument(
        "--holdout", type=int, metavar="N", help="intensity errors on the scans that fit left out"
    )
    evaluate.add_argument(
        "--box", type=float, nargs=6, metavar=("X0", "Y0", "Z0", "X1", "Y1", "Z1"), help="world, m"
    )
    evaluate.add_argument(
        "--samples", type=int, default=10_000_000, help="points on the mesh; default: 10000000"
    )

    _command(commands, "info", _info, "versions, compiler, instruction set, threads: for bug reports")
    return parser


def _command(commands: Any, name: str, run: Any, text: str) -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = commands.add_parser(name, help=text, description=text)
    parser.set_defaults(run=run)
    return parser


def _fit_options(parser: argparse.ArgumentParser) -> None:
    presets = parser.add_mutually_exclusive_group()
    presets.add_argument(
        "--paper", action="store_true", help="the published configuration: slower, for comparison"
    )
    presets.add_argument(
        "--quick",
        action="store_true",
        help="average instead of training the surface: rougher, in under a second; mesh it with --voxel 0.2",
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="a setting of FitConfig; may be repeated",
    )
    parser.add_argument("--quiet", action="store_true", help="no progress bar")


def _config(options: argparse.Namespace) -> FitConfig:
    changes: dict[str, Any] = {}
    for setting in options.set:
        name, equals, text = setting.partition("=")
        if not equals:
            msg = f"--set takes NAME=VALUE, not {setting!r}"
            raise ValueError(msg)
        try:
            changes[name] = ast.literal_eval(text)
        except (SyntaxError, ValueError):
            changes[name] = text  # a word, such as octree
    base = FitConfig.paper() if options.paper else FitConfig.quick() if options.quick else FitConfig()
    return FitConfig.from_dict(base.to_dict() | changes)


def _progress(options: argparse.Namespace) -> bool | None:
    return False if options.quiet else None


def _box(options: argparse.Namespace) -> np.ndarray[Any, Any] | None:
    return None if options.box is None else np.reshape(options.box, (2, 3))


def _demo(options: argparse.Namespace) -> None:
    config = _config(options)
    if options.frames is not None and options.frames < 2:
        msg = f"--frames must be at least 2, one of them to be held out, not {options.frames}"
        raise ValueError(msg)
    options.out.mkdir(parents=True, exist_ok=True)
    simulation = radarsdf.simulate.SCENES[options.scene](frames=options.frames)
    scans = Scans(simulation.points, simulation.poses, simulation.intensities, simulation.ground_truth)
    train, test = holdout(len(scans.points))
    print(f"simulated {options.scene}: {sum(map(len, scans.points))} returns in {len(scans.points)} scans")
    started = time.perf_counter()
    kept = scans.select(train)
    radar_map = radarsdf.fit(
        kept.points, kept.poses, kept.intensities, config=config, progress=_progress(options)
    )
    fitted = time.perf_counter()
    viewpoint = scans.poses[len(scans.poses) // 2, :3, 3]
    mesh = radar_map.mesh(viewpoint=viewpoint, progress=_progress(options))
    print(f"fit {fitted - started:.1f} s, mesh {time.perf_counter() - fitted:.1f} s: {radar_map}")
    if scans.ground_truth is not None:
        print(format_metrics(surface_metrics(mesh, scans.ground_truth, samples=1_000_000)))
    _print_intensity_errors(radar_map, scans.select(test), kept)
    write_scans(options.out / "scans.npz", scans)
    radar_map.save(options.out / "map.safetensors")
    mesh.export(options.out / "mesh.ply")
    files = ["scans.npz", "map.safetensors", "mesh.ply"]
    try:
        save_picture(options.out / "picture.png", mesh, scalar=mesh.vertex_attributes["intensity"])
        files.append("picture.png")
    except ImportError as error:
        print(f"no picture: {error}")
    print("wrote " + ", ".join(str(options.out / name) for name in files))


def _fit(options: argparse.Namespace) -> None:
    scans = read_scans(options.scans)
    if options.holdout:
        scans = scans.select(holdout(len(scans.points), options.holdout)[0])
    intensities = None if options.geometry_only else scans.intensities
    config = _config(options)
    if options.dry_run:
        print(radarsdf.estimate(scans.points, scans.poses, intensities, config=config))
        return
    started = time.perf_counter()
    try:
        radar_map = radarsdf.fit(
            scans.points,
            scans.poses,
            intensities,
            config=config,
            progress=_progress(options),
            checkpoint=options.checkpoint,
        )
    except Interrupted as stop:
        if stop.radar_map is not None:
            stop.radar_map.save(options.out)
            stop.args = (f"{stop}; the map so far is in {options.out}",)
        raise
    radar_map.save(options.out)
    if options.checkpoint is not None:
        options.checkpoint.unlink(missing_ok=True)
    print(f"fit {time.perf_counter() - started:.1f} s: {radar_map}, written to {options.out}")


def _mesh(options: argparse.Namespace) -> None:
    radar_map = radarsdf.load(options.map)
    mesh = radar_map.mesh(
        options.voxel,
        box=_box(options),
        viewpoint=options.viewpoint,
        min_confidence=options.min_confidence,
        progress=_progress(options),
    )
    if len(mesh.faces) == 0:
        msg = f"{options.map} has no surface here: nothing written"
        raise ValueError(msg)
    mesh.export(options.out)
    print(f"{len(mesh.vertices)} vertices and {len(mesh.faces)} triangles written to {options.out}")
    if options.picture:
        save_picture(options.picture, mesh, scalar=mesh.vertex_attributes.get("intensity"))
        print(f"picture written to {options.picture}")


def _eval(options: argparse.Namespace) -> None:
    radar_map = radarsdf.load(options.what) if options.what.suffix == ".safetensors" else None
    if options.holdout and (radar_map is None or options.truth.suffix != ".npz"):
        msg = "--holdout needs a map and scans"
        raise ValueError(msg)
    scans = read_scans(options.truth) if options.truth.suffix == ".npz" else None
    ground_truth = scans.ground_truth if scans else _read_points(options.truth)
    if ground_truth is None and not options.holdout:
        msg = f"{options.truth} has no lidar_points; --holdout N evaluates intensities"
        raise ValueError(msg)
    if ground_truth is not None:
        mesh = radar_map.mesh() if radar_map else _read_mesh(options.what)
        print(format_metrics(surface_metrics(mesh, ground_truth, box=_box(options), samples=options.samples)))
    if options.holdout and radar_map is not None and scans is not None:
        train, test = holdout(len(scans.points), options.holdout)
        _print_intensity_errors(radar_map, scans.select(test), scans.select(train))


def _read_points(path: Path) -> np.ndarray[Any, Any]:
    if path.suffix == ".npy":
        return np.asarray(_whole(path, lambda: np.asarray(np.load(path, allow_pickle=False), np.float64)))
    if path.suffix in (".xyz", ".txt", ".csv"):
        delimiter = "," if path.suffix == ".csv" else None
        return np.asarray(_whole(path, lambda: np.loadtxt(path, delimiter=delimiter, ndmin=2)[:, :3]))
    vertices = _whole(path, lambda: getattr(trimesh.load(path, process=False), "vertices", None))
    if vertices is None:  # a scene of several geometries
        msg = f"{path} is not one cloud or mesh"
        raise ValueError(msg)
    return np.asarray(vertices)


def _read_mesh(path: Path) -> trimesh.Trimesh:
    mesh = _whole(path, lambda: trimesh.load_mesh(path, process=False))
    if isinstance(mesh, trimesh.Trimesh) and np.ndim(mesh.faces) == 2:
        return mesh
    msg = f"{path} is not one mesh"
    raise ValueError(msg)


def _whole(path: Path, read: Callable[[], Any]) -> Any:
    """What `read` gives; other libraries raise anything where a damaged file breaks off."""
    try:
        return read()
    except OSError:
        raise
    except Exception as error:
        msg = f"{path} cannot be read: {error}"
        raise ValueError(msg) from error


def _world(scans: Scans, config: FitConfig) -> tuple[Any, Any, Any]:
    """World points, sensor positions and intensities of the returns within the ranges that the map was fitted to."""
    rays = radarsdf.returns.rays.prepare(
        scans.points,
        scans.poses,
        scans.intensities,
        min_range_m=config.min_range_m,
        max_range_m=config.max_range_m,
    )
    return *rays.in_world(), rays.intensities


def _print_intensity_errors(radar_map: RadarMap, test: Scans, train: Scans) -> None:
    if not radar_map.has_intensity or test.intensities is None:
        return
    x, sensors, measured = _world(test, radar_map.config)
    print("held-out " + format_metrics(intensity_metrics(radar_map.intensity(x, sensors), measured)))
    knn = KNNIntensity(*_world(train, radar_map.config))
    print("kNN      " + format_metrics(intensity_metrics(knn.predict(x, sensors), measured)))


def _info(_: argparse.Namespace) -> None:
    openmp = _core.openmp_version()
    rows = {
        "radarsdf": _core.__version__,
        "python": f"{platform.python_version()} on {platform.platform()}",
        "torch": f"{torch.__version__}, {torch.get_num_threads()} threads",
        "compiler": _core.compiler(),
        "openmp": f"{openmp}, {_core.num_threads()} threads" if openmp else "none: the core is serial",
        "instruction set": f"{_core.instruction_set()} of {', '.join(_core.available_instruction_sets())}",
    }
    for name, value in rows.items():
        print(f"{name:<16}{value}")
