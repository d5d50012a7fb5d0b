// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
//
// What Python knows as Crew.
#pragma once

#include <pybind11/pybind11.h>

#include <utility>

#include "util/crew.hpp"

namespace radarsdf {

// A crew, and the arrays of the tasks that it has begun: Python must not free them before the end.
class HeldCrew {
 public:
  explicit HeldCrew(int num_threads) : crew_(num_threads) {}
  ~HeldCrew() {
    const pybind11::gil_scoped_release release;
    crew_.abandon();
  }

  Crew& crew() { return crew_; }

  // Until the end of what `crew` has begun.
  void hold(pybind11::object arrays) { arrays_ = std::move(arrays); }
  // Calls `end`, which finishes what was begun.
  template <typename End>
  auto finish(const End& end) {
    const pybind11::object arrays = std::move(arrays_);  // freed at the end, also after an exception
    const pybind11::gil_scoped_release release;
    return end(crew_);
  }

 private:
  pybind11::object arrays_;
  Crew crew_;
};

}  // namespace radarsdf
