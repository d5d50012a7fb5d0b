// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
#include <pybind11/stl.h>

#include "bindings/arrays.hpp"
#include "bindings/subjects.hpp"
#include "util/instruction_set.hpp"
#include "util/parallel.hpp"

namespace radarsdf {

namespace {

// Python runs its handlers of signals, Ctrl-C's among them, only when a call returns, unless it is asked to.
void check_signals() {
  const py::gil_scoped_acquire hold;
  if (PyErr_CheckSignals() != 0) throw py::error_already_set();
}

}  // namespace

void bind_system(py::module_& m) {
  set_interrupt_check(&check_signals);
  using namespace py::literals;
  m.attr("__version__") = RADARSDF_VERSION;
  m.def(
      "compiler",
      [] {
#if defined(__clang__)
        return std::string("clang ") + __clang_version__;
#elif defined(__GNUC__)
        return std::string("gcc ") + __VERSION__;
#elif defined(_MSC_VER)
        return "msvc " + std::to_string(_MSC_VER);
#else
        return std::string("unknown");
#endif
      },
      "Compiler that built the core.");
  m.def(
      "openmp_version",
      [] {
#ifdef _OPENMP
        return _OPENMP;
#else
        return 0;
#endif
      },
      "OpenMP version as yyyymm, 0 for a serial build.");
  m.def("num_threads", &resolve_num_threads, "num_threads"_a = 0, "Threads that a call with this argument uses.");
  m.def(
      "instruction_set", [] { return instruction_set_name(instruction_set()); },
      "Instruction set of the kernels in use.");
  m.def(
      "available_instruction_sets",
      [] {
        std::vector<std::string> names;
        for (const InstructionSet isa : available_instruction_sets()) names.emplace_back(instruction_set_name(isa));
        return names;
      },
      "Instruction sets that were compiled in and that this processor runs, slowest first.");
  m.def(
      "set_instruction_set", [](const std::string& name) { set_instruction_set(instruction_set_from_name(name)); },
      "name"_a, "Chooses the kernels: for tests and benches; not while another call runs.");
}

}  // namespace radarsdf
