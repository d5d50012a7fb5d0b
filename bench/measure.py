"""Time and memory of a block, and functions in new processes. Standard library only: a peer's Python may be old."""

import ctypes
import importlib
import json
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
_M_MMAP_THRESHOLD = -3  # constant of malloc.h


@dataclass
class Taken:
    """Time and memory of a block; NaN before its end."""

    wall_s: float = float("nan")
    """Elapsed time, s."""
    cpu_s: float = float("nan")
    """CPU time of all threads of this process, s."""
    grown_mb: float = float("nan")
    """Growth of the peak resident memory, MB; only of :func:`measured`."""


@contextmanager
def timed() -> Iterator[Taken]:
    """Measure the time of a block."""
    taken = Taken()
    wall_s, cpu_s = time.perf_counter(), time.process_time()
    try:
        yield taken
    finally:
        taken.wall_s, taken.cpu_s = time.perf_counter() - wall_s, time.process_time() - cpu_s


@contextmanager
def measured() -> Iterator[Taken]:
    """Measure the time and the growth of the peak memory of a block, on Linux."""
    Path("/proc/self/clear_refs").write_text("5")  # resets the peak
    before = memory_bytes("VmRSS")
    with timed() as taken:
        yield taken
    taken.grown_mb = (memory_bytes("VmHWM") - before) / 1e6


def memory_bytes(field: str) -> int:
    """Resident memory of this process, bytes: now (`VmRSS`) or its peak (`VmHWM`). -1 on systems other than Linux.

    ``ru_maxrss`` is not used: a child process inherits its parent's.
    """
    status = Path("/proc/self/status")
    if not status.exists():
        return -1
    (line,) = (line for line in status.read_text().splitlines() if line.startswith(f"{field}:"))
    return 1024 * int(line.split()[1])


def return_freed_memory() -> None:
    """Make the C library return large freed blocks to the system, since reused ones would hide a part of the peak.

    An environment variable would come too late for a process that is forked.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None).mallopt(_M_MMAP_THRESHOLD, 1_000_000)


def in_new_process(function: str, *arguments: Any) -> Any:
    """Result of ``module:function`` in a separate process. Arguments and result are passed as JSON.

    Raises
    ------
    RuntimeError
        If the process fails.
    """
    command = [sys.executable, "-m", "bench.measure", function, json.dumps(arguments)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise RuntimeError(failure(done))
    return json.loads(done.stdout.splitlines()[-1])


def failure(done: subprocess.CompletedProcess[str]) -> str:
    """Describe in one line why a process failed."""
    if done.returncode < 0:
        return f"killed by signal {-done.returncode}" + (" (out of memory?)" if done.returncode == -9 else "")
    lines = done.stderr.strip().splitlines() or [f"exit status {done.returncode}"]
    return lines[-1]


if __name__ == "__main__":
    module, _, name = sys.argv[1].partition(":")
    return_freed_memory()
    print(json.dumps(getattr(importlib.import_module(module), name)(*json.loads(sys.argv[2])), default=float))
