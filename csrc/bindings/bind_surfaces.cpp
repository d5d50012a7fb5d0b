#include <pybind11/stl.h>
#include <pybind11/typing.h>

#include <memory>
#include <optional>
#include <stdexcept>
#include <utility>
#include <vector>

#include "bindings/arrays.hpp"
#include "bindings/subjects.hpp"
#include "surface/grid_surface.hpp"
#include "surface/marching_cubes.hpp"
#include "surface/mesh_components.hpp"
#include "surface/sparse_lattice.hpp"

namespace radarsdf {
namespace {

// NumPy array that takes ownership of the memory.
template <typename T>
py::array_t<T> adopt(std::unique_ptr<T[]> data, const std::vector<py::ssize_t>& shape) {
  const py::capsule owner(data.get(), [](void* memory) { delete[] static_cast<T*>(memory); });
  return py::array_t<T>(shape, data.release(), owner);
}

// Return types, explicit for the type stub.
template <typename... T>
using ArrayTuple = py::typing::Tuple<py::array_t<T>...>;

using DenseEdges = ArrayTuple<double, std::int32_t, std::int64_t>;

ArrayTuple<double, std::int32_t> adopt_mesh(Mesh mesh) {
  return py::make_tuple(adopt(std::move(mesh.vertices), {mesh.num_vertices, 3}),
                        adopt(std::move(mesh.faces), {mesh.num_faces, 3}));
}

py::tuple adopt_mesh_with_edges(Mesh mesh) {
  py::array edges = adopt(std::move(mesh.edges), {mesh.num_vertices});
  return adopt_mesh(std::move(mesh)) + py::make_tuple(std::move(edges));
}

void check_columns(const py::array& array, py::ssize_t columns, const char* message) {
  if (array.ndim() != 2 || array.shape(1) != columns) throw std::invalid_argument(message);
}

std::array<std::int64_t, 3> shape_of_volume(const py::array& volume) {
  if (volume.ndim() != 3) throw std::invalid_argument("volume must have three axes");
  return {volume.shape(0), volume.shape(1), volume.shape(2)};
}

template <typename T>
Mesh dense_mesh(const Array<T>& volume, const std::optional<Array<bool>>& mask, const std::array<double, 3>& spacing,
                const std::array<double, 3>& origin, double level, int num_threads, bool with_edges) {
  const auto shape = shape_of_volume(volume);
  if (mask && (mask->ndim() != 3 || !std::equal(shape.begin(), shape.end(), mask->shape()))) {
    throw std::invalid_argument("mask must have the shape of volume");
  }
  const T* samples = volume.data();
  const bool* flags = mask ? mask->data() : nullptr;
  const py::gil_scoped_release nogil;
  return marching_cubes_dense(samples, shape, flags, {spacing, origin}, level, num_threads, with_edges);
}

template <typename T>
ArrayTuple<double, std::int32_t> dense(const Array<T>& volume, const std::optional<Array<bool>>& mask,
                                       const std::array<double, 3>& spacing, const std::array<double, 3>& origin,
                                       double level, int num_threads) {
  return adopt_mesh(dense_mesh(volume, mask, spacing, origin, level, num_threads, false));
}

template <typename T>
DenseEdges dense_with_edges(const Array<T>& volume, const std::optional<Array<bool>>& mask,
                            const std::array<double, 3>& spacing, const std::array<double, 3>& origin, double level,
                            int num_threads) {
  return adopt_mesh_with_edges(dense_mesh(volume, mask, spacing, origin, level, num_threads, true));
}

template <typename T>
ArrayTuple<double, std::int32_t> sparse(const Array<std::int32_t>& corners, const Array<T>& values,
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

void check_edges(const Array<double>& vertices_grad, const py::array& edges) {
  check_columns(vertices_grad, 3, "vertices_grad must have shape (V, 3)");
  if (edges.ndim() != 1 || edges.shape(0) != vertices_grad.shape(0)) {
    throw std::invalid_argument("edges must have shape (V,), one for each vertex");
  }
}

template <typename T>
void dense_backward(const Array<T>& volume, const Array<std::int64_t>& edges, const Array<double>& vertices_grad,
                    const std::array<double, 3>& spacing, double level, Array<T>& volume_grad, int num_threads) {
  const auto shape = shape_of_volume(volume);
  check_edges(vertices_grad, edges);
  if (shape_of_volume(volume_grad) != shape) throw std::invalid_argument("volume_grad must have the shape of volume");
  const std::int64_t num_vertices = edges.shape(0);
  const T* samples = volume.data();
  const std::int64_t* edge_data = edges.data();
  const double* grad_data = vertices_grad.data();
  T* out = volume_grad.mutable_data();
  const py::gil_scoped_release nogil;
  marching_cubes_dense_backward(samples, shape, edge_data, grad_data, num_vertices, spacing, level, out, num_threads);
}

ArrayTuple<std::int32_t, std::int32_t, std::int32_t> lattice(const Array<std::int32_t>& cells, int num_threads) {
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

ArrayTuple<std::int32_t, std::int64_t> components(const Array<std::int32_t>& faces, std::int64_t num_vertices) {
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

py::array_t<double> areas_of_vertices(const Array<double>& vertices, const Array<std::int32_t>& faces) {
  check_columns(vertices, 3, "vertices must have shape (V, 3)");
  check_columns(faces, 3, "faces must have shape (F, 3)");
  const std::int64_t num_vertices = vertices.shape(0), num_faces = faces.shape(0);
  py::array_t<double> areas(static_cast<py::ssize_t>(num_vertices));
  double* found = areas.mutable_data();
  const double* positions = vertices.data();
  const std::int32_t* rows = faces.data();
  const py::gil_scoped_release nogil;
  vertex_areas(positions, num_vertices, rows, num_faces, found);
  return areas;
}

// Validated distances at the rows of the table.
const float* stored_distances(const VertexTable& table, const Array<float>& distances_m) {
  if (distances_m.ndim() != 1 || distances_m.shape(0) != table.num_rows()) {
    throw std::invalid_argument("distances_m must have shape (num_rows,)");
  }
  return distances_m.data();
}

Array<std::int32_t> near_surface(const VertexTable& table, const Array<float>& distances_m, float margin_m,
                                 int num_threads) {
  const float* distances = stored_distances(table, distances_m);
  std::vector<std::int32_t> rows;
  {
    const py::gil_scoped_release nogil;
    rows = cells_near_surface(table, distances, margin_m, num_threads);
  }
  return to_array(std::move(rows));
}

ArrayTuple<double, std::int32_t> surface_of_grid(const VertexTable& table, const Array<float>& distances_m,
                                                 const Array<std::int32_t>& cells, int parts, double voxel_size,
                                                 const std::array<std::int32_t, 3>& lowest,
                                                 const std::array<std::int32_t, 3>& highest, int num_threads) {
  const float* distances = stored_distances(table, distances_m);
  const std::int64_t num_cells = check_column(cells, "cells");
  const std::int32_t* rows = cells.data();
  Mesh mesh;
  {
    const py::gil_scoped_release nogil;
    mesh = grid_surface(table, distances, rows, num_cells, {parts, voxel_size, lowest, highest}, num_threads);
  }
  return adopt_mesh(std::move(mesh));
}

template <typename T>
void bind_for_type(py::module_& m) {
  using py::arg;
  const auto def_dense = [&m](const char* name, auto function) {
    m.def(name, function, arg("volume").noconvert(), arg("mask").noconvert(), arg("spacing"), arg("origin"),
          arg("level"), arg("num_threads") = 0);
  };
  def_dense("marching_cubes_dense", &dense<T>);
  def_dense("marching_cubes_dense_with_edges", &dense_with_edges<T>);
  m.def("marching_cubes_sparse", &sparse<T>, arg("corners").noconvert(), arg("values").noconvert(),
        arg("cells").noconvert(), arg("spacing"), arg("origin"), arg("level"), arg("num_threads") = 0);
  m.def("marching_cubes_dense_backward", &dense_backward<T>, arg("volume").noconvert(), arg("edges").noconvert(),
        arg("vertices_grad").noconvert(), arg("spacing"), arg("level"), arg("volume_grad").noconvert(),
        arg("num_threads") = 0);
}

}  // namespace

void bind_surfaces(py::module_& m, VertexTableClass& table) {
  using py::arg;
  table.def(
      "cells_near_surface", &near_surface, arg("distances_m").noconvert(), arg("margin_m"), arg("num_threads") = 0,
      "For an octree with `distances_m` (num_rows,) float32 at its corners, the rows (S,) int32 of the leaf cells "
      "with corners not all farther than `margin_m` from the surface, on the same side.");
  table.def("surface", &surface_of_grid, arg("distances_m").noconvert(), arg("cells").noconvert(), arg("parts"),
            arg("voxel_size"), arg("lowest"), arg("highest"), arg("num_threads") = 0,
            "Vertices (V, 3) float64, m, and faces (F, 3) int32 of the surface in the leaf cells with these rows (S,) "
            "int32, by trilinear interpolation at the corners of voxels: `parts` per edge of a leaf cell, with lattice "
            "coordinates from `lowest` to `highest`.");
  bind_for_type<float>(m);
  bind_for_type<double>(m);
  m.def("sparse_lattice", &lattice, py::arg("cells").noconvert(), py::arg("num_threads") = 0);
  m.def("vertex_areas", &areas_of_vertices, py::arg("vertices").noconvert(), py::arg("faces").noconvert(),
        "A third of the area of the triangles (F, 3) at each vertex (V, 3): (V,) float64.");
  m.def("mesh_components", &components, py::arg("faces").noconvert(), py::arg("num_vertices"));
}

}  // namespace radarsdf
