"""Runner of all experiments: an :class:`Experiment` lays out the rows that its function yields.

Rows are printed as they come, and written as JSON with everything needed to repeat them, and as Markdown tables.
"""

import argparse
import json
import platform
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from radarsdf import _core
from radarsdf.evaluation.predictions import CALIBRATION_PROTOCOL, INTENSITY_PROTOCOL
from radarsdf.evaluation.surface import PROTOCOL

from bench.measure import ROOT
from scenes.scene import Scene, load_scene
from scenes.settings import parsed

Row = dict[str, Any]
"""Numbers and words of one result. `why_not` is the reason of a missing result."""


class Column(NamedTuple):
    """Format of one number of the rows."""

    heading: str
    factor: float = 1
    """Factor to the unit of the heading."""
    digits: int = 2
    best: str = ""
    """Which value is bold: "highest", "lowest" or none."""


@dataclass(frozen=True)
class Experiment:
    """A function that yields rows, and the layout of their tables."""

    title: str
    rows: Callable[[argparse.Namespace], Iterable[Row]]
    cases: Sequence[str] = ()
    """Default cases: scenes, files or sizes."""
    options: Sequence[str] = ()
    """Names in `OPTIONS`, in addition to those common to all experiments."""
    defaults: Mapping[str, Any] = field(default_factory=dict)
    """Defaults of the options."""
    columns: Mapping[str, Column] = field(default_factory=dict)
    """Columns by key of the rows; keys without a column are omitted. Empty: the keys of the rows are the headings."""
    tables: Sequence[str] = ()
    """Keys; each combination of their values gets its own table."""
    lines: Sequence[str] = ("method",)
    """Keys that identify the lines of a table. Rows with equal values are repetitions."""
    across: str = ""
    """Key whose values are side by side in a line."""
    median: bool = False
    """Show medians of repetitions instead of mean ± standard deviation."""
    mean_line: bool = False
    """Append the mean of all complete lines."""
    plot: Callable[[list[Row], Path], None] | None = None


def _number(text: str) -> int:
    return int(float(text))


OPTIONS: dict[str, dict[str, Any]] = {
    "seed": {"type": int, "default": 0, "help": "seed of simulated scenes"},
    "repetitions": {"type": int, "default": 1, "help": "fits with other seeds; some experiments also change the scene's"},
    "samples": {"type": _number, "default": 10_000_000, "help": "points on a mesh for its errors"},
    "frames": {"type": int, "help": "number of scans of each scene; default: all"},
    "peers": {"nargs": "+", "metavar": "PEER", "help": "methods to compare"},
    "base": {"nargs": "+", "choices": ("default", "paper"), "default": ["default", "paper"], "help": "presets"},
    "box": {
        "type": float, "nargs": 6, "metavar": ("X0", "Y0", "Z0", "X1", "Y1", "Z1"),
        "help": "region for the surface errors, world frame, m",
    },
    "set": {
        "nargs": "+", "action": "append", "default": [], "metavar": "NAME=VALUE",
        "help": "one more fit with these settings, such as training.optimiser=adam or mesh.min_confidence=0; repeatable",
    },
    "meshes": {"type": Path, "metavar": "FOLDER", "help": "write each mesh, and a picture of it"},
    "threads": {"type": int, "nargs": "+", "default": [1], "help": "numbers of threads"},
    "returns": {"type": _number, "nargs": "+", "help": "numbers of returns"},
    "sizes": {"type": float, "nargs": "+", "help": "lengths of the street, m"},
    "drift": {
        "type": float, "nargs": 2, "metavar": ("M", "DEG"), "default": (0.0, 0.0), "help": "random walk of the poses, a step"
    },
    "refine": {"action": "store_true", "help": "refine the poses of both drives"},
    "against": {"type": Path, "metavar": "PATH", "help": "another version: a wheel, or a checkout built in place"},
    "seeds": {"type": int, "nargs": "*", "help": "seeds of simulated scenes"},
}  # fmt: skip


def main(
    module: str, experiments: Mapping[str, Experiment] | Experiment, words: list[str] | None = None
) -> None:
    """Run the experiment named by the command line, and write its rows and tables.

    Parameters
    ----------
    module : str
        The command is ``python -m MODULE``.
    experiments : Mapping or Experiment
        Experiments by name, or the only one.
    words : list of str, optional
        Words of the command line. Default: those of this process.
    """
    parser = argparse.ArgumentParser(prog=f"python -m {module}")
    if isinstance(experiments, Experiment):
        name, experiment = module.rpartition(".")[2], experiments
        _add_options(parser, experiment)
        options = parser.parse_args(words)
    else:
        commands = parser.add_subparsers(dest="experiment", required=True)
        for known, own in experiments.items():
            _add_options(commands.add_parser(known, help=own.title, description=own.title), own)
        options = parser.parse_args(words)
        name = f"{module.rpartition('.')[2]}-{options.experiment}"
        experiment = experiments[options.experiment]
    options.cases = options.cases or list(experiment.cases)
    options.out.mkdir(parents=True, exist_ok=True)
    try:
        options.set = [parsed(settings) for settings in getattr(options, "set", [])]
        run(experiment, options, options.out / name, provenance(module, words))
    except (ValueError, OSError) as error:
        sys.exit(f"error: {error}")


def _add_options(parser: argparse.ArgumentParser, experiment: Experiment) -> None:
    cases = ", ".join(experiment.cases)
    parser.add_argument(
        "cases", nargs="*", metavar="CASE", help=f"default: {cases}" if cases else "see bench/README.md"
    )
    parser.add_argument(
        "--out", type=Path, default=Path("bench_results"), help="folder; default: %(default)s"
    )
    parser.add_argument(
        "--quick", action="store_true", help="only check that it runs: the numbers are meaningless"
    )
    for name in experiment.options:
        parser.add_argument(f"--{name}", **OPTIONS[name])
    parser.set_defaults(**experiment.defaults)


def chosen_scenes(options: argparse.Namespace) -> Iterator[Scene]:
    """Yield the scenes of a command line; four scans of each in a quick run."""
    for spec in options.cases:
        frames = getattr(options, "frames", None) or (4 if options.quick else None)
        yield load_scene(spec, frames=frames, seed=options.seed, box=getattr(options, "box", None))


def run(experiment: Experiment, options: argparse.Namespace, stem: Path, made: dict[str, Any]) -> None:
    """Run an experiment. Its results are at `stem` with the suffixes .json, .md and, if it has a plot, .png."""
    rows: list[Row] = []
    for row in experiment.rows(options):
        rows.append(row)
        names = {*experiment.tables, *experiment.lines, experiment.across, *experiment.columns, "why_not"}
        shown = [key for key in row if not experiment.columns or (key in names and row[key] is not None)]
        print(", ".join(f"{key} {_text(row[key])}" for key in shown), flush=True)
        # Written after each row, so that an interrupted run of hours keeps its rows.
        write_json(stem.with_suffix(".json"), made | {"rows": rows})
    warning = ", quick run: the numbers are meaningless" if options.quick else ""
    origin = f"`{made['command']}`, commit {made['commit']}, {made['processor']}, {made['threads']} threads"
    protocols = f"{origin}; protocols {', '.join(made['protocols'])}."
    text = "\n\n".join([f"## {experiment.title}{warning}", tables(experiment, rows), protocols]) + "\n"
    stem.with_suffix(".md").write_text(text, encoding="utf-8")
    if experiment.plot is not None:
        experiment.plot(rows, stem.with_suffix(".png"))
    print(f"\n{text}\nwritten: {stem}.md, .json")


def _text(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def tables(experiment: Experiment, rows: Sequence[Row]) -> str:
    """Format an experiment's tables in Markdown, each followed by the reasons of missing results."""
    parts = []
    for names, own in groups(rows, *experiment.tables).items():
        if heading := ", ".join(str(name) for name in names if name is not None):
            parts.append(f"### {heading}")
        known = [row for row in own if not row.get("why_not")]
        if known:
            parts.append(_table(experiment, known))
        missing = [
            f"- {', '.join(str(row[key]) for key in experiment.lines if key in row)}: {row['why_not']}"
            for row in own
            if row.get("why_not")
        ]
        parts += ["\n".join(dict.fromkeys(missing))] if missing else []
    return "\n\n".join(parts)


def _table(experiment: Experiment, rows: Sequence[Row]) -> str:
    if not experiment.columns:
        return markdown(list(rows[0]), [[str(value) for value in row.values()] for row in rows])
    keys = [key for key in experiment.lines if any(row.get(key) is not None for row in rows)]
    lines = groups(rows, *keys)
    across = list(groups(rows, experiment.across)) if experiment.across else [()]
    header, values = list(keys), []
    for key, column in experiment.columns.items():
        if all(row.get(key) is None for row in rows):
            continue
        header += [", ".join([column.heading, *map(str, names)]) for names in across]
        for names in across:
            of_column = []
            for own in lines.values():
                same = [row for row in own if not names or (row.get(experiment.across),) == names]
                of_column.append([column.factor * row[key] for row in same if row.get(key) is not None])
            values.append((column, of_column))
    names_of_lines = [["" if name is None else str(name) for name in names] for names in lines]
    if experiment.mean_line:
        complete = [i for i in range(len(lines)) if all(cells[i] for _, cells in values)]
        for _, cells in values:
            cells.append([float(np.mean([np.mean(cells[i]) for i in complete]))] if complete else [])
        names_of_lines.append(["mean", *[""] * (len(keys) - 1)])
    texts = [[_cell(cell, column.digits, experiment.median) for cell in cells] for column, cells in values]
    _set_bold(texts, values, by_line=bool(experiment.across))
    cells_of_lines = list(zip(*texts, strict=True)) or [()] * len(names_of_lines)
    return markdown(
        header, [[*names, *own] for names, own in zip(names_of_lines, cells_of_lines, strict=True)]
    )


def _cell(values: list[float], digits: int, median: bool) -> str:
    """Format mean and standard deviation, such as `3.24 ± 0.04`, or the median."""
    if not values:
        return "–"
    text = f"{np.median(values) if median else np.mean(values):,.{digits}f}"
    return text if median or len(values) == 1 else f"{text} ± {np.std(values, ddof=1):.{digits}f}"


def _set_bold(
    texts: list[list[str]], values: list[tuple[Column, list[list[float]]]], *, by_line: bool
) -> None:
    """Set the best value and its ties in bold: in each column, or among equal columns side by side in each line."""
    for heading in dict.fromkeys(column.heading for column, _ in values):
        own = [i for i, (column, _) in enumerate(values) if column.heading == heading]
        best = values[own[0]][0].best
        if not best:
            continue
        places = [(i, j) for i in own for j in range(len(texts[i]))]
        for line in sorted({j for _, j in places}) if by_line else [None]:
            known = [(i, j) for i, j in places if (line is None or j == line) and values[i][1][j]]
            if not known:
                continue
            choose = max if best == "highest" else min
            first = choose(known, key=lambda place: np.mean(values[place[0]][1][place[1]]))
            text = texts[first[0]][first[1]]
            for i, j in known:
                if texts[i][j] == text:
                    texts[i][j] = f"**{text}**"


def groups(rows: Iterable[Row], *keys: str) -> dict[tuple[Any, ...], list[Row]]:
    """Group rows by the values of `keys`, in the order of each group's first row."""
    found: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        found.setdefault(tuple(row.get(key) for key in keys), []).append(row)
    return found


def markdown(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Format a Markdown table with aligned columns."""
    table = [list(header), *(list(row) for row in rows)]
    widths = [max(len(row[i]) for row in table) for i in range(len(header))]
    lines = [
        "| " + " | ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) + " |"
        for row in table
    ]
    return "\n".join([lines[0], "|" + "|".join("-" * (width + 2) for width in widths) + "|", *lines[1:]])


def quantile(values: Sequence[float], share: float) -> float:
    """Quantile of values as a number for a row."""
    return round(float(np.quantile(values, share)), 2)


def provenance(module: str, words: Sequence[str] | None = None) -> dict[str, Any]:
    """Command, commit, machine and versions."""
    return {
        "command": shlex.join(["python", "-m", module, *(sys.argv[1:] if words is None else words)]),
        "commit": _commit(),
        "protocols": [PROTOCOL, INTENSITY_PROTOCOL, CALIBRATION_PROTOCOL],
        "processor": _processor(),
        "threads": torch.get_num_threads(),
        "instruction_set": _core.instruction_set(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "compiler": _core.compiler(),
    }


def _commit() -> str:
    try:
        git = ["git", "-C", str(ROOT), "describe", "--always", "--dirty", "--abbrev=10"]
        return subprocess.run(git, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()


def write_json(path: Path, values: dict[str, Any]) -> None:
    """Write `values` as JSON. Arrays become lists, and numbers that are not finite become null."""

    def plain(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: plain(item) for key, item in value.items()}
        if isinstance(value, (list, tuple, np.ndarray)):
            return [plain(item) for item in value]
        if isinstance(value, (float, np.floating)):
            return float(f"{value:.6g}") if np.isfinite(value) else None
        return value.item() if isinstance(value, np.generic) else value

    path.write_text(json.dumps(plain(values), indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


@contextmanager
def figure(
    path: Path, rows: int = 1, columns: int = 1, size: tuple[float, float] = (5, 3.6)
) -> Iterator[Any]:
    """Yield axes (rows, columns) of a plot that is written to `path` at the end of the block."""
    from matplotlib.figure import Figure  # noqa: PLC0415 - tables need no matplotlib

    drawing = Figure(figsize=(size[0] * columns, size[1] * rows), layout="constrained")
    axes = drawing.subplots(rows, columns, squeeze=False)
    yield axes
    for ax in axes.flat:
        ax.grid(alpha=0.3)
        if ax.get_legend_handles_labels()[0]:
            ax.legend(fontsize=7)
    drawing.savefig(path, dpi=130)
