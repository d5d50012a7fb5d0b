# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Instructions of a small fit and of training steps, counted by callgrind: `python -m bench.instructions`.

Other programs move no count. Two checks end with an error: the core executes 1.15 times as many as ``instructions.json`` has for
this compiler and instruction set; or a training step depends on the number of returns, on any machine.
"""

from __future__ import annotations

import argparse
import ctypes
import itertools
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import radarsdf
import torch
from radarsdf import FitConfig, _core
from radarsdf.field.neural_field import NeuralField
from radarsdf.fitting.average import near_leaf_keys
from radarsdf.fitting.schedule import Schedule
from radarsdf.fitting.train import Training
from radarsdf.returns.intensities import IntensityScale
from radarsdf.returns.rays import prepare
from radarsdf.threads import ThreadPool

from bench.growth.street import street
from bench.measure import ROOT, failure

EXPECTED = Path(__file__).with_suffix(".json")
_MOST = 1.15
# Of all objects, of a step with many returns compared with one with few: the numbers of touched rows differ by chance.
_MOST_BY_RETURNS = 1.05
_FEW, _MANY, _STEPS = 2_000, 200_000, 3
# Functions that turn the counting on, and write the counts since then.
_SWITCH = """#include <valgrind/callgrind.h>
void start(void) { CALLGRIND_START_INSTRUMENTATION; CALLGRIND_ZERO_STATS; }
void stop(const char* name) { CALLGRIND_DUMP_STATS_AT(name); CALLGRIND_STOP_INSTRUMENTATION; }
"""


def counted(out: Path) -> dict[str, Counter[str]]:
    """Instructions of each case by shared object. `out` is an empty folder.

    Raises
    ------
    RuntimeError
        If they cannot be counted here; the message says why.
    """
    for tool in ("valgrind", "cc"):
        if shutil.which(tool) is None:
            msg = f"there is no {tool}"
            raise RuntimeError(msg)
    (out / "switch.c").write_text(_SWITCH)
    commands = [
        ["cc", "-shared", "-fPIC", "-O1", "-o", str(out / "switch.so"), str(out / "switch.c")],
        ["valgrind", "--tool=callgrind", "--instr-atstart=no", f"--callgrind-out-file={out}/counts"]
        + [sys.executable, "-m", "bench.instructions", "--child", str(out)],
    ]
    for command in commands:
        # One thread, and none that waits in a loop.
        env = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "RADARSDF_ISA": isa()}
        done = subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            raise RuntimeError(failure(done))
    cases = {}
    for path in out.glob("counts.*"):
        text = path.read_text()
        if found := re.search(r"^desc: Trigger: Client Request: (.*)$", text, re.MULTILINE):
            cases[found[1]] = _by_object(text)
    return cases


def _by_object(text: str) -> Counter[str]:
    """Self costs in a file of callgrind."""
    names: dict[str, str] = {}
    counts: Counter[str] = Counter()
    current, called = "", False
    for line in text.splitlines():
        if match := re.match(r"ob=(\(\d+\))(?: (.*))?", line):
            current = names.setdefault(match[1], match[2] or "")
        elif match := re.match(r"cob=(\(\d+\)) (.*)", line):
            names.setdefault(match[1], match[2])
        elif line.startswith("calls="):
            called = True  # the next line has the cost of the called function
        elif re.match(r"[+\-*\d]", line):
            counts[Path(current).name] += 0 if called else int(line.split()[1])
            called = False
    return counts


def isa() -> str:
    """The instruction set of the count: valgrind knows no AVX-512."""
    return "baseline" if _core.instruction_set() == "baseline" else "avx2"


def _child(out: Path) -> None:
    """Runs all cases, each once before it is counted."""
    switch = ctypes.CDLL(str(out / "switch.so"))
    scans = street(_FEW, 20.0)
    quick = FitConfig.quick().override(num_threads=1)
    for counts in (False, True):  # the first call imports
        if counts:
            switch.start()
        radarsdf.fit(scans.points, scans.poses, config=quick, progress=False)
        if counts:
            switch.stop(b"quick fit")
    few = prepare(scans.points, scans.poses, scans.intensities)
    many = few.select(np.arange(_MANY) % len(few))
    leaf_keys = near_leaf_keys(few, FitConfig(), 1)
    for name, rays, sizes in (
        ("geometry", few, {"batch_size": 2048}),
        ("joint", few, {"batch_size": 2048}),
        ("intensity", few, {"sdf_iterations": 1}),
        ("few returns", few, {"batch_size": 64}),
        ("many returns", many, {"batch_size": 64}),
    ):
        iterations = {"sdf_iterations": _STEPS + 3, "intensity_iterations": _STEPS + 3}
        config = FitConfig(num_threads=1, training=iterations | sizes)
        scale = IntensityScale.of(rays.intensities) if name in ("joint", "intensity") else None
        with ThreadPool(1) as pool:
            field = NeuralField(leaf_keys, config, with_intensity=scale is not None, num_threads=1)
            field.initialise(torch.Generator().manual_seed(0))
            counts = {"surface_returns": len(rays), "returns": len(rays), "vertices": field.table.num_rows}
            schedule = Schedule.of(config, with_intensity=scale is not None, **counts)
            training = Training(field, rays, rays, scale, schedule, config, pool)
            _count_steps(training, name.encode(), switch)
            training.run(progress=False)


def _count_steps(training: Training, name: bytes, switch: ctypes.CDLL) -> None:
    """Counts the steps after the second: the first ones draw the order of the rays and prepare what all use."""
    add, numbers = training.history.add, itertools.count(1)

    def add_and_switch(*arguments: Any) -> None:
        add(*arguments)
        number = next(numbers)
        if number == 2:
            switch.start()
        elif number == 2 + _STEPS:
            switch.stop(name)

    training.history.add = add_and_switch  # type: ignore[method-assign]


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m bench.instructions", description=__doc__)
    parser.add_argument("--write", action="store_true", help=f"write {EXPECTED.name}: growth is a decision")
    parser.add_argument("--child", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child is not None:
        _child(options.child)
        return
    with tempfile.TemporaryDirectory() as folder:
        try:
            cases = counted(Path(folder))
        except RuntimeError as error:
            print(f"skipped: {error}")
            return
    of_core = {name: counts[Path(_core.__file__).name] for name, counts in cases.items()}
    made_by = {"compiler": _core.compiler(), "instruction_set": isa()}
    if options.write:
        EXPECTED.write_text(json.dumps(made_by | {"instructions": of_core}, indent=2, sort_keys=True) + "\n")
    expected = json.loads(EXPECTED.read_text())
    if any(expected[key] != value for key, value in made_by.items()):
        print(
            f"{EXPECTED.name} is of {expected['compiler']}, {expected['instruction_set']}, this core of {made_by}"
        )
        expected["instructions"] = {}
    too_many = []
    for name, count in sorted(of_core.items()):
        before = expected["instructions"].get(name)
        print(f"{name:12} {count:>12,}" + (f" {count / before:6.3f}" if before else ""))
        if before and count > _MOST * before:
            too_many.append(f"{name}: {count / before:.2f} times as many instructions")
    few, many = (sum(cases[f"{size} returns"].values()) for size in ("few", "many"))
    print(f"a step with {_MANY:,} returns: {many / few:.3f} times the instructions of one with {_FEW:,}")
    if many > _MOST_BY_RETURNS * few:
        too_many.append(
            f"a step depends on the number of returns: {many / few:.2f} times as many instructions"
        )
    if too_many:
        sys.exit("error: " + "; ".join(too_many))


if __name__ == "__main__":
    main()
