#!/usr/bin/env bash
# tools/sanitize.sh [pytest arguments]   the Python tests of the core under AddressSanitizer and UBSan (gcc)
#
# The C++ tests and ThreadSanitizer are in tools/test_core.sh.
set -euo pipefail
cd "$(dirname "$0")/.."

folder=build/sanitize_address
cmake -S . -B $folder -G Ninja -DCMAKE_BUILD_TYPE=RelWithDebInfo -DRADARSDF_SANITIZE=address,undefined \
  -Dpybind11_DIR="$(python -m pybind11 --cmakedir)" -DPython_EXECUTABLE="$(command -v python)" \
  -DCMAKE_CXX_COMPILER="${CXX:-g++}"
cmake --build $folder --target _core
# A copy of the package, so that nobody else meets the slow core.
rm -rf $folder/python
cp -r python $folder/python
rm -f $folder/python/radarsdf/_core*.so
ln -s "$PWD/$folder"/csrc/bindings/_core*.so $folder/python/radarsdf/
tests=(tests/core tests/field/test_encodings.py tests/fitting/test_optimiser.py)
# Python itself leaks by design, and libraries beside ours define the same symbols.
LD_PRELOAD="$(g++ -print-file-name=libasan.so) $(g++ -print-file-name=libubsan.so)" \
  ASAN_OPTIONS=detect_leaks=0:detect_odr_violation=0 UBSAN_OPTIONS=print_stacktrace=1 \
  PYTHONPATH=$folder/python python -m pytest -q -p no:cacheprovider "${@:-${tests[@]}}"
