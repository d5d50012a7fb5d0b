# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The returns of recorded drives beside those of a simulated scene: `python -m bench.sensor FILE.npz ...`."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from radarsdf.simulate import SCENES

from bench.paper.report import markdown

from .drives import recorded, with_lidar
from .figures import figures


def table(drives: Sequence[dict[str, float]], simulations: Sequence[dict[str, float]]) -> str:
    """Each figure of the recorded drives (median, least, most) and of the simulations (median), and their ratio."""
    rows = []
    for name in simulations[0]:
        real, ours = (np.array([found[name] for found in part]) for part in (drives, simulations))
        ends, ratio = "–", "–"
        if np.isfinite(real).any():
            ends = f"{np.nanmin(real):.3g}…{np.nanmax(real):.3g}"
            if np.isfinite(ours).any() and np.nanmedian(real) > 0:
                ratio = f"{np.nanmedian(ours) / np.nanmedian(real):.2f}"
        rows.append([name, _number(real), ends, _number(ours), ratio])
    return markdown(["figure", "drives, median", "least…most", "simulated, median", "ratio"], rows)


def _number(values: np.ndarray) -> str:
    return "–" if np.isnan(values).all() else f"{np.nanmedian(values):.3g}"


def main(arguments: list[str] | None = None) -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(prog="python -m bench.sensor", description=__doc__)
    parser.add_argument("files", nargs="+", type=Path, metavar="FILE", help=".npz files of recorded drives")
    parser.add_argument("--scene", choices=SCENES, default="astyx", help="simulated scene; default: astyx")
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(5)), help="default: 0 to 4")
    words = parser.parse_args(arguments)
    drives = [figures(recorded(path)) for path in words.files]
    print(table(drives, [figures(with_lidar(SCENES[words.scene](seed=seed))) for seed in words.seeds]))


if __name__ == "__main__":
    main()
