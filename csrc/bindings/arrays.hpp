// Shapes are validated here, once, so that the core may trust its pointers. Arrays are never converted: a wrong dtype
// or layout is an error of the caller (the package's own Python), not a silent copy.
#pragma once

#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>

#include <algorithm>
#include <cstdint>
#include <memory>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace radarsdf {

namespace py = pybind11;

template <typename T>
using Array = py::array_t<T, py::array::c_style>;

// Contiguous rows with any stride: a block of columns of a larger matrix.
template <typename T>
using Rows = py::array_t<T, 0>;

template <typename T, int Flags>
void check_shape(const py::array_t<T, Flags>& array, std::int64_t rows, std::int64_t columns, const char* name) {
  if (array.ndim() != 2 || array.shape(0) != rows || array.shape(1) != columns) {
    throw std::invalid_argument(std::string(name) + " must have shape (" + std::to_string(rows) + ", " +
                                std::to_string(columns) + ")");
  }
}

template <typename T>
std::int64_t row_stride(const Rows<T>& array, const char* name) {
  const auto item = static_cast<std::int64_t>(sizeof(T));
  if (array.shape(0) > 0 && array.shape(1) > 1 && (array.strides(1) != item || array.strides(0) % item != 0)) {
    throw std::invalid_argument(std::string(name) + " must have contiguous rows");
  }
  return array.shape(0) > 1 ? array.strides(0) / item : array.shape(1);
}

// Returns the number of points (N, 3).
inline std::int64_t check_points(const py::array& points) {
  if (points.ndim() != 2 || points.shape(1) != 3) throw std::invalid_argument("points must have shape (N, 3)");
  return points.shape(0);
}

template <typename T>
std::int64_t check_column(const Array<T>& array, const char* name) {
  if (array.ndim() != 1) throw std::invalid_argument(std::string(name) + " must have shape (N,)");
  return array.shape(0);
}

// Returns the number of returns; `cells` (N,) are the rows of their cells.
inline std::int64_t check_cells_of_returns(const Array<std::int32_t>& cells, std::int64_t num_cells) {
  const std::int64_t count = check_column(cells, "cells");
  const std::int32_t* c = cells.data();
  if (std::any_of(c, c + count, [&](std::int32_t cell) { return cell < 0 || cell >= num_cells; })) {
    throw std::invalid_argument("cells must lie in [0, num_cells)");
  }
  return count;
}

// Moves a vector into a NumPy array without a copy.
template <typename T>
Array<T> to_array(std::vector<T> values) {
  auto owner = std::make_unique<std::vector<T>>(std::move(values));
  T* data = owner->data();
  const auto size = static_cast<py::ssize_t>(owner->size());
  const py::capsule free(owner.get(), [](void* p) { delete static_cast<std::vector<T>*>(p); });
  owner.release();  // only after the capsule owns it
  return Array<T>({size}, {static_cast<py::ssize_t>(sizeof(T))}, data, free);
}

}  // namespace radarsdf
