// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
//
// What Python knows as ThreadPool.
#pragma once

#include <pybind11/pybind11.h>

#include <utility>

#include "util/thread_pool.hpp"

namespace radarsdf {

// A thread pool, and the arrays of the tasks that it has begun: Python must not free them before the end.
class HeldThreadPool {
 public:
  explicit HeldThreadPool(int num_threads) : pool_(num_threads) {}
  ~HeldThreadPool() {
    const pybind11::gil_scoped_release release;
    pool_.abandon();
  }

  ThreadPool& pool() { return pool_; }

  // Until the end of what `pool` has begun.
  void hold(pybind11::object arrays) { arrays_ = std::move(arrays); }
  // Calls `end`, which finishes what was begun.
  template <typename End>
  auto finish(const End& end) {
    const pybind11::object arrays = std::move(arrays_);  // freed at the end, also after an exception
    const pybind11::gil_scoped_release release;
    return end(pool_);
  }

 private:
  pybind11::object arrays_;
  ThreadPool pool_;
};

}  // namespace radarsdf
