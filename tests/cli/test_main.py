# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What holds for every command: help, usage errors, errors, Ctrl-C."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
import radarsdf.cli.info
from radarsdf.cli import COMMANDS, main
from radarsdf.cli.tiles import STEPS

ANSWERED = """
import sys
before = set(sys.modules)
from radarsdf.cli import COMMANDS, main
try:
    main(sys.argv[1:])
except SystemExit as end:
    imported = set(sys.modules) - before
    foreign = {name.partition(".")[0] for name in imported} - sys.stdlib_module_names - {"radarsdf", "lazy_loader"}
    assert not foreign, foreign
    print("imported:", *(name for name in COMMANDS if f"radarsdf.cli.{name}" in imported))
    sys.exit(end.code)
"""


def answer(*words):
    """What help or a usage error says, and its status. Only the standard library, lazy_loader and modules of the command line may
    be imported for it; the last line names the commands among these."""
    done = subprocess.run(
        [sys.executable, "-c", ANSWERED, *words],
        capture_output=True,
        text=True,
        env=os.environ | {"COLUMNS": "200"},  # no line of a help text is broken
        timeout=60,
        check=False,
    )
    assert "Traceback" not in done.stderr, done.stderr
    return done


def test_help_lists_every_command_and_imports_none():
    done = answer("--help")
    assert done.returncode == 0
    said = " ".join(done.stdout.split())  # a long name has its text on the next line
    for name, text in COMMANDS.items():
        assert f" {name} {text} " in said
    assert done.stdout.splitlines()[-1] == "imported:"


def test_no_words_are_a_wish_for_help():
    done, asked = answer(), answer("--help")
    assert (done.returncode, done.stdout, done.stderr) == (0, asked.stdout, "")


def test_the_version(capsys):
    with pytest.raises(SystemExit) as end:
        main(["--version"])
    assert (end.value.code, capsys.readouterr().out) == (0, f"radarsdf {radarsdf.__version__}\n")


@pytest.mark.parametrize("step", STEPS)
def test_help_of_a_step(step):
    done = answer("tiles", step, "--help")
    assert done.returncode == 0
    assert f"usage: radarsdf tiles {step} " in done.stdout
    assert STEPS[step] in done.stdout
    assert ("--tile-size" in done.stdout) == (step == "plan")


def test_the_value_of_an_option_is_no_step():
    assert "usage: radarsdf tiles [-h] [--extrinsic" in answer("tiles", "-o", "plan", "--help").stdout


@pytest.mark.parametrize(
    "words", [["mesh"], ["view"], ["report"], ["eval"], ["demo"], ["tiles"], ["tiles", "mesh"]], ids=" ".join
)
def test_all_commands_that_make_a_mesh_have_the_options_of_one(words):
    said = answer(*words, "--help").stdout
    for option in ("--voxel M", "--min-confidence C", "--max-uncertainty M", "--min-component N", "--quiet"):
        assert f" {option}" in said


@pytest.mark.parametrize("command", COMMANDS)
def test_help_of_a_command_imports_this_one_only(command):
    done = answer(command, "--help")
    assert done.returncode == 0
    assert f"usage: radarsdf {command} " in done.stdout
    assert ("--out " in done.stdout) == ("-o OUT, --out OUT" in done.stdout)
    assert COMMANDS[command] in done.stdout
    assert done.stdout.splitlines()[-1] == f"imported: {command}"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["paint"], "invalid choice: 'paint'"),
        (["--paint"], "arguments are required: COMMAND"),
        (["fit"], "one of the arguments -o/--out --dry-run is required"),
        (["fit", "-o", "map"], "arguments are required: scans"),
        (["fit", "scans"], "one of the arguments -o/--out --dry-run is required"),
        (["fit", "scans", "-o", "map", "--dry-run"], "not allowed with"),
        (["fit", "scans", "-o", "map", "--quick", "--paper"], "not allowed with"),
        (["mesh", "map", "-o", "mesh", "--box", "1"], "--box: expected 6 arguments"),
        (["mesh", "map", "-o", "mesh", "--voxel", "x"], "invalid float value: 'x'"),
        (["view"], "arguments are required: map"),
        (["view", "map", "--port", "x"], "invalid int value: 'x'"),
        (["eval", "mesh"], "arguments are required: truth"),
        (["demo", "--scene", "moon"], "invalid choice: 'moon'"),
        (["tiles", "scans"], "arguments are required: -o/--out"),
        (["tiles", "plan"], "arguments are required: "),
        (["tiles", "fit"], "arguments are required: folder"),
        (["tiles", "clean", "city", "--quick"], "unrecognized arguments: --quick"),
        (["tiles", "a.npz", "b.txt", "c", "-o", "city"], "unrecognized arguments: c"),
        (["info", "map", "more"], "unrecognized arguments: more"),
    ],
)
def test_wrong_usage_is_status_2(words, said):
    done = answer(*words)
    assert done.returncode == 2
    assert done.stderr.startswith("usage: radarsdf ")
    assert said in done.stderr


def test_success_is_status_0(monkeypatch, capsys):
    monkeypatch.setattr(radarsdf.cli.info, "run", lambda _: None)
    assert main(["info"]) == 0
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("error", "status", "said"),
    [
        (ValueError("no such thing"), 1, "no such thing"),
        (
            FileNotFoundError(2, "No such file or directory", "scans.npz"),
            1,
            "scans.npz: there is no such file or folder",
        ),
        (OSError(28, "No space left on device"), 1, "No space left on device"),
        (ImportError("no matplotlib"), 1, "no matplotlib"),
        (FloatingPointError("the loss is nan"), 1, "the loss is nan"),
        (MemoryError("needs 80 GB"), 1, "needs 80 GB"),
        (MemoryError(), 1, "there is not enough memory"),
        (MemoryError("Unable to allocate 4.04 MiB for an array"), 1, "there is not enough memory"),
        (KeyboardInterrupt(), 130, "interrupted"),
        (radarsdf.Interrupted(), 130, "interrupted before the training"),
        (radarsdf.Diverged("the loss is inf"), 1, "the loss is inf"),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, BaseException) else "",
)
def test_an_error_is_one_line(monkeypatch, capsys, error, status, said):
    def fail(_):
        raise error

    monkeypatch.setattr(radarsdf.cli.info, "run", fail)
    assert main(["info"]) == status
    assert capsys.readouterr() == ("", f"radarsdf info: {said}\n")


def test_a_bug_keeps_its_traceback(monkeypatch):
    monkeypatch.setattr(radarsdf.cli.info, "run", lambda _: {}["missing"])
    with pytest.raises(KeyError, match="missing"):
        main(["info"])


def test_ctrl_c_during_the_imports_of_a_command():
    code = """
import importlib.abc, signal, sys
class Press(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name == "torch":
            signal.raise_signal(signal.SIGINT)
sys.meta_path.insert(0, Press())
from radarsdf.cli import main
sys.exit(main(["info"]))
"""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "radarsdf info: interrupted\n")
