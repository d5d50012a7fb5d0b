# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Install VDBFusion in its own environment: `python -m bench.peers.install [PYTHON]`.

Its wheels (0.1.6) need CPython 3.8 to 3.10 and NumPy below 2. PYTHON names the interpreter; the default is the first
suitable one on the path or of pyenv. Open3D comes with the extra `peers` instead.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from .interface import VDBFUSION_ENVIRONMENT

_VERSIONS = ("3.10", "3.9", "3.8")


def _candidates() -> Iterator[str]:
    if len(sys.argv) > 1:
        yield sys.argv[1]
        return
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv"))
    for version in _VERSIONS:
        yield f"python{version}"
        yield from map(str, sorted(pyenv.glob(f"versions/{version}.*/bin/python")))


def _runs(python: str) -> bool:
    """Whether the command runs a suitable Python. A version manager may provide the command without the version."""
    code = "import sys; sys.exit(not (3, 8) <= sys.version_info < (3, 11))"
    try:
        return subprocess.run([python, "-c", code], capture_output=True, check=False).returncode == 0
    except OSError:
        return False


def main() -> None:
    python = next(filter(_runs, _candidates()), None)
    if python is None:
        sys.exit(f"VDBFusion needs CPython {', '.join(_VERSIONS)}: give its command as the argument")
    subprocess.run([python, "-m", "venv", "--clear", str(VDBFUSION_ENVIRONMENT)], check=True)
    pip = [str(VDBFUSION_ENVIRONMENT / "bin" / "python"), "-m", "pip", "install", "--quiet"]
    subprocess.run([*pip, "vdbfusion==0.1.6", "numpy<2"], check=True)
    print(f"VDBFusion is in {VDBFUSION_ENVIRONMENT}")


if __name__ == "__main__":
    main()
