"""Fits alternating with VDBFusion and with another version of radarsdf: `python -m bench.speed --against PATH`, in two minutes.

PATH is a wheel, or a checkout built in place. Ratios within a round are of consecutive runs, so that other load on the
machine affects both.
"""

import argparse
import contextlib
import itertools
import json
import os
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import radarsdf

from bench.peers.interface import PEERS, reconstruct
from bench.runner import Column, Experiment, Row, main

CASES: dict[str, dict[str, Any]] = {
    "quick, mesh 0.2 m": {"preset": "quick", "voxel_m": 0.2},
    "default, surface": {"preset": "default"},
    "default, intensities": {"preset": "default", "intensities": True},
}
_OWN = Path(radarsdf.__file__).parents[1]


class Version:
    """A version of radarsdf in its own process, warm after the first run."""

    def __init__(self, packages: Path, scans: Path) -> None:
        self._child = subprocess.Popen(
            [sys.executable, str(Path(__file__).with_name("speed_child.py")), str(scans)],
            env=os.environ | {"PYTHONPATH": str(packages)},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def seconds(self, **case: Any) -> float:
        """Wall time of a fit, with its mesh if the case has one."""
        assert self._child.stdin and self._child.stdout  # noqa: PT018 - pipes
        print(json.dumps(case), file=self._child.stdin, flush=True)
        return float(self._child.stdout.readline())  # an empty line, explained above it, is a ValueError

    def close(self) -> None:
        self._child.communicate()


def speed(options: argparse.Namespace) -> Iterator[Row]:
    """Yield a row per scene, number of threads, case and round. Round 0 warms up, and is left out."""
    frames, rounds = (4, 1) if options.quick else (None, options.repetitions)
    with tempfile.TemporaryDirectory() as folder:
        packages = {"own": _OWN}
        if options.against is not None:
            packages["other"] = packages_of(options.against, Path(folder) / "other")
        for scene in options.cases:
            scans = getattr(radarsdf.simulate, scene)(seed=3, frames=frames)
            path = Path(folder) / f"{scene}.npz"
            counts = [len(points) for points in scans.points]
            points, intensities = (np.concatenate(part) for part in (scans.points, scans.intensities))
            np.savez(path, points=points, intensities=intensities, poses=scans.poses, counts=counts)
            with contextlib.ExitStack() as stack:
                versions = {name: Version(where, path) for name, where in packages.items()}
                for version in versions.values():
                    stack.callback(version.close)
                for threads, (name, case) in itertools.product(options.threads, CASES.items()):
                    row: Row = {"scene": scene, "threads": threads, "case": name}
                    for number in range(rounds + 1):
                        took = {of: v.seconds(threads=threads, **case) for of, v in versions.items()}
                        row["seconds"] = took["own"]
                        if "other" in took:
                            row["by_other"] = took["own"] / took["other"]
                        if "voxel_m" in case:
                            peer = reconstruct(PEERS["VDBFusion"], scans.points, scans.poses)
                            row["by_peer"] = None if peer.seconds is None else took["own"] / peer.seconds
                        if number > 0:
                            yield dict(row)


def packages_of(path: Path, folder: Path) -> Path:
    """Folder that holds the package of a checkout or of a wheel.

    Raises
    ------
    ValueError
        If there is none.
    """
    if path.suffix == ".whl":
        with zipfile.ZipFile(path) as file:
            file.extractall(folder)
        return folder
    found = path.resolve() / "python"
    if not list(found.glob("radarsdf/_core*")):
        msg = f"{path} is neither a wheel nor a checkout built in place"
        raise ValueError(msg)
    return found


EXPERIMENT = Experiment(
    "Fits by turns",
    speed,
    ("hugin", "oculii"),
    ("threads", "repetitions", "against"),
    {"threads": [2], "repetitions": 5},
    {
        "seconds": Column("time, s", digits=3),
        "by_peer": Column("of VDBFusion's"),
        "by_other": Column("of the other version's"),
    },
    lines=("scene", "threads", "case"),
)

if __name__ == "__main__":
    main("bench.speed", EXPERIMENT)
