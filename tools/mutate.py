"""Puts faults into the package or the core at random, one at a time, and says which of them the tests catch.

    python tools/mutate.py --count 100 --seed 1
    python tools/mutate.py --count 10 --seed 1 --core

A fault is one operator, comparison or number that is another one. The tests of the module that it is in run first, then
those of its room, and all tests if none of those fails (``--room-only``: they do not). What no test catches is printed
with its line: a test is missing, or the line says the same as before. The work is done in a clone below a temporary
folder. With ``--core``, each fault is compiled there, and the C++ tests, which need doctest, and ``tests/core`` run, too.
"""

import argparse
import ast
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

OTHER: dict[type[ast.AST], str] = {
    ast.Add: "-", ast.Sub: "+", ast.Mult: "/", ast.Div: "*", ast.FloorDiv: "/",
    ast.Lt: "<=", ast.LtE: "<", ast.Gt: ">=", ast.GtE: ">", ast.Eq: "!=", ast.NotEq: "==",
    ast.Is: "is not", ast.IsNot: "is", ast.And: "or", ast.Or: "and", ast.BitAnd: "|", ast.BitOr: "&",
}  # fmt: skip
OTHER_IN_CORE = {
    "+": "-", "-": "+", "*": "/", "/": "*", "<": "<=", "<=": "<", ">": ">=", ">=": ">", "==": "!=", "!=": "==",
    "&&": "||", "||": "&&",
}  # fmt: skip
# clang-format puts spaces round operators, and none beside pointers and arguments of templates.
_IN_CORE = re.compile(
    r"(?<=[\w)\]]) (?P<operator>[-+*/]|[<>]=?|[!=]=|&&|\|\|) (?=[\w(!-])"
    r"|(?<![\w.<])(?P<number>\d+(\.\d+)?(e-?\d+)?[fu]?)(?![\w.>])"
)
SECONDS = 900


class Fault(NamedTuple):
    """`new` instead of `old`, which begins at a character of a file's source."""

    file: Path
    line: int
    begin: int
    old: str
    new: str


def faults_in(file: Path) -> Iterator[Fault]:
    """All faults that can be put into a file."""
    source = file.read_text(encoding="utf-8")
    starts = [0]
    for line in source.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))

    def place(line: int, column_bytes: int) -> int:
        text = source[starts[line - 1] : starts[line]]
        return starts[line - 1] + len(text.encode()[:column_bytes].decode())

    def between(left: ast.expr, right: ast.expr, operator: ast.AST, line: int) -> Iterator[Fault]:
        begin = place(left.end_lineno or 0, left.end_col_offset or 0)
        end = place(right.lineno, right.col_offset)
        old = source[begin:end]
        if type(operator) in OTHER and "#" not in old and "\n" not in old:
            brackets = [old[: len(old) - len(old.lstrip(") "))], old[len(old.rstrip("( ")) :]]
            yield Fault(file, line, begin, old, f"{brackets[0]}{OTHER[type(operator)]}{brackets[1]}")

    tree = ast.parse(source)
    for node in _executed(tree):
        if isinstance(node, ast.Compare) and len(node.ops) == 1:
            yield from between(node.left, node.comparators[0], node.ops[0], node.lineno)
        elif isinstance(node, ast.BinOp) and not isinstance(node.left, ast.JoinedStr):
            yield from between(node.left, node.right, node.op, node.lineno)
        elif isinstance(node, ast.BoolOp):
            yield from between(node.values[0], node.values[1], node.op, node.lineno)
        elif isinstance(node, ast.Constant) and type(node.value) in (int, float, bool):
            old = ast.get_source_segment(source, node) or ""
            new = str(not node.value) if isinstance(node.value, bool) else f"({old} + 1)"
            yield Fault(file, node.lineno, place(node.lineno, node.col_offset), old, new)


def _executed(node: ast.AST) -> Iterator[ast.AST]:
    """The nodes below `node` without annotations, which nothing executes."""
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns"):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST):
                yield child
                yield from _executed(child)


def faults_in_core(file: Path) -> Iterator[Fault]:
    """As :func:`faults_in`, for a file of C++. Lines with texts are left out."""
    begin = 0
    for number, line in enumerate(file.read_text(encoding="utf-8").splitlines(keepends=True), start=1):
        code = line.split("//")[0]
        if '"' not in code and not code.lstrip().startswith(("#", "static_assert")):
            for match in _IN_CORE.finditer(code):
                kind = match.lastgroup or "number"
                old = match[kind]
                new = OTHER_IN_CORE[old] if kind == "operator" else f"({old} + 1)"
                yield Fault(file, number, begin + match.start(kind), old, new)
        begin += len(line)


def compiled(clone: Path) -> bool:
    """Whether the core of the clone compiles. The package in it finds what was compiled."""
    build = clone / "build/dev"
    if not build.exists():
        pybind11 = subprocess.check_output(
            [sys.executable, "-m", "pybind11", "--cmakedir"], text=True
        ).strip()
        options = [
            f"-Dpybind11_DIR={pybind11}",
            f"-DPython_EXECUTABLE={sys.executable}",
            "-DRADARSDF_TESTS=ON",
        ]
        subprocess.run(
            ["cmake", "-S", clone, "-B", build, "-G", "Ninja", *options], check=True, capture_output=True
        )
    if subprocess.run(["cmake", "--build", build], check=False, capture_output=True).returncode:
        return False
    for module in (build / "csrc/bindings").glob("_core*.so"):
        shutil.copy(module, clone / "python/radarsdf")
    return True


def caught_in_core(clone: Path) -> str | None:
    """The first C++ test that fails, or None. They take a second, and catch every second fault."""
    command = ["ctest", "--test-dir", clone / "build/dev", "--timeout", "60"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode == 0:
        return None
    failed = re.search(r"(\w+_test) \.*\*\*\*", done.stdout)
    return f"FAILED {failed[1]}" if failed else f"exit {done.returncode} of ctest"


def tests_of(fault: Fault, clone: Path) -> Iterator[list[str]]:
    """The tests of the fault's module, then those of its room; of a fault in the core, those of the core, too."""
    in_core = fault.file.suffix != ".py"
    room = fault.file.relative_to(clone / ("csrc" if in_core else "python/radarsdf")).parts[0]
    folders = [clone / "tests" / name for name in (["core", room] if in_core else [room])]
    for files in (sorted(folder.glob(f"test_{fault.file.stem}.py")) for folder in folders):
        if files:
            yield [str(file) for file in files]
    if rooms := [str(folder) for folder in folders if folder.is_dir()]:
        yield rooms


def caught_by(clone: Path, tests: list[str], processes: int) -> str | None:
    """The first test that fails, or None."""
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-x",
        f"--numprocesses={processes}",
        "--dist=loadfile",
        *tests,
    ]
    environment = {**os.environ, "PYTHONPATH": str(clone / "python")}
    try:
        done = subprocess.run(
            command, cwd=clone, env=environment, capture_output=True, text=True, timeout=SECONDS, check=False
        )
    except subprocess.TimeoutExpired:
        return f"more than {SECONDS} s"
    if done.returncode == 0:
        return None
    failed = [line for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
    return failed[0].split(" - ")[0] if failed else f"exit {done.returncode}"


def main() -> None:
    """Runs the tests with each fault."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--count", type=int, default=100, help="number of faults [100]")
    parser.add_argument("--seed", type=int, default=0, help="which faults [0]")
    parser.add_argument("--processes", type=int, default=2, help="of pytest [2]")
    parser.add_argument("--room-only", action="store_true", help="run only the tests of the fault's room")
    parser.add_argument("--core", action="store_true", help="put the faults into the core")
    options = parser.parse_args()
    root = Path(__file__).resolve().parents[1]
    with tempfile.TemporaryDirectory() as folder:
        clone = Path(folder) / "radarsdf"
        subprocess.run(["git", "clone", "-q", str(root), str(clone)], check=True)
        if options.core:
            every = [
                fault for file in sorted(clone.glob("csrc/*/*.[ch]pp")) for fault in faults_in_core(file)
            ]
        else:
            for module in (root / "python/radarsdf").glob("_core*.so"):
                shutil.copy(module, clone / "python/radarsdf")
            files = sorted(clone.glob("python/radarsdf/**/*.py"))
            every = [fault for file in files for fault in faults_in(file)]
        tried = missed = 0
        for fault in random.Random(options.seed).sample(every, options.count):
            source = fault.file.read_text(encoding="utf-8")
            end = fault.begin + len(fault.old)
            fault.file.write_text(source[: fault.begin] + fault.new + source[end:], encoding="utf-8")
            test: str | None = "does not compile, and does not count"
            if not options.core or compiled(clone):
                tests = list(tests_of(fault, clone))
                if not options.room_only:
                    tests.append([str(clone / "tests")])
                found = (caught_by(clone, some, options.processes) for some in tests)
                test = (caught_in_core(clone) if options.core else None) or next(filter(None, found), None)
                tried += 1
                missed += test is None
            fault.file.write_text(source, encoding="utf-8")
            where = f"{fault.file.relative_to(clone)}:{fault.line}"
            print(f"{where}: {fault.old!r} -> {fault.new!r}: {test or 'MISSED'}", flush=True)
        print(f"caught {tried - missed} of {tried}")


if __name__ == "__main__":
    main()
