# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Variation of the errors of the default configuration with its seed, of surface and held-out intensity."""

from __future__ import annotations

from collections.abc import Sequence

from radarsdf.evaluation import intensity_metrics, surface_metrics
from tqdm import tqdm

from bench.paper.experiment import Options, Row, fit, mean_and_deviation, world_returns
from bench.paper.report import markdown
from bench.paper.scenes import Scene, load_scene

COLUMNS = {"f_score": "F-score, %", "f_score_all": "F-score, nothing discarded, %", "mae": "held-out MAE"}


def rows_of(scene: Scene, options: Options) -> list[Row]:
    """A row for each seed. The fit gets all scans that are not held out for the intensity."""
    train, test = scene.split()
    rows = []
    for seed in tqdm(range(options.repetitions), scene.name, unit="fit", disable=None):
        radar_map = fit(train, options.config("default", scene, seed=seed))
        row: Row = {"scene": scene.name, "seed": seed}
        if scene.ground_truth is not None:
            mesh = radar_map.mesh(progress=False)
            if len(mesh.faces):
                metrics = surface_metrics(mesh, scene.ground_truth, box=scene.box, samples=options.samples)
                row |= {name: 100 * metrics[name] for name in ("f_score", "f_score_all")}
        if test.intensities is not None:
            x, sensors, measured = world_returns(test)
            row["mae"] = intensity_metrics(radar_map.intensity(x, sensors, extrapolate=True), measured)["mae"]
        rows.append(row)
    return rows


def run(specs: Sequence[str], count: int, *, quick: bool) -> None:
    """Print a row for each scene, with mean ± standard deviation over the seeds."""
    options = Options(quick, 2 if quick else count, 100_000 if quick else 10_000_000, ("default",), ())
    cells = []
    for spec in specs:
        rows = rows_of(load_scene(spec, frames=4 if quick else None), options)
        cells.append([rows[0]["scene"], str(len(rows)), *(mean_and_deviation(rows, key) for key in COLUMNS)])
    if quick:
        print("quick run: the numbers are meaningless")
    print(markdown(["scene", "seeds", *COLUMNS.values()], cells))
