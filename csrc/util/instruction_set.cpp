#include "util/instruction_set.hpp"

#include <atomic>
#include <cstdlib>
#include <stdexcept>

namespace radarsdf {
namespace {

InstructionSet choose_at_load() {
  // Unknown names are ignored: an environment variable must not prevent the library from loading.
  if (const char* name = std::getenv("RADARSDF_ISA")) {
    for (const InstructionSet isa : available_instruction_sets()) {
      if (instruction_set_name(isa) == std::string(name)) return isa;
    }
  }
  return available_instruction_sets().back();
}

std::atomic<InstructionSet>& current() {
  static std::atomic<InstructionSet> isa{choose_at_load()};
  return isa;
}

}  // namespace

std::vector<InstructionSet> available_instruction_sets() {
  std::vector<InstructionSet> available = {InstructionSet::kBaseline};
#ifdef RADARSDF_X86_VARIANTS
  __builtin_cpu_init();
  if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma")) {
    available.push_back(InstructionSet::kAvx2);
    if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512dq") &&
        __builtin_cpu_supports("avx512bw")) {
      available.push_back(InstructionSet::kAvx512);
    }
  }
#endif
  return available;
}

InstructionSet instruction_set() { return current().load(std::memory_order_relaxed); }

void set_instruction_set(InstructionSet isa) { current().store(isa, std::memory_order_relaxed); }

const char* instruction_set_name(InstructionSet isa) {
  switch (isa) {
    case InstructionSet::kAvx2:
      return "avx2";
    case InstructionSet::kAvx512:
      return "avx512";
    default:
      return "baseline";
  }
}

InstructionSet instruction_set_from_name(const std::string& name) {
  for (const InstructionSet isa : available_instruction_sets()) {
    if (instruction_set_name(isa) == name) return isa;
  }
  throw std::invalid_argument("instruction set '" + name + "' is not available here");
}

}  // namespace radarsdf
