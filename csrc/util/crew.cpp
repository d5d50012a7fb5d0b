// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
#include "util/crew.hpp"

#include <chrono>
#include <stdexcept>
#include <system_error>
#include <utility>

#include "util/parallel.hpp"

#if defined(__x86_64__) || defined(__i386__) || defined(_M_X64)
#include <immintrin.h>
#endif

namespace radarsdf {
namespace {

// A little more than what passes between two pieces of work of an iteration.
constexpr std::chrono::microseconds kLook{1000};

inline void pause() {
#if defined(__x86_64__) || defined(__i386__) || defined(_M_X64)
  _mm_pause();
#elif defined(__aarch64__) && defined(__GNUC__)
  asm volatile("yield");
#endif
}

// Until `ready` or for a moment.
template <typename Ready>
void look(const Ready& ready) {
  const auto until = std::chrono::steady_clock::now() + kLook;
  while (std::chrono::steady_clock::now() < until) {
    for (int i = 0; i < 32; ++i) {
      if (ready()) return;
      pause();
    }
  }
}

}  // namespace

Crew::Crew(int num_threads) : forks_(num_forks()) {
  try {
    for (int i = 1; i < num_threads; ++i) threads_.emplace_back([this] { live(); });
  } catch (const std::system_error&) {
  }
}

void Crew::begin(std::int64_t num_tasks, std::function<void(std::int64_t)> task) {
  if (begun_) throw std::logic_error("the tasks before these are not finished");
  begun_ = true;
  task_ = std::move(task);
  num_tasks_ = num_tasks;
  next_ = 0;
  error_ = nullptr;
  if (threads_.empty() || forks_ != num_forks()) return;
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    open_ = true;
    ++job_;
  }
  wake_.notify_all();
}

void Crew::finish() {
  if (!begun_) return;
  work();
  if (!threads_.empty() && forks_ == num_forks()) {
    look([this] { return working_ == 0; });
    std::unique_lock<std::mutex> lock(mutex_);
    open_ = false;
    done_.wait(lock, [this] { return working_ == 0; });
  }
  begun_ = false;
  task_ = nullptr;
  if (error_) std::rethrow_exception(std::exchange(error_, nullptr));
}

void Crew::run(std::int64_t num_tasks, std::function<void(std::int64_t)> task) {
  begin(num_tasks, std::move(task));
  finish();
}

void Crew::abandon() {
  if (forks_ != num_forks()) {  // the threads stayed with the parent
    for (std::thread& thread : threads_) thread.detach();
  } else {
    next_ = num_tasks_;
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      stop_ = true;
    }
    wake_.notify_all();
    for (std::thread& thread : threads_) thread.join();
  }
  threads_.clear();
}

void Crew::work() {
  for (std::int64_t i = next_++; i < num_tasks_; i = next_++) {
    try {
      task_(i);
    } catch (...) {
      next_ = num_tasks_;
      const std::lock_guard<std::mutex> lock(mutex_);
      if (!error_) error_ = std::current_exception();
    }
  }
}

void Crew::live() {
  ignore_interrupts_here();
  std::int64_t seen = 0;
  while (true) {
    look([&] { return job_ != seen || stop_; });
    {
      std::unique_lock<std::mutex> lock(mutex_);
      wake_.wait(lock, [&] { return job_ != seen || stop_; });
      if (stop_) return;
      seen = job_;
      if (!open_) continue;
      ++working_;
    }
    work();
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      --working_;
    }
    done_.notify_one();
  }
}

}  // namespace radarsdf
