"""Install peers in separate environments: `python -m bench.peers.install [PYTHON]` or `... install odometry`.

The first form installs VDBFusion, whose wheels (0.1.6) need CPython 3.8 to 3.10 and NumPy below 2. PYTHON is the interpreter;
the default is the first suitable one on the path or of pyenv. `odometry` is kiss-icp and small_gicp, for this interpreter.
Open3D comes with the extra `peers` instead.
"""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from .interface import ODOMETRY_ENVIRONMENT, VDBFUSION_ENVIRONMENT

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


def _install(python: str, environment: Path, *packages: str) -> None:
    subprocess.run([python, "-m", "venv", "--clear", str(environment)], check=True)
    pip = [str(environment / "bin" / "python"), "-m", "pip", "install", "--quiet"]
    subprocess.run([*pip, *packages], check=True)
    print(f"{', '.join(packages)}: in {environment}")


def main() -> None:
    if sys.argv[1:] == ["odometry"]:
        _install(sys.executable, ODOMETRY_ENVIRONMENT, "kiss-icp==1.3.0", "small_gicp==1.0.1")
        return
    python = next(filter(_runs, _candidates()), None)
    if python is None:
        sys.exit(f"VDBFusion needs CPython {', '.join(_VERSIONS)}: give its command as the argument")
    _install(python, VDBFUSION_ENVIRONMENT, "vdbfusion==0.1.6", "numpy<2")


if __name__ == "__main__":
    main()
