# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""``python -m bench.breakages.drift``: in how many drifted recordings `check` finds the drift, and in how many good ones.

Small recordings, of each kind of scene; every second one has Doppler and times.
"""

from __future__ import annotations

import argparse
import itertools

import numpy as np
import radarsdf
from numpy.typing import NDArray
from radarsdf.checking.noise import check_drift
from radarsdf.checking.recording import Recording
from radarsdf.simulate import measured_motion

from bench.paper.broken_poses import walked
from bench.timing import timed

_FRAMES = 24
_WALKS = ((0.02, 0.1), (0.05, 0.25))  # of a step, m and degrees


def main() -> None:
    """Print a table of kinds of scenes."""
    parser = argparse.ArgumentParser(prog="python -m bench.breakages.drift", description=__doc__)
    parser.add_argument("--count", type=int, default=200, help="good recordings, and as many drifted ones")
    parser.add_argument("--scene-seed", type=int, default=301, help="seed of the first scene of each kind")
    options = parser.parse_args()
    config = radarsdf.FitConfig(num_threads=1)
    scenes = dict(radarsdf.simulate.SCENES) | dict(radarsdf.simulate.KINDS)
    found: dict[str, NDArray[np.int64]] = {
        name: np.zeros((3, 2), np.int64) for name in scenes
    }  # found and tried: good, and each walk
    seconds = []
    turn = itertools.cycle(scenes.items())
    for i in range(options.count):
        name, make = next(turn)
        number = i // len(scenes)
        seed = options.scene_seed + number
        scans = make(seed=seed, frames=_FRAMES)
        doppler_mps, times_s = None, None
        if number % 2:
            # As many metres a second as a step has tenths of a metre: at most 10, so that the Doppler is that of a drive.
            step_m = np.median(np.linalg.norm(np.diff(scans.poses[:, :3, 3], axis=0), axis=1))
            times_s = max(0.1, step_m / 10) * np.arange(_FRAMES)
            doppler_mps = measured_motion(scans, times_s=times_s, seed=seed).doppler_mps
        walk = number // 2 % 2
        for row, poses in ((0, scans.poses), (1 + walk, walked(scans.poses, *_WALKS[walk], seed))):
            with timed() as taken:
                findings = check_drift(Recording.of(scans.points, poses, None, doppler_mps, times_s), config)
            seconds.append(taken.cpu_s)
            found[name][row] += (bool(findings), 1)
    heads = ["good", *(f"{m} m, {degrees}° a step" for m, degrees in _WALKS)]
    print("| scenes | " + " | ".join(heads) + " |\n" + "|---" * 4 + "|")
    for name, counts in [*found.items(), ("all", np.sum(list(found.values()), axis=0))]:
        print(f"| {name} | " + " | ".join(f"{count} of {tried}" for count, tried in counts.tolist()) + " |")
    print(
        f"\nprocessor seconds of a recording of {_FRAMES} scans: median {np.median(seconds):.2f}, most {max(seconds):.2f}"
    )


if __name__ == "__main__":
    main()
