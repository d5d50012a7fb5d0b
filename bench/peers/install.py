# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Make VDBFusion's environment: `python -m bench.peers.install [PYTHON]`.

Its wheels (0.1.6) are for CPython up to 3.10 and want NumPy below 2, so it gets an environment of its own, of the named
Python or the first fitting one on the path or among pyenv's. Open3D comes with the extra `peers` instead.
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
    """Whether it is there and a version that the wheels are for; a version manager's stand-in may have none behind it."""
    code = "import sys; sys.exit(not (3, 8) <= sys.version_info < (3, 11))"
    try:
        return subprocess.run([python, "-c", code], capture_output=True, check=False).returncode == 0
    except OSError:
        return False


def main() -> None:
    python = next(filter(_runs, _candidates()), None)
    if python is None:
        sys.exit(f"VDBFusion needs a CPython of {', '.join(_VERSIONS)}: name one as the argument")
    subprocess.run([python, "-m", "venv", "--clear", str(VDBFUSION_ENVIRONMENT)], check=True)
    pip = [str(VDBFUSION_ENVIRONMENT / "bin" / "python"), "-m", "pip", "install", "--quiet"]
    subprocess.run([*pip, "vdbfusion==0.1.6", "numpy<2"], check=True)
    print(f"VDBFusion is in {VDBFUSION_ENVIRONMENT}")


if __name__ == "__main__":
    main()
