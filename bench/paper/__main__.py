# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The experiments of the paper, one command each: `python -m bench.paper EXPERIMENT [SCENE ...]`."""

from __future__ import annotations

import argparse
import inspect
import sys
from pathlib import Path

import numpy as np
from radarsdf import FitConfig, RadarMap
from tqdm import tqdm

from bench.peers.interface import PEERS
from bench.settings import Changes, parsed

from . import (
    ablation,
    angles,
    calibration,
    curve,
    intensity,
    kinds,
    map_size,
    novel_views,
    poses,
    ranges,
    sparse,
    surface,
    views,
)
from .experiment import Experiment, Options, Row
from .report import provenance, write_json
from .scenes import load_scene

EXPERIMENTS: dict[str, Experiment] = {
    "surface": surface.EXPERIMENT,
    "intensity": intensity.EXPERIMENT,
    "ablation": ablation.EXPERIMENT,
    "sparse": sparse.EXPERIMENT,
    "map-size": map_size.EXPERIMENT,
    "angles": angles.EXPERIMENT,
    "views": views.EXPERIMENT,
    "novel-views": novel_views.EXPERIMENT,
    "curve": curve.EXPERIMENT,
    "calibration": calibration.EXPERIMENT,
    "ranges": ranges.EXPERIMENT,
    "poses": poses.EXPERIMENT,
    "kinds": kinds.EXPERIMENT,
}
_QUICK_FRAMES = 4


def main(arguments: list[str] | None = None) -> None:
    """Run one experiment, write its table, numbers and plot, and print the table."""
    parser = _parser()
    words = parser.parse_args(arguments)
    experiment = EXPERIMENTS[words.experiment]
    if unknown := sorted(set(words.peers) - set(PEERS)):
        parser.error(f"no peers {', '.join(unknown)}: there are {', '.join(PEERS)}")
    try:
        levers = tuple(_changes(settings) for settings in words.set)
    except ValueError as error:
        parser.error(str(error))
    quick = words.quick
    options = Options(
        quick=quick,
        repetitions=words.repetitions or (2 if quick else experiment.repetitions),
        samples=words.samples or (100_000 if quick else 10_000_000),
        bases=tuple(words.base or experiment.bases),
        peers=tuple(words.peers or experiment.peers),
        meshes=words.out / "meshes" if words.meshes else None,
        levers=levers,
    )
    frames = words.frames or (_QUICK_FRAMES if quick else None)
    box = None if words.box is None else np.reshape(words.box, (2, 3))
    try:
        scenes = [
            load_scene(spec, frames=frames, seed=words.scene_seed, box=box)
            for spec in words.scenes or experiment.scenes
        ]
    except (ValueError, OSError) as error:
        sys.exit(str(error))
    tasks = [task for scene in scenes for task in experiment.tasks(scene, options)]
    (options.meshes or words.out).mkdir(parents=True, exist_ok=True)
    stem = words.out / words.experiment
    rows: list[Row] = []
    made = provenance()
    with tqdm(tasks, unit="task", disable=None) as bar:
        for task in bar:
            bar.set_description(task.label)
            rows += task.run()
            # After each task, so that an interrupted run of hours keeps its rows.
            write_json(stem.with_suffix(".json"), {"experiment": words.experiment, **made, "rows": rows})
    heading = f"## {experiment.title}" + (", quick run: the numbers are meaningless" if quick else "")
    origin = f"`{made['command']}`, commit {made['commit']}, {made['processor']}, {made['threads']} threads"
    table = "\n\n".join(
        [heading, experiment.table(rows), f"{origin}; protocols {', '.join(made['protocols'])}.\n"]
    )
    stem.with_suffix(".md").write_text(table, encoding="utf-8")
    experiment.plot(rows, stem.with_suffix(".png"))
    print(table)
    print(f"written: {', '.join(str(stem.with_suffix(suffix)) for suffix in ('.md', '.json', '.png'))}")


def _changes(settings: list[str]) -> Changes:
    """`NAME=VALUE` words as changes of a configuration, and under `mesh` of a mesh, that has them all."""
    changes = parsed(settings)
    FitConfig().override(**{name: value for name, value in changes.items() if name != "mesh"})
    if unknown := set(changes.get("mesh", {})) - set(inspect.signature(RadarMap.mesh).parameters):
        msg = f"unknown setting mesh.{min(unknown)}"
        raise ValueError(msg)
    return changes


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m bench.paper", description=__doc__)
    parser.add_argument("experiment", choices=EXPERIMENTS)
    parser.add_argument(
        "scenes",
        nargs="*",
        metavar="SCENE",
        help="name of a simulated scene, .npz file or folder; see bench/README.md",
    )
    parser.add_argument(
        "--out", type=Path, default=Path("bench_results"), help="folder; default: bench_results"
    )
    parser.add_argument(
        "--quick", action="store_true", help="only check that everything runs, in about a minute"
    )
    parser.add_argument(
        "--repetitions",
        type=int,
        help="number of fits with different seeds, calibration, kinds: of simulated scenes too; default: as in the paper",
    )
    parser.add_argument(
        "--samples",
        type=int,
        help="points on a mesh for its errors; default: 10000000, of which calibration takes at most 40000",
    )
    parser.add_argument(
        "--meshes",
        action="store_true",
        help="surface, sparse, curve: also write each mesh and a picture of it",
    )
    parser.add_argument("--frames", type=int, help="number of scans of each scene; default: all")
    parser.add_argument("--scene-seed", type=int, default=0, help="seed of simulated scenes; default: 0")
    parser.add_argument(
        "--peers",
        nargs="+",
        default=[],
        metavar="PEER",
        help=f"methods to compare, of {', '.join(PEERS)}; default: all that the experiment has",
    )
    parser.add_argument(
        "--base", nargs="+", choices=("default", "paper"), help="configurations of this package"
    )
    parser.add_argument(
        "--box",
        type=float,
        nargs=6,
        metavar=("X0", "Y0", "Z0", "X1", "Y1", "Z1"),
        help="region for the surface errors, world frame, m",
    )
    parser.add_argument(
        "--set",
        nargs="+",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="curve, calibration: one more fit, with these settings of FitConfig, such as training.joint=False, or of the mesh, such as "
        "mesh.min_confidence=0; may be repeated",
    )
    return parser


if __name__ == "__main__":
    main()
