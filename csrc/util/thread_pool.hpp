// Thread pool for a sequence of short jobs, such as the halves of a training step.
#pragma once

#include <atomic>
#include <condition_variable>
#include <cstdint>
#include <exception>
#include <functional>
#include <memory>
#include <mutex>
#include <thread>
#include <vector>

namespace radarsdf {

// Waking a sleeping thread takes 50 us (a virtual machine with two processors), and notifying the waiting one as long.
// So an idle thread spins for a moment before it sleeps. It does not spin for long, unlike OpenMP's threads, which made
// fits thirty times slower next to another busy program.
//
// Not thread-safe: one caller at a time.
class ThreadPool {
 public:
  // The caller of `finish` is one of the threads. If the system refuses some, the others do the work.
  explicit ThreadPool(int num_threads);
  ~ThreadPool() { abandon(); }
  ThreadPool(const ThreadPool&) = delete;
  ThreadPool& operator=(const ThreadPool&) = delete;

  // The other threads start task(i) for i in [0, num_tasks), in this order, each task on one thread. Throws
  // std::logic_error if the last job is not finished.
  void begin(std::int64_t num_tasks, std::function<void(std::int64_t)> task);
  // Joins the work, and returns after the last task. An exception of a task is rethrown here, and tasks not yet started
  // are skipped.
  void finish();
  void run(std::int64_t num_tasks, std::function<void(std::int64_t)> task);
  // Skips tasks not yet started, and joins the threads.
  void abandon();

 private:
  void live();
  void work();

  std::function<void(std::int64_t)> task_;
  std::int64_t num_tasks_ = 0;
  std::atomic<std::int64_t> next_{0};
  std::exception_ptr error_;  // guarded by the mutex
  bool begun_ = false;

  // Not destructible in a forked process: that would wait for threads that stay with the parent.
  struct Others {
    std::mutex mutex;
    std::condition_variable wake, done;
    std::vector<std::thread> threads;
  };
  bool has_others() const;

  std::unique_ptr<Others> others_;
  std::atomic<std::int64_t> job_{0};  // number of the last job; changed under the mutex
  std::atomic<int> working_{0};       // threads in the last job; changed under the mutex
  std::atomic<bool> stop_{false};     // changed under the mutex
  bool open_ = false;                 // threads may still join the last job; guarded by the mutex
  int forks_;                         // num_forks() at the creation of the threads
};

}  // namespace radarsdf
