// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
#include <pybind11/stl.h>
#ifdef __unix__
#include <unistd.h>
#endif

#include <exception>

#include "bindings/arrays.hpp"
#include "bindings/held_thread_pool.hpp"
#include "bindings/subjects.hpp"
#include "field/field_loss.hpp"
#include "kernels/fourier_kernels.hpp"
#include "lattice/cell.hpp"
#include "util/instruction_set.hpp"
#include "util/parallel.hpp"
#include "util/random_bytes.hpp"

namespace radarsdf {
namespace {

unsigned long main_thread = 0;  // as PyThread_get_thread_ident has it

// Python runs its handlers of signals, Ctrl-C's among them, only when a call returns, unless it is asked to. It does so
// in the main thread alone. Others must not ask for the lock here: while the interpreter ends, that would end them.
void check_signals() {
  if (PyThread_get_thread_ident() != main_thread) return;
  const py::gil_scoped_acquire hold;
  if (PyErr_CheckSignals() != 0) throw py::error_already_set();
}

#if defined(__GLIBC__) && PY_VERSION_HEX < 0x030E0000
#define RADARSDF_UNWINDS_DAEMONS

std::terminate_handler terminate_before = nullptr;

// A daemon thread that wants Python's lock while the interpreter ends is ended by unwinding its stack. No destructor of
// C++ lets that pass, such as those that take the lock again here and in PyTorch: the whole process would abort. The
// thread waits for the end of the process instead, as it does from Python 3.14 on.
void wait_or_terminate() {
  const bool ended = Py_IsInitialized() == 0 && PyThread_get_thread_ident() != main_thread;
  while (ended && !std::current_exception()) pause();
  terminate_before();
}
#endif

// What Python must know of the core's arrays. It is defined in the core's headers and nowhere else.
void bind_numbers(py::module_& m) {
  m.attr("FEATURE_DIM") = kFeatureDim;
  m.attr("MAX_LEVELS") = kMaxLevels;
  m.attr("MAX_FREQUENCIES") = kMaxFrequencies;
  m.attr("NUM_SPHERICAL_HARMONICS") = kHarmonics;
  // The first column of each part of a ray's row, and how many columns there are.
  m.attr("RAY_POINT") = kRayPoint;
  m.attr("RAY_DIRECTION") = kRayDirection;
  m.attr("RAY_RANGE") = kRayRange;
  m.attr("RAY_INTENSITY") = kRayIntensity;
  m.attr("RAY_COLUMNS") = kRayColumns;
}

}  // namespace

void bind_system(py::module_& m) {
  main_thread = py::module_::import("threading").attr("main_thread")().attr("ident").cast<unsigned long>();
  set_interrupt_check(&check_signals);
#ifdef RADARSDF_UNWINDS_DAEMONS
  terminate_before = std::set_terminate(&wait_or_terminate);
#endif
  using namespace py::literals;
  py::class_<HeldThreadPool>(
      m, "ThreadPool",
      "Threads for short pieces of work, the calling one among them. They end with the object. One "
      "thread at a time may use it.")
      .def(py::init<int>(), "num_threads"_a)
      .def(
          "finish", [](HeldThreadPool& pool) { pool.finish([](ThreadPool& own) { own.finish(); }); },
          "Helps with what was begun, and returns at its end.");
  m.def(
      "random_bytes",
      [](std::uint64_t seed, std::int64_t rows, std::int64_t columns) {
        if (rows < 0 || columns < 0) throw std::invalid_argument("there cannot be less than no rows and columns");
        Array<std::uint8_t> bytes(std::vector<std::int64_t>{rows, columns});
        RandomRows random(seed, columns);
        for (std::int64_t i = 0; i < rows; ++i) {
          std::copy_n(random.row(i), columns, bytes.mutable_data() + i * columns);
        }
        return bytes;
      },
      "seed"_a, "rows"_a, "columns"_a, "Random bytes (rows, columns), those of a dropout with this seed.");
  m.attr("__version__") = RADARSDF_VERSION;
  bind_numbers(m);
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
