"""Calls of the command line within this process."""

import json

from radarsdf.cli import main

FAST = [
    *("--set", "training.sdf_iterations=40"),
    *("--set", "training.intensity_iterations=20"),
    *("--set", "training.batch_size=1024"),
    "--quiet",
]
"""Options of a fit that takes about a second."""
QUICK = ["--quick", "--quiet", "--no-check"]


def call(*words):
    """Exit status of a command. Arguments may also be paths or numbers."""
    return main([str(word) for word in words])


def values(capsys, *words):
    """The object that a command prints with --json, and nothing else on standard output."""
    capsys.readouterr()
    assert call(*words, "--json") == 0
    return json.loads(capsys.readouterr().out)


def files(folder):
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())


def refusal(capsys, folder, *words, status=1):
    """The error of a command that must fail: checks its status, a single line, and that no file is written to the folder."""
    before = files(folder)
    capsys.readouterr()
    assert call(*words) == status
    printed = capsys.readouterr()
    assert printed.err.startswith("error: ")
    assert printed.err.count("\n") == 1
    assert printed.out == ""
    assert files(folder) == before
    return printed.err
