# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""What Windows and macOS lack, or do otherwise: the tests take it away here."""

import subprocess
import sys
from pathlib import Path

import pytest
from radarsdf.io.files import write_whole

# Modules and functions of Python that only POSIX has.
MODULES = ("fcntl", "grp", "pty", "pwd", "resource", "syslog", "termios")
FUNCTIONS = ("fork", "register_at_fork", "sched_getaffinity", "getuid", "statvfs")
SIGNALS = ("SIGKILL", "SIGHUP", "SIGALRM", "setitimer", "pthread_sigmask")


def test_every_module_is_imported_and_a_fit_works_without_what_only_posix_has():
    code = f"""
import importlib, os, pkgutil, signal, sys
import numpy, pydantic, scipy, torch, trimesh  # which may use what they find
for name in {MODULES}:
    sys.modules[name] = None
for module, names in ((os, {FUNCTIONS}), (signal, {SIGNALS})):
    for name in names:
        if hasattr(module, name):
            delattr(module, name)
import radarsdf
extras = ("radarsdf.view", "radarsdf.report", "radarsdf.__main__")
for module in pkgutil.walk_packages(radarsdf.__path__, "radarsdf."):
    if not module.name.startswith(extras):
        importlib.import_module(module.name)
scans = radarsdf.simulate.wall(frames=2)
radar_map = radarsdf.fit(scans.points, scans.poses, config=radarsdf.FitConfig.quick())
assert len(radar_map.mesh(0.2).faces)
"""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr


def test_a_file_that_another_program_has_open_stays(tmp_path, monkeypatch):
    """Windows refuses to replace it."""
    path = tmp_path / "map.safetensors"
    path.write_bytes(b"old")

    def refuse(self, target):
        raise PermissionError(13, "The process cannot access the file", str(self), 32, str(target))

    monkeypatch.setattr(Path, "replace", refuse)
    with pytest.raises(PermissionError, match=r"map\.safetensors"):
        write_whole(path, b"new")
    assert path.read_bytes() == b"old"
    assert [file.name for file in tmp_path.iterdir()] == ["map.safetensors"]
