"""Instruction counts of a small fit and of training steps by callgrind: `python -m bench.instructions`.

Load on the machine does not change counts. Two checks end with an error: the core executes 1.15 times the instructions that
``instructions.json`` lists for this compiler and instruction set; or a step depends on the number of returns, on any machine.
"""

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
from radarsdf.field.field import NeuralField
from radarsdf.fitting.estimate import Schedule
from radarsdf.fitting.surface_returns import near_leaf_keys
from radarsdf.fitting.train import Training
from radarsdf.returns.intensities import IntensityScale
from radarsdf.returns.rays import prepare
from radarsdf.threads import ThreadPool

from bench.growth.street import street
from bench.measure import ROOT, failure

EXPECTED = Path(__file__).with_suffix(".json")
_MOST = 1.15
# Ratio of a step with many returns to one with few, over all objects: numbers of touched rows differ by chance.
_MOST_BY_RETURNS = 1.05
_FEW, _MANY, _STEPS = 2_000, 100_000, 3
# Client requests that start and dump a count. Turning the count off would make valgrind retranslate all code.
_SWITCH = """#include <valgrind/callgrind.h>
void start(void) { CALLGRIND_START_INSTRUMENTATION; CALLGRIND_ZERO_STATS; }
void stop(const char* name) { CALLGRIND_DUMP_STATS_AT(name); }
"""


def counted(out: Path) -> dict[str, Counter[str]]:
    """Instructions per case and shared object. `out` is an empty folder.

    Raises
    ------
    RuntimeError
        If counting is impossible here; the message states the reason.
    """
    for tool in ("valgrind", "cc"):
        if shutil.which(tool) is None:
            msg = f"there is no {tool}"
            raise RuntimeError(msg)
    switch = out / "switch.so"
    switch.with_suffix(".c").write_text(_SWITCH)
    compile_ = ["cc", "-shared", "-fPIC", "-o", str(switch), str(switch.with_suffix(".c"))]
    if (done := subprocess.run(compile_, capture_output=True, text=True, check=False)).returncode != 0:
        raise RuntimeError(failure(done))
    # One thread, and none that spins.
    env = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "RADARSDF_ISA": isa()}
    callgrind = ["valgrind", "--tool=callgrind", "--instr-atstart=no", f"--callgrind-out-file={out}/counts"]
    child = [sys.executable, "-m", "bench.instructions", "--child", str(switch)]
    subprocess.run([*callgrind, "--quiet", *child], cwd=ROOT, env=env, check=True)
    cases = {}
    for path in out.glob("counts.*"):
        text = path.read_text()
        if found := re.search(r"^desc: Trigger: Client Request: (.*)$", text, re.MULTILINE):
            cases[found[1]] = by_object(text)
    return cases


def by_object(text: str) -> Counter[str]:
    """Sum self costs in a callgrind file by object."""
    names: dict[str, str] = {}
    counts: Counter[str] = Counter()
    current, called = "", False
    for line in text.splitlines():
        if match := re.match(r"ob=(\(\d+\))(?: (.*))?", line):
            current = names.setdefault(match[1], match[2] or "")
        elif match := re.match(r"cob=(\(\d+\)) (.*)", line):
            names.setdefault(match[1], match[2])
        elif line.startswith("calls="):
            called = True  # the next line is the cost of the callee
        elif re.match(r"[+\-*\d]", line):
            counts[Path(current).name] += 0 if called else int(line.split()[1])
            called = False
    return counts


def isa() -> str:
    """Instruction set to count with: valgrind does not support AVX-512."""
    return "baseline" if _core.instruction_set() == "baseline" else "avx2"


def _child(library: Path) -> None:
    """Run all cases, each once before it is counted."""
    switch = ctypes.CDLL(str(library))
    scans = street(_FEW, 20.0)
    quick = FitConfig.quick().override(num_threads=1)
    radarsdf.fit(scans.points, scans.poses, config=quick, progress=False)  # imports
    switch.start()
    radarsdf.fit(scans.points, scans.poses, config=quick, progress=False)
    switch.stop(b"quick fit")
    few = prepare(scans.points, scans.poses, scans.intensities)
    many = few.select(np.arange(_MANY) % len(few))
    leaf_keys = near_leaf_keys(few, FitConfig(), 1)
    for name, rays, sizes in (
        ("geometry", few, {"batch_size": 512}),
        ("joint", few, {"batch_size": 512, "intensity_batch_size": 256}),
        ("intensity", few, {"sdf_iterations": 1, "intensity_batch_size": 256}),
        ("few returns", few, {"batch_size": 64}),
        ("many returns", many, {"batch_size": 64}),
    ):
        iterations = {"sdf_iterations": _STEPS + 2, "intensity_iterations": _STEPS + 2}
        config = FitConfig(num_threads=1, training=iterations | sizes)
        scale = IntensityScale.of(rays.intensities) if name in ("joint", "intensity") else None
        with ThreadPool(1) as pool:
            field = NeuralField(leaf_keys, config, with_intensity=scale is not None, num_threads=1)
            field.initialise(torch.Generator().manual_seed(0))
            sizes_of_data = {"surface_returns": len(rays), "vertices": field.table.num_rows}
            labelled = [] if scale is None else [len(rays)]
            schedule = Schedule.of(config, **sizes_of_data, labelled=labelled)
            training = Training(field, rays, rays, scale, schedule, config, pool)
            _count_steps(training, name.encode(), switch)
            training.run(progress=False)


def _count_steps(training: Training, name: bytes, switch: ctypes.CDLL) -> None:
    """Count the steps after the second: the first ones shuffle the rays and prepare common data."""
    add, numbers = training.history.add, itertools.count(1)

    def add_and_switch(*arguments: Any) -> None:
        add(*arguments)
        number = next(numbers)
        if number == 2:
            switch.start()
        elif number == 2 + _STEPS:
            switch.stop(name)

    training.history.add = add_and_switch  # type: ignore[assignment, method-assign]


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
    few, many = (sum(cases[f"{size} returns"].values()) for size in ("few", "many"))
    found = faults(of_core, expected["instructions"], many / few)
    for name, count in of_core.items():
        print(f"{name:12} {count:>12,}, expected {expected['instructions'].get(name, 'nothing')}")
    print(f"a step with {_MANY:,} returns: {many / few:.3f} times the instructions of one with {_FEW:,}")
    if found:
        sys.exit("error: " + "; ".join(found))


def faults(of_core: dict[str, int], expected: dict[str, int], many_by_few: float) -> list[str]:
    """Describe excessive counts: cases against the expected counts, and a step with many returns against one with few."""
    by_case = {name: of_core[name] / count for name, count in expected.items()}
    found = [
        f"{name}: {ratio:.2f} times the instructions" for name, ratio in by_case.items() if ratio > _MOST
    ]
    if many_by_few > _MOST_BY_RETURNS:
        found.append(f"a step depends on the number of returns: {many_by_few:.2f} times the instructions")
    return found


if __name__ == "__main__":
    main()
