#!/usr/bin/env bash
# Puts libomp into a wheel for macOS, as cibuildwheel calls it there (see [tool.cibuildwheel.macos] in pyproject.toml).
#
#   tools/repair_wheel_macos.sh ARCHS FOLDER WHEEL
#
# Two OpenMP runtimes would end the process. So the extension looks for PyTorch's libomp first, which lies beside it in
# site-packages, and takes the one in the wheel only where there is none.
set -euo pipefail
archs=$1 folder=$2 wheel=$3
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT

delocate-wheel --require-archs "$archs" --wheel-dir "$scratch" "$wheel"
python -m wheel unpack --dest "$scratch/unpacked" "$scratch"/*.whl
core=$(echo "$scratch"/unpacked/*/radarsdf/_core*.so)
bundled=$(otool -L "$core" | awk '/libomp\.dylib/ { print $1 }')
test "$bundled" = "@loader_path/.dylibs/libomp.dylib"
install_name_tool -change "$bundled" @rpath/libomp.dylib "$core"
for rpath in @loader_path/../torch/lib @loader_path/.dylibs; do install_name_tool -add_rpath "$rpath" "$core"; done
codesign --force --sign - "$core"
python -m wheel pack --dest-dir "$folder" "$scratch"/unpacked/*
