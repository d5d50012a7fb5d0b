"""``radarsdf view`` and ``report``."""

import os
import re
import signal
import subprocess
import sys
import urllib.request

import pytest

from .calls import FAST, call, files, refusal


@pytest.mark.parametrize("command", ["fit", "report", "view"])
def test_missing_packages_are_named_before_the_work(
    command, scans_file, map_file, tmp_path, capsys, monkeypatch
):
    monkeypatch.setitem(sys.modules, "viser", None)
    monkeypatch.setattr("radarsdf.fitting.fit.static_rays", lambda *_, **__: pytest.fail("the work began"))
    page = tmp_path / "report.html"
    words = {
        "fit": [scans_file, "-o", tmp_path / "map.safetensors", "--report", page, *FAST],
        "report": [map_file, scans_file, "-o", page],
        "view": [map_file],
    }[command]
    assert 'pip install "viser' in refusal(capsys, tmp_path, command, *words)


@pytest.mark.usefixtures("small_pictures")
def test_a_fit_with_its_report(scans_file, tmp_path, capsys):
    out, page = tmp_path / "map.safetensors", tmp_path / "report.html"
    assert call("fit", scans_file, "-o", out, "--report", page, "--holdout", 3, *FAST) == 0
    printed = capsys.readouterr().out.splitlines()
    assert printed[-1].endswith(f" MB written to {page}")
    assert not [line for line in printed if "viser" in line]
    assert files(tmp_path) == ["map.safetensors", "report.html"]
    assert "<title>map.safetensors</title>" in page.read_text("utf-8")


@pytest.mark.usefixtures("small_pictures")
def test_a_report_of_a_map_and_scans(map_file, scans_file, tmp_path, capsys):
    page = tmp_path / "report.html"
    words = [map_file, scans_file, "-o", page, "--holdout", 3, "--voxel", 0.4, "--quiet"]
    assert call("report", *words, "--box", 8, -6, -1, 21, 6, 5) == 0
    assert "<title>map.safetensors</title>" in page.read_text("utf-8")
    assert "same file" in refusal(capsys, tmp_path, "report", map_file, scans_file, "-o", scans_file)


@pytest.mark.skipif(sys.platform == "win32", reason="sends the signal of Ctrl-C")
def test_it_serves_until_ctrl_c(map_file, scans_file):
    pytest.importorskip("viser", reason="the extra view is not installed")
    words = ["view", map_file, scans_file, "--voxel", "0.3", "--port", "0", "--quiet"]
    hidden = {name: value for name, value in os.environ.items() if "DISPLAY" not in name}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    process = subprocess.Popen([sys.executable, "-m", "radarsdf", *words], env=hidden, **pipes)
    try:
        port = int(re.search(r"http://localhost:(\d+); Ctrl-C ends it", process.stdout.readline())[1])
        with urllib.request.urlopen(f"http://127.0.0.1:{port}") as page:
            assert b"<html" in page.read()
        process.send_signal(signal.SIGINT)
        printed, complaints = process.communicate(timeout=30)
        assert printed.endswith("stopped\n")
        assert (complaints, process.returncode) == ("", 0)
    finally:
        process.kill()
        process.wait()
