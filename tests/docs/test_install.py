# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""README's commands ask for PyTorch without CUDA before anything else asks for PyTorch, and go on where it is out of reach."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

README = Path(__file__).resolve().parents[2] / "README.md"
INDEX = "https://download.pytorch.org/whl/cpu"
# Stands for python3, and for all that it puts into the environment: each says how it was called.
STAND_IN = f"""#!/bin/sh
echo "$(basename "$0") $*" >> calls
if [ "$1 $2" = "-m venv" ]; then mkdir -p "$3/bin" && for name in pip pytest radarsdf; do cp "$0" "$3/bin/$name"; done; fi
case "$*" in *{INDEX}*) exit "$STATUS_OF_INDEX" ;; esac
"""


@pytest.mark.skipif(
    sys.platform == "win32" or shutil.which("bash") is None, reason="the blocks of a shell are those of bash"
)
@pytest.mark.parametrize("status", ["0", "1"], ids=["index", "no index"])
@pytest.mark.parametrize(("name", "last"), [("demo", "radarsdf demo"), ("test", "pytest")])
def test_pytorch_comes_without_cuda_where_it_can(name, last, status, tmp_path):
    command = re.search(
        rf"<!-- ci: {name} -->\n```sh\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL
    )
    (tmp_path / "python3").write_text(STAND_IN, encoding="utf-8")
    (tmp_path / "python3").chmod(0o755)
    environment = os.environ | {
        "PATH": f"{tmp_path}{os.pathsep}{os.environ['PATH']}",
        "STATUS_OF_INDEX": status,
    }
    subprocess.run(["bash", "-euo", "pipefail", "-c", command[1]], cwd=tmp_path, env=environment, check=True)
    venv, pytorch, package, ran = (tmp_path / "calls").read_text(encoding="utf-8").splitlines()
    assert venv == "python3 -m venv .venv"
    # Its dependencies are left to the next line: pip would ask a network that drops packets once for each of them.
    assert shlex.split(pytorch)[:2] == ["pip", "install"]
    assert {"torch", "--no-deps", "constraints.txt"} < set(shlex.split(pytorch))
    assert pytorch.endswith(f"--index-url {INDEX}")
    assert package.startswith("pip install -c constraints.txt .[")
    assert INDEX not in package
    assert ran.strip() == last
