# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""`radarsdf view`."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
import urllib.request

import pytest

from ..warm_python import warm_python
from .calls import refusal


def test_what_to_install(map_file, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    said = refusal(capsys, tmp_path, "view", map_file)
    assert said == 'radarsdf view: the viewer needs viser: pip install "viser>=1.1"\n'


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--port", 70000], "--port must be at least 0 and at most 65535"),
        (["--host", "192.0.2.1"], "--host takes an address of this machine"),
        (["--box", 900, 900, 900, 901, 901, 901], "no surface here"),
        (["--voxel", 0], "voxel"),
        (["--max-vertices", 2], "max_vertices must be at least 1000"),
        (["absent.npz"], "absent.npz"),
    ],
)
def test_words_that_are_wrong(map_file, tmp_path, capsys, words, said):
    pytest.importorskip("viser", reason="the extra view is not installed")
    assert said in refusal(capsys, tmp_path, "view", map_file, *words, "--no-open", "--quiet")


def test_a_port_in_use(map_file, tmp_path, capsys):
    pytest.importorskip("viser", reason="the extra view is not installed")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        said = refusal(capsys, tmp_path, "view", map_file, "--port", port)
    assert f"cannot listen on 127.0.0.1, port {port}: Address already in use; --port takes another" in said


@pytest.mark.skipif(sys.platform == "win32", reason="sends the signal of Ctrl-C")
def test_it_serves_until_ctrl_c(map_file, scans_file):
    pytest.importorskip("viser", reason="the extra view is not installed")
    command = [
        *warm_python(),
        "-m",
        "radarsdf",
        "view",
        map_file,
        scans_file,
        "--voxel",
        "0.3",
        "--port",
        "0",
    ]
    hidden = {name: value for name, value in os.environ.items() if "DISPLAY" not in name}
    process = subprocess.Popen(
        [*command, "--quiet"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=hidden
    )
    try:
        first, second, third = (process.stdout.readline() for _ in range(3))
        port = int(re.fullmatch(r"\d+ vertices on http://localhost:(\d+); Ctrl-C ends it\n", first)[1])
        assert third.startswith("the surface is kept from a confidence of 0.")
        assert second == (
            f"from elsewhere: ssh -L {port}:localhost:{port} {socket.gethostname()}, then http://localhost:{port}\n"
        )
        with urllib.request.urlopen(f"http://127.0.0.1:{port}") as page:
            assert b"<html" in page.read()
        process.send_signal(signal.SIGINT)
        assert process.communicate(timeout=30) == ("stopped\n", "")
        assert process.returncode == 0
    finally:
        process.kill()
        process.wait()
