// Parallelism as a policy: the kernels are serial functions on a range, and this file runs them on threads.
// The split depends on the sizes alone, never on timing, so results are deterministic.
#pragma once

#include <algorithm>
#include <atomic>
#include <cstdint>
#include <exception>

namespace radarsdf {

// 0 or less: the number of OpenMP (OMP_NUM_THREADS is respected); at most 1024. Never sets a global.
// 1 in a forked process: OpenMP's threads stay with the parent, and waiting for them would deadlock.
int resolve_num_threads(int num_threads);

// Sets the function that long calls poll, at most ten times a second, on the calling thread: `check` may throw to abort
// the call. On worker threads, check_interrupt does nothing, so tasks may call it on any thread.
void set_interrupt_check(void (*check)());
void check_interrupt();
void ignore_interrupts_here();  // for worker threads

// Number of forks of this process and its ancestors: threads created before stay with the parent.
int num_forks();

// Runs task(i) for i in [0, num_tasks) on up to num_threads threads, each task on one thread. An exception of a task is
// rethrown here, and tasks not yet started are skipped: it must not leave an OpenMP region.
template <typename Task>
void parallel_tasks(std::int64_t num_tasks, int num_threads, const Task& task) {
  const int threads = static_cast<int>(std::min<std::int64_t>(resolve_num_threads(num_threads), num_tasks));
  if (threads <= 1) {
    for (std::int64_t i = 0; i < num_tasks; ++i) {
      check_interrupt();
      task(i);
    }
    return;
  }
  std::exception_ptr error;
  std::atomic<bool> failed{false};
#pragma omp parallel for num_threads(threads) schedule(dynamic, 1)
  for (std::int64_t i = 0; i < num_tasks; ++i) {
    if (failed) continue;
    try {
      check_interrupt();
      task(i);
    } catch (...) {
      failed = true;
#pragma omp critical(radarsdf_parallel_error)
      if (!error) error = std::current_exception();
    }
  }
  if (error) std::rethrow_exception(error);
}

// Runs body(begin, end) over [0, size) in blocks; no thread is woken for less than min_block items. The size of a block
// is bounded, to limit the latency of interrupts.
template <typename Body>
void parallel_blocks(std::int64_t size, std::int64_t min_block, int num_threads, const Body& body) {
  if (size <= 0) return;
  constexpr std::int64_t max_block = 1 << 18;
  const std::int64_t threads = resolve_num_threads(num_threads);
  const std::int64_t wanted = std::clamp<std::int64_t>(size / std::max<std::int64_t>(min_block, 1), 1, threads);
  const std::int64_t blocks = std::max(wanted, (size + max_block - 1) / max_block);
  parallel_tasks(blocks, num_threads, [&](std::int64_t i) { body(size * i / blocks, size * (i + 1) / blocks); });
}

// Runs body(chunk, begin, end) for the chunks of [0, size), which do not depend on the number of threads.
inline std::int64_t num_chunks(std::int64_t size, std::int64_t chunk_size) {
  return (size + chunk_size - 1) / chunk_size;
}
template <typename Body>
void parallel_chunks(std::int64_t size, std::int64_t chunk_size, int num_threads, const Body& body) {
  parallel_tasks(num_chunks(size, chunk_size), num_threads, [&](std::int64_t chunk) {
    body(chunk, chunk * chunk_size, std::min(size, (chunk + 1) * chunk_size));
  });
}

// Runs body(i) for i in [0, size), in blocks.
template <typename Body>
void parallel_for(std::int64_t size, std::int64_t min_block, int num_threads, const Body& body) {
  parallel_blocks(size, min_block, num_threads, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t i = begin; i < end; ++i) body(i);
  });
}

}  // namespace radarsdf
