// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
//
// Which copy of the kernels runs: chosen once, when the library is loaded, from what the processor has.
#pragma once

#include <string>
#include <vector>

namespace radarsdf {

enum class InstructionSet { kBaseline, kAvx2, kAvx512 };

// Those that were compiled in and that this processor runs, slowest first.
std::vector<InstructionSet> available_instruction_sets();

InstructionSet instruction_set();  // the one in use; at load the last of the available, or what RADARSDF_ISA names
void set_instruction_set(InstructionSet isa);

const char* instruction_set_name(InstructionSet isa);
// Throws std::invalid_argument for a name that is unknown or not available here.
InstructionSet instruction_set_from_name(const std::string& name);

}  // namespace radarsdf

// The copy of a kernel for the instruction set in use. A macro, since the copies are one name in three namespaces.
#ifdef RADARSDF_X86_VARIANTS
#define RADARSDF_KERNEL(name)                                  \
  (instruction_set() == InstructionSet::kAvx512 ? avx512::name \
   : instruction_set() == InstructionSet::kAvx2 ? avx2::name   \
                                                : baseline::name)
#else
#define RADARSDF_KERNEL(name) baseline::name
#endif
