#!/usr/bin/env bash
# tools/test_core.sh            the C++ tests, and a project that uses the installed core; without Python
# tools/test_core.sh address    the same under AddressSanitizer and UBSan (gcc)
# tools/test_core.sh thread     the same results on several threads, under ThreadSanitizer (clang, libomp, Archer)
#
# On Debian: apt-get install doctest-dev, and clang libclang-rt-14-dev libomp-dev for `thread`. Builds in build/.
set -euo pipefail
cd "$(dirname "$0")/.."

build() { # folder, targets, options of CMake
  cmake -S . -B "$1" -DRADARSDF_PYTHON=OFF -DRADARSDF_TESTS=ON -DRADARSDF_WERROR=ON "${@:3}"
  # shellcheck disable=SC2086 # several targets
  cmake --build "$1" --parallel 2 --target $2
}

use_installed() { # folder of the build, options of CMake
  local prefix=$PWD/$1/installed
  rm -rf "$prefix" "$1/consumer"
  cmake --install "$1" --prefix "$prefix" --component core
  cmake -S tests/core_cpp/consumer -B "$1/consumer" -DCMAKE_PREFIX_PATH="$prefix" "${@:2}"
  cmake --build "$1/consumer"
  "$1/consumer/consumer"
}

case "${1:-plain}" in
  plain)
    folder=build/test_core
    build $folder all
    ctest --test-dir $folder --output-on-failure
    use_installed $folder -DCMAKE_BUILD_TYPE=Release
    ;;
  address)
    folder=build/test_core_address
    # Little optimisation: the tests are small, and most of the time is the compiler's.
    build $folder all -DRADARSDF_SANITIZE=address,undefined -DCMAKE_BUILD_TYPE=None -DCMAKE_CXX_FLAGS=-O1 \
      -DCMAKE_CXX_COMPILER="${CXX:-g++}"
    UBSAN_OPTIONS=print_stacktrace=1 ctest --test-dir $folder --output-on-failure
    use_installed $folder -DCMAKE_CXX_COMPILER="${CXX:-g++}"
    ;;
  thread)
    # Not in Python: PyTorch brings gcc's OpenMP, whose barriers ThreadSanitizer does not see. LLVM's tells it of them
    # through Archer.
    folder=build/test_core_thread
    # Clang's -Wconversion also warns of signs: no errors of these.
    build $folder race_check -DRADARSDF_WERROR=OFF -DRADARSDF_SANITIZE=thread -DCMAKE_BUILD_TYPE=RelWithDebInfo \
      -DCMAKE_CXX_COMPILER="${CLANGXX:-clang++}"
    program=$folder/tests/core_cpp/race_check
    openmp=$(ldd $program | awk '/libomp/ { print $3; exit }')
    archer=$(dirname "$(readlink -f "$openmp")")/libarcher.so
    test -e "$archer" || { echo "no Archer beside $openmp: every barrier would be reported" >&2; exit 1; }
    OMP_TOOL_LIBRARIES=$archer TSAN_OPTIONS="ignore_noninstrumented_modules=1 ${TSAN_OPTIONS:-}" $program
    ;;
  *)
    sed -n 's/^# \(tools.*\)/\1/p' "$0" >&2
    exit 2
    ;;
esac
