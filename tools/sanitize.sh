#!/usr/bin/env bash
# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
#
# tools/sanitize.sh address [pytest arguments]   the tests of the core under AddressSanitizer and UBSan (gcc)
# tools/sanitize.sh thread                       every parallel function under ThreadSanitizer (clang, libomp, Archer)
set -euo pipefail
cd "$(dirname "$0")/.."

build() { # sanitizers, folder, target, options of CMake
  cmake -S . -B "$2" -G Ninja -DCMAKE_BUILD_TYPE=RelWithDebInfo -DRADARSDF_SANITIZE="$1" \
    -Dpybind11_DIR="$(python -m pybind11 --cmakedir)" -DPython_EXECUTABLE="$(command -v python)" "${@:4}"
  cmake --build "$2" --target "$3"
}

case "${1:-}" in
  address)
    shift
    folder=build/sanitize_address
    build address,undefined $folder _core -DCMAKE_CXX_COMPILER="${CXX:-g++}"
    # A copy of the package, so that nobody else meets the slow core.
    rm -rf $folder/python
    cp -r python $folder/python
    rm -f $folder/python/radarsdf/_core*.so
    ln -s "$PWD/$folder"/csrc/bindings/_core*.so $folder/python/radarsdf/
    tests=(tests/test_kernels.py tests/test_kernel_rounding.py tests/test_encodings.py tests/test_marching_cubes.py
      tests/test_marching_cubes_extremes.py tests/test_mesh_components.py tests/test_sparse_lattice.py
      tests/test_cell_sums.py tests/test_surface_crossings.py tests/test_optimiser.py tests/test_mlp.py
      tests/test_ray_average.py tests/test_shards.py)
    # Python itself leaks by design, and libraries beside ours define the same symbols.
    LD_PRELOAD="$(g++ -print-file-name=libasan.so) $(g++ -print-file-name=libubsan.so)" \
      ASAN_OPTIONS=detect_leaks=0:detect_odr_violation=0 UBSAN_OPTIONS=print_stacktrace=1 \
      PYTHONPATH=$folder/python python -m pytest -q -p no:cacheprovider "${@:-${tests[@]}}"
    ;;
  thread)
    # Not in Python: PyTorch brings gcc's OpenMP, whose barriers ThreadSanitizer does not see. LLVM's tells it of them
    # through Archer.
    folder=build/sanitize_thread
    build thread $folder race_check -DCMAKE_CXX_COMPILER="${CLANGXX:-clang++}"
    openmp=$(ldd $folder/csrc/race_check | awk '/libomp/ { print $3; exit }')
    archer=$(dirname "$(readlink -f "$openmp")")/libarcher.so
    test -e "$archer" || { echo "no Archer beside $openmp: every barrier would be reported" >&2; exit 1; }
    OMP_TOOL_LIBRARIES=$archer TSAN_OPTIONS="ignore_noninstrumented_modules=1 ${TSAN_OPTIONS:-}" \
      $folder/csrc/race_check
    ;;
  *)
    sed -n 's/^# \(tools.*\)/\1/p' "$0" >&2
    exit 2
    ;;
esac
