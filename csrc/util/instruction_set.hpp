// Dispatch of the kernels: the instruction set is chosen once, at load time, by the capabilities of the processor.
#pragma once

#include <string>
#include <vector>

namespace radarsdf {

enum class InstructionSet { kBaseline, kAvx2, kAvx512 };

// Instruction sets that are compiled in and supported by this processor, slowest first.
std::vector<InstructionSet> available_instruction_sets();

InstructionSet instruction_set();  // in use; initially the last available one, or that of RADARSDF_ISA
void set_instruction_set(InstructionSet isa);

const char* instruction_set_name(InstructionSet isa);
// Throws std::invalid_argument for an unknown or unavailable name.
InstructionSet instruction_set_from_name(const std::string& name);

}  // namespace radarsdf

// The variant of a kernel for the instruction set in use. A macro, since variants share a name in three namespaces.
#ifdef RADARSDF_X86_VARIANTS
#define RADARSDF_KERNEL(name)                                  \
  (instruction_set() == InstructionSet::kAvx512 ? avx512::name \
   : instruction_set() == InstructionSet::kAvx2 ? avx2::name   \
                                                : baseline::name)
#else
#define RADARSDF_KERNEL(name) baseline::name
#endif
