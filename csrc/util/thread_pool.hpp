// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
//
// Threads that wait for short pieces of work, one after the other, as the halves of a training step are.
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

// To wake a sleeping thread takes 50 us (a virtual machine of two processors), and again 50 to tell the one that waits.
// So a thread that has nothing to do looks for work for a moment before it sleeps. It does not look for long, as
// OpenMP's threads do: beside another busy program these made fits thirty times slower.
//
// One thread at a time may call it.
class ThreadPool {
 public:
  // The caller of `finish` is one of the threads. Where the system refuses some, the others do the work.
  explicit ThreadPool(int num_threads);
  ~ThreadPool() { abandon(); }
  ThreadPool(const ThreadPool&) = delete;
  ThreadPool& operator=(const ThreadPool&) = delete;

  // The other threads begin task(i) for i in [0, num_tasks), in this order, each task whole on one thread. Throws
  // std::logic_error before the tasks of the last call are finished.
  void begin(std::int64_t num_tasks, std::function<void(std::int64_t)> task);
  // Helps them, and returns after the last task. An exception thrown by a task is rethrown here, and the tasks not yet
  // begun are left out.
  void finish();
  void run(std::int64_t num_tasks, std::function<void(std::int64_t)> task);
  // Leaves out the tasks that are not yet begun, and ends the threads.
  void abandon();

 private:
  void live();
  void work();

  std::function<void(std::int64_t)> task_;
  std::int64_t num_tasks_ = 0;
  std::atomic<std::int64_t> next_{0};
  std::exception_ptr error_;  // under the mutex
  bool begun_ = false;

  // In a process that was forked they cannot be destroyed: that would wait for threads that stayed with the parent.
  struct Others {
    std::mutex mutex;
    std::condition_variable wake, done;
    std::vector<std::thread> threads;
  };
  bool has_others() const;

  std::unique_ptr<Others> others_;
  std::atomic<std::int64_t> job_{0};  // number of the last one; changed under the mutex
  std::atomic<int> working_{0};       // threads in the last job; changed under the mutex
  std::atomic<bool> stop_{false};     // changed under the mutex
  bool open_ = false;                 // a thread may still join the last job; under the mutex
  int forks_;                         // of this process, when the threads were made
};

}  // namespace radarsdf
