# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Slowdown of a fit by another busy process: `python bench/busy_machine.py`.

Each row is a fit in a new process, once alone and once while another process keeps one core busy. If three threads
share two cores, each gets two thirds of a core, so a ratio of up to 1.5 is fair. The last rows run one operation on
the OpenMP threads of PyTorch: without threads of its own, a fit would consist of such operations.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys

REPEATS = 3
FIT = """
import time, radarsdf, radarsdf.fitting.fit
scans = radarsdf.simulate.hugin(frames=30)
started = time.perf_counter()
radarsdf.fit(scans.points, scans.poses, scans.intensities, progress=False)
print(time.perf_counter() - started)
"""
OPERATION = """
import time, torch
a, b = torch.randn(8192, 64), torch.randn(64, 64)
for _ in range(20): torch.relu(a @ b)
started = time.perf_counter()
for _ in range(200): torch.relu(a @ b)
print(time.perf_counter() - started)
"""
ROWS = {
    "fit": (FIT, {}),
    "fit, torch imported first": ("import torch\n" + FIT, {}),
    "200 operations on OpenMP threads": (OPERATION, {}),
    "... with OMP_WAIT_POLICY=passive": (OPERATION, {"OMP_WAIT_POLICY": "passive"}),
}


def seconds(code: str, environment: dict[str, str]) -> float:
    runs = [
        subprocess.run(
            [sys.executable, "-c", code],
            env=os.environ | environment,
            capture_output=True,
            text=True,
            check=True,
        )
        for _ in range(REPEATS)
    ]
    return statistics.median(float(run.stdout) for run in runs)


def main() -> None:
    print("| case | alone, s | beside a busy process, s | ratio |\n|---|---|---|---|")
    for name, (code, environment) in ROWS.items():
        alone = seconds(code, environment)
        with subprocess.Popen([sys.executable, "-c", "while True: pass"]) as busy:
            try:
                beside = seconds(code, environment)
            finally:
                busy.kill()
        print(f"| {name} | {alone:.2f} | {beside:.2f} | {beside / alone:.1f} |")


if __name__ == "__main__":
    main()
