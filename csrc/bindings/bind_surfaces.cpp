// SPDX-FileCopyrightText: 2026 the radarsdf authors
// SPDX-License-Identifier: MIT
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>
#include <pybind11/typing.h>

#include <memory>
#include <optional>
#include <stdexcept>
#include <utility>
#include <vector>

#include "bindings/subjects.hpp"
#include "surface/marching_cubes.hpp"
#include "surface/mesh_components.hpp"
#include "surface/sparse_lattice.hpp"

namespace py = pybind11;

namespace radarsdf {
namespace {

template <typename T>
using Array = py::array_t<T, py::array::c_style>;

// A NumPy array that owns the memory it is given.
template <typename T>
py::array_t<T> adopt(std::unique_ptr<T[]> data, const std::vector<py::ssize_t>& shape) {
  const py::capsule owner(data.get(), [](void* memory) { delete[] static_cast<T*>(memory); });
  return py::array_t<T>(shape, data.release(), owner);
}

// What the functions return, spelled out for the type stub.
template <typename... T>
using Arrays = py::typing::Tuple<py::array_t<T>...>;

Arrays<double, std::int32_t> adopt_mesh(Mesh mesh) {
  return py::make_tuple(adopt(std::move(mesh.vertices), {mesh.num_vertices, 3}),
                        adopt(std::move(mesh.faces), {mesh.num_faces, 3}));
}

void check_columns(const py::array& array, py::ssize_t columns, const char* message) {
  if (array.ndim() != 2 || array.shape(1) != columns) throw std::invalid_argument(message);
}

template <typename T>
Arrays<double, std::int32_t> dense(const Array<T>& volume, const std::optional<Array<bool>>& mask,
                                   const std::array<double, 3>& spacing, const std::array<double, 3>& origin,
                                   double level, int num_threads) {
  if (volume.ndim() != 3) throw std::invalid_argument("volume must have three axes");
  const std::array<std::int64_t, 3> shape{volume.shape(0), volume.shape(1), volume.shape(2)};
  if (mask && (mask->ndim() != 3 || !std::equal(shape.begin(), shape.end(), mask->shape()))) {
    throw std::invalid_argument("mask must have the shape of volume");
  }
  const T* samples = volume.data();
  const bool* flags = mask ? mask->data() : nullptr;
  Mesh mesh;
  {
    const py::gil_scoped_release nogil;
    mesh = marching_cubes_dense(samples, shape, flags, {spacing, origin}, level, num_threads);
  }
  return adopt_mesh(std::move(mesh));
}

template <typename T>
Arrays<double, std::int32_t> sparse(const Array<std::int32_t>& corners, const Array<T>& values,
                                    const Array<std::int32_t>& cells, const std::array<double, 3>& spacing,
                                    const std::array<double, 3>& origin, double level, int num_threads) {
  check_columns(corners, 3, "corners must have shape (K, 3)");
  check_columns(cells, 8, "cells must have shape (M, 8)");
  const std::int64_t num_corners = corners.shape(0);
  const std::int64_t num_cells = cells.shape(0);
  if (values.ndim() != 1 || values.shape(0) != num_corners) {
    throw std::invalid_argument("values must have shape (K,), one for each corner");
  }
  const std::int32_t *corner_data = corners.data(), *cell_data = cells.data();
  const T* value_data = values.data();
  Mesh mesh;
  {
    const py::gil_scoped_release nogil;
    mesh = marching_cubes_sparse(corner_data, value_data, num_corners, cell_data, num_cells, {spacing, origin}, level,
                                 num_threads);
  }
  return adopt_mesh(std::move(mesh));
}

Arrays<std::int32_t, std::int32_t, std::int32_t> lattice(const Array<std::int32_t>& cells, int num_threads) {
  check_columns(cells, 3, "cells must have shape (M, 3)");
  const std::int32_t* data = cells.data();
  const std::int64_t num_cells = cells.shape(0);
  SparseLattice result;
  {
    const py::gil_scoped_release nogil;
    result = sparse_lattice(data, num_cells, num_threads);
  }
  return py::make_tuple(adopt(std::move(result.cells), {result.num_cells, 3}),
                        adopt(std::move(result.corners), {result.num_corners, 3}),
                        adopt(std::move(result.cell_corners), {result.num_cells, 8}));
}

Arrays<std::int32_t, std::int64_t> components(const Array<std::int32_t>& faces, std::int64_t num_vertices) {
  check_columns(faces, 3, "faces must have shape (F, 3)");
  const std::int32_t* data = faces.data();
  const std::int64_t num_faces = faces.shape(0);
  MeshComponents result;
  {
    const py::gil_scoped_release nogil;
    result = mesh_components(data, num_faces, num_vertices);
  }
  return py::make_tuple(adopt(std::move(result.labels), {num_faces}),
                        py::array_t<std::int64_t>(static_cast<py::ssize_t>(result.sizes.size()), result.sizes.data()));
}

template <typename T>
void bind_for_type(py::module_& m) {
  using py::arg;
  m.def("marching_cubes_dense", &dense<T>, arg("volume").noconvert(), arg("mask").noconvert(), arg("spacing"),
        arg("origin"), arg("level"), arg("num_threads") = 0);
  m.def("marching_cubes_sparse", &sparse<T>, arg("corners").noconvert(), arg("values").noconvert(),
        arg("cells").noconvert(), arg("spacing"), arg("origin"), arg("level"), arg("num_threads") = 0);
}

}  // namespace

void bind_surfaces(py::module_& m) {
  bind_for_type<float>(m);
  bind_for_type<double>(m);
  m.def("sparse_lattice", &lattice, py::arg("cells").noconvert(), py::arg("num_threads") = 0);
  m.def("mesh_components", &components, py::arg("faces").noconvert(), py::arg("num_vertices"));
}

}  // namespace radarsdf
