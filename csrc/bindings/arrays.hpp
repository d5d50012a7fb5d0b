// Shapes are validated here, once, so that the core may trust its pointers. Arrays are never converted: a wrong dtype
// or layout is an error of the caller (the package's own Python), not a silent copy.
#pragma once

#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>

#include <algorithm>
#include <cstdint>
#include <initializer_list>
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

// Name of an argument that is never converted.
inline py::arg operator""_array(const char* name, std::size_t) { return py::arg(name).noconvert(); }

// Calls the core. There, arrays may be read and written, but not created.
template <typename Call>
auto without_gil(const Call& call) {
  const py::gil_scoped_release release;
  return call();
}

// Uninitialised, with this shape.
template <typename T, typename... Sizes>
Array<T> new_array(Sizes... sizes) {
  return Array<T>(std::vector<py::ssize_t>{static_cast<py::ssize_t>(sizes)...});
}

inline void check_shape(const py::array& array, std::initializer_list<std::int64_t> shape, const char* name) {
  if (std::equal(shape.begin(), shape.end(), array.shape(), array.shape() + array.ndim())) return;
  std::string sizes;
  for (const std::int64_t size : shape) sizes += (sizes.empty() ? "" : ", ") + std::to_string(size);
  throw std::invalid_argument(std::string(name) + " must have shape (" + sizes + (shape.size() == 1 ? ",)" : ")"));
}

// Returns the distance between the rows of a matrix of this shape.
template <typename T>
std::int64_t row_stride(const Rows<T>& array, std::int64_t rows, std::int64_t columns, const char* name) {
  check_shape(array, {rows, columns}, name);
  const auto item = static_cast<std::int64_t>(sizeof(T));
  if (rows > 0 && columns > 1 && (array.strides(1) != item || array.strides(0) % item != 0)) {
    throw std::invalid_argument(std::string(name) + " must have contiguous rows");
  }
  return rows > 1 ? array.strides(0) / item : columns;
}

// Returns the number of rows of an array (N, columns).
inline std::int64_t check_rows(const py::array& array, std::int64_t columns, const char* name) {
  if (array.ndim() != 2 || array.shape(1) != columns) {
    throw std::invalid_argument(std::string(name) + " must have shape (N, " + std::to_string(columns) + ")");
  }
  return array.shape(0);
}

inline std::int64_t check_points(const py::array& points, const char* name = "points") {
  return check_rows(points, 3, name);
}

inline std::int64_t check_column(const py::array& array, const char* name) {
  if (array.ndim() != 1) throw std::invalid_argument(std::string(name) + " must have shape (N,)");
  return array.shape(0);
}

// Returns the number of rays: points and directions (N, 3) and ranges_m (N,).
inline std::int64_t check_rays(const Array<float>& points, const Array<float>& directions,
                               const Array<float>& ranges_m) {
  const std::int64_t count = check_points(points);
  check_shape(directions, {count, 3}, "directions");
  check_shape(ranges_m, {count}, "ranges_m");
  return count;
}

template <typename T>
void check_numbers(const Array<T>& numbers, std::int64_t begin, std::int64_t end, const char* name) {
  const T* n = numbers.data();
  if (!std::all_of(n, n + numbers.size(), [&](T number) { return begin <= number && number < end; })) {
    throw std::invalid_argument(std::string(name) + " must lie in [" + std::to_string(begin) + ", " +
                                std::to_string(end) + ")");
  }
}

// Returns the number of returns; `cells` (N,) are the rows of their cells.
inline std::int64_t check_cells_of_returns(const Array<std::int32_t>& cells, std::int64_t num_cells) {
  check_numbers(cells, 0, num_cells, "cells");
  return check_column(cells, "cells");
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

template <typename T>
Array<T> to_matrix(std::vector<T> rows, py::ssize_t columns) {
  const auto count = static_cast<py::ssize_t>(rows.size()) / columns;
  return to_array(std::move(rows)).reshape({count, columns});
}

}  // namespace radarsdf
