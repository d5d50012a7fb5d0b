// ThreadPool in Python.
#pragma once

#include <pybind11/pybind11.h>

#include <utility>

#include "util/thread_pool.hpp"

namespace radarsdf {

// Thread pool with references to the arrays of running tasks, which Python must not free.
class HeldThreadPool {
 public:
  explicit HeldThreadPool(int num_threads) : pool_(num_threads) {}
  ~HeldThreadPool() {
    const pybind11::gil_scoped_release release;
    pool_.abandon();
  }

  ThreadPool& pool() { return pool_; }

  // Keeps arrays alive until the running tasks of `pool` are complete.
  void hold(pybind11::object arrays) { arrays_ = std::move(arrays); }
  // Calls `end`, which waits for the running tasks, without the GIL.
  template <typename End>
  auto finish(const End& end) {
    const pybind11::object arrays = std::move(arrays_);  // released on return, also after an exception
    const pybind11::gil_scoped_release release;
    return end(pool_);
  }

 private:
  pybind11::object arrays_;
  ThreadPool pool_;
};

}  // namespace radarsdf
