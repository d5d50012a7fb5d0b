#include "util/parallel.hpp"

#include <atomic>
#include <chrono>

#ifdef _OPENMP
#include <omp.h>
#endif
#if defined(__unix__) || defined(__APPLE__)
#include <pthread.h>
#define RADARSDF_FORKS
#endif

namespace radarsdf {
namespace {

std::atomic<int> forks{0};
std::atomic<void (*)()> interrupt_check{nullptr};
thread_local bool ignores_interrupts = false;

#ifdef RADARSDF_FORKS
[[maybe_unused]] const int at_fork = pthread_atfork(nullptr, nullptr, [] { ++forks; });
#endif

}  // namespace

int resolve_num_threads(int num_threads) {
#ifdef _OPENMP
  // OpenMP aborts the program if the system cannot create a thread.
  constexpr int kMaxThreads = 1024;
  if (forks > 0) return 1;
  return num_threads > 0 ? std::min(num_threads, kMaxThreads) : omp_get_max_threads();
#else
  (void)num_threads;
  return 1;
#endif
}

int num_forks() { return forks; }

void set_interrupt_check(void (*check)()) { interrupt_check = check; }

void ignore_interrupts_here() { ignores_interrupts = true; }

void check_interrupt() {
  using Clock = std::chrono::steady_clock;
  thread_local Clock::time_point next;
#ifdef _OPENMP
  if (omp_get_thread_num() != 0) return;
#endif
  void (*const check)() = interrupt_check;
  if (check == nullptr || ignores_interrupts || Clock::now() < next) return;
  next = Clock::now() + std::chrono::milliseconds(100);
  check();
}

}  // namespace radarsdf
