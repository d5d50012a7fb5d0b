#!/usr/bin/env bash
# tools/check_instruction_sets.sh BUILD_DIR: looks at the compiled objects of an x86-64 build and fails
#  - if code that runs on every processor uses AVX;
#  - if a copy of the kernels for a newer processor exports an inline function, which the linker could choose for all.
set -euo pipefail
build=${1:?usage: $0 BUILD_DIR}

if [[ $(uname -m) != x86_64 ]]; then
  echo "no instruction sets to check on $(uname -m)"
  exit 0
fi

objects() { find "$build/csrc" -name '*.o' -path "*/$1.dir/*" | sort; }

# Instructions with VEX or EVEX encoding: their mnemonics begin with v, or they name a 256- or 512-bit register.
count_avx() { objdump -d --no-show-raw-insn "$@" | grep -cE $'^ +[0-9a-f]+:\t(v[a-z0-9]+ |.*%[yz]mm)' || true; }

failed=0
for target in radarsdf_core radarsdf_kernels_baseline _core; do
  mapfile -t files < <(objects "$target")
  [[ ${#files[@]} -gt 0 ]] || { echo "no objects of $target in $build" >&2; exit 1; }
  for file in "${files[@]}"; do
    avx=$(count_avx "$file")
    if [[ $avx -ne 0 ]]; then
      echo "$file: $avx AVX instructions in code for every processor" >&2
      failed=1
    fi
  done
done
for isa in avx2 avx512; do
  mapfile -t files < <(objects "radarsdf_kernels_$isa")
  [[ ${#files[@]} -gt 0 ]] || { echo "no objects of radarsdf_kernels_$isa in $build" >&2; exit 1; }
  for file in "${files[@]}"; do
    # The other way round, to know that the search above can find something.
    [[ $(count_avx "$file") -gt 0 ]] || { echo "$file: no AVX instruction found at all" >&2; failed=1; }
    # Weak and unique symbols (W, V, u) are those of which the linker keeps one. A copy's own carry its namespace.
    shared=$(nm -C "$file" | grep -E '^[0-9a-f]+ [WVu] ' | grep -v "radarsdf::$isa::" || true)
    if [[ -n $shared ]]; then
      printf '%s: the linker could choose these for every processor:\n%s\n' "$file" "$shared" >&2
      failed=1
    fi
  done
done
[[ $failed -eq 0 ]] && echo "no AVX in the baseline, nothing shared by the variants"
exit "$failed"
