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

unsigned long main_thread = 0;  // of PyThread_get_thread_ident

// Python runs its signal handlers, that of Ctrl-C among them, only when a call returns, unless requested, and only in
// the main thread. Other threads must not acquire the GIL here: that ends them while the interpreter shuts down.
void check_signals() {
  if (PyThread_get_thread_ident() != main_thread) return;
  const py::gil_scoped_acquire hold;
  if (PyErr_CheckSignals() != 0) throw py::error_already_set();
}

#if defined(__GLIBC__) && PY_VERSION_HEX < 0x030E0000
#define RADARSDF_UNWINDS_DAEMONS

std::terminate_handler terminate_before = nullptr;

// A daemon thread that acquires the GIL while the interpreter shuts down is ended by unwinding its stack. C++
// destructors, such as those that reacquire the GIL here and in PyTorch, do not permit that: the process would abort.
// The thread waits for the end of the process instead, as from Python 3.14 on.
void wait_or_terminate() {
  const bool ended = Py_IsInitialized() == 0 && PyThread_get_thread_ident() != main_thread;
  while (ended && !std::current_exception()) pause();
  terminate_before();
}
#endif

// Constants of array layouts, defined only in the headers of the core.
void bind_numbers(py::module_& m) {
  m.attr("FEATURE_DIM") = kFeatureDim;
  m.attr("MAX_LEVELS") = kMaxLevels;
  m.attr("MAX_FREQUENCIES") = kMaxFrequencies;
  m.attr("NUM_SPHERICAL_HARMONICS") = kHarmonics;
  // First column of each part of a ray's row, and the number of columns.
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
      "Threads for short tasks, including the calling one. They end with the object, which is not thread-safe.")
      .def(py::init<int>(), "num_threads"_a)
      .def(
          "finish", [](HeldThreadPool& pool) { pool.finish([](ThreadPool& own) { own.finish(); }); },
          "Joins the threads until all tasks that were started are complete.");
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
      "seed"_a, "rows"_a, "columns"_a, "Random bytes (rows, columns) of a dropout with this seed.");
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
  m.def("num_threads", &resolve_num_threads, "num_threads"_a = 0, "Number of threads of a call with this argument.");
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
      "Compiled instruction sets that this processor supports, slowest first.");
  m.def(
      "set_instruction_set", [](const std::string& name) { set_instruction_set(instruction_set_from_name(name)); },
      "name"_a, "Selects the kernels, for tests and benchmarks; not while another call runs.");
}

}  // namespace radarsdf
