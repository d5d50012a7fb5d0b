# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The JSON of a run: where it was made, and how a part of a run joins the rest.

It has these keys: `format`, `commit`, `date`, `quick`, `machine` and `experiments`. An experiment has its `command`, the
`seconds` that it took and its `rows`. Where something failed, `why_not` says why: of an experiment, or of a row.
A `note`, where there is one, is shown at the top of the document.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import subprocess
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from bench.paper.report import ROOT, provenance

Results = dict[str, Any]
Row = dict[str, Any]

FORMAT = 1
# What a run measures. A change of anything else does not make it a run of changed files.
_MEASURED = ("python", "csrc", "cmake", "bench", "CMakeLists.txt", "constraints.txt", "pyproject.toml")
_NOT_MEASURED = (":(exclude)bench/results.json", ":(exclude)bench/README.md")
_MACHINE = ("processor", "threads", "instruction_set", "python", "torch", "compiler")


def begin(*, quick: bool) -> Results:
    """Results without an experiment, of the commit and machine that this process runs on."""
    made = provenance()
    machine = {key: made[key] for key in _MACHINE}
    machine |= {"cores": _cores(), "memory_gb": _memory_gb(), "system": platform.system()}
    today = datetime.now(timezone.utc).date().isoformat()
    return {
        "format": FORMAT,
        "commit": commit(),
        "date": today,
        "quick": quick,
        "machine": machine,
        "experiments": {},
    }


def commit() -> str:
    """The commit of the files, with `-dirty` where what is measured was changed since; `unknown` without git."""
    try:
        name = _git("rev-parse", "--short=10", "HEAD").strip()
        changed = _git("status", "--porcelain", "--", *_MEASURED, *_NOT_MEASURED).strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return f"{name}-dirty" if changed else name


def merge(old: Results, new: Results, *, same_process: bool = False) -> Results:
    """The experiments of both; where both have one, the new one.

    Raises
    ------
    ValueError
        Where they are not of one commit, of one machine, and both quick or both not. Where the commit does not tell
        what the files were, only a process may join what it measured itself.
    """
    for key in ("format", "commit", "quick", "machine"):
        if old[key] != new[key]:
            msg = f"results of another {key} cannot be merged: {old[key]} is in the file, {new[key]} is here"
            raise ValueError(msg)
    if not same_process and (new["commit"] == "unknown" or new["commit"].endswith("-dirty")):
        msg = f"results of commit {new['commit']} cannot be merged: nobody knows if the files were the same"
        raise ValueError(msg)
    return new | {"experiments": old["experiments"] | new["experiments"]}


def read(path: Path) -> Results:
    """Results from a file.

    Raises
    ------
    ValueError
        Where it is not a file of results.
    OSError
        Where it cannot be read.
    """
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
        found = values["format"]
    except (ValueError, TypeError, KeyError) as error:
        msg = f"{path} does not hold results of bench.report: {error!r}"
        raise ValueError(msg) from error
    if found != FORMAT:
        msg = f"{path} has format {found}, and not {FORMAT}"
        raise ValueError(msg)
    results: Results = values
    return results


def digest(results: Results) -> str:
    """A short name for exactly these results: the plots carry it, so that an old plot is found out."""
    text = json.dumps(results, sort_keys=True, ensure_ascii=False)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _git(*words: str) -> str:
    return subprocess.run(["git", "-C", str(ROOT), *words], capture_output=True, text=True, check=True).stdout


def _cores() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _memory_gb() -> int | None:
    try:
        return round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9)
    except (ValueError, OSError, AttributeError):
        return None
