// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
//
// Shapes are checked here, once, so that the core may trust its pointers. Arrays are never converted: a wrong dtype or
// layout is an error of the caller (the package's own Python), not a silent copy.
#pragma once

#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>

#include <cstdint>
#include <stdexcept>
#include <string>

namespace radarsdf {

namespace py = pybind11;

template <typename T>
using Array = py::array_t<T, py::array::c_style>;

// Rows of contiguous numbers, any distance apart: a block of columns of a larger matrix.
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

void bind_cell_sums(py::module_& m);
void bind_encodings(py::module_& m);
void bind_field_loss(py::module_& m);
void bind_marching_cubes(py::module_& m);
void bind_mlp(py::module_& m);
void bind_surface_crossings(py::module_& m);
void bind_system(py::module_& m);
void bind_vertex_table(py::module_& m);

}  // namespace radarsdf
